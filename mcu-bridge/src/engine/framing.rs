//! How a bus frames a request on its wire.

use super::slab::Content;
use crate::board::{Protocol, Route};
use heapless::Vec;
use jointbus_protocol::checksum;
use jointbus_protocol::modbus::ascii;

/// What of a frame a bus is handed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Framing {
    /// Address, body and CRC.
    WithCrc,
    /// Address and body: Modbus ASCII has a checksum of its own.
    Addressed,
    /// The body alone: on CAN the identifier names the node.
    Body,
}

impl Framing {
    /// What the bus of a route is handed.
    pub(super) const fn of(route: &Route) -> Self {
        match route.protocol {
            Protocol::NstOverCan => Self::Body,
            Protocol::ModbusAscii => Self::Addressed,
            Protocol::ModbusRtu | Protocol::Nst => Self::WithCrc,
        }
    }

    /// Writes a request to `address`; all that came in one frame has room.
    pub(super) fn write(self, address: u8, body: &[u8], content: &mut Content) {
        if self != Self::Body {
            let _ = content.push(address);
        }
        let _ = content.extend_from_slice(body);
        if self == Self::WithCrc {
            let crc = checksum::crc16(content);
            let _ = content.extend_from_slice(&crc.to_le_bytes());
        }
    }
}

/// Characters of a Modbus ASCII frame that are spelt out at once.
const CHUNK: usize = 32;

/// A request on its way onto the line.
#[derive(Debug, Default)]
pub(super) struct Outgoing {
    /// Bytes that the port has taken.
    handed: usize,
    /// Modbus ASCII: the characters that start at `chunk_start`.
    chunk: Option<Vec<u8, CHUNK>>,
    chunk_start: usize,
}

impl Outgoing {
    /// Starts with a request.
    pub(super) fn start(is_ascii: bool, content: &[u8]) -> Self {
        let mut outgoing = Self { handed: 0, chunk: is_ascii.then(Vec::new), chunk_start: 0 };
        outgoing.consume(content, 0);
        outgoing
    }

    /// What the port is to send.
    pub(super) fn pending<'s>(&'s self, content: &'s [u8]) -> &'s [u8] {
        match &self.chunk {
            None => content.get(self.handed..),
            Some(chunk) => chunk.get(self.handed.saturating_sub(self.chunk_start)..),
        }
        .unwrap_or(&[])
    }

    /// The port took so many of the pending bytes.
    pub(super) fn consume(&mut self, content: &[u8], taken: usize) {
        self.handed = self.handed.saturating_add(taken.min(self.pending(content).len()));
        if self.pending(content).is_empty()
            && let Some(chunk) = &mut self.chunk
        {
            self.chunk_start = self.handed;
            chunk.clear();
            chunk.extend((self.handed..).map_while(|index| ascii::character_at(content, index)).take(CHUNK));
        }
    }
}

/// Bytes of a request on the wire.
pub(super) fn wire_length(is_ascii: bool, content: &[u8]) -> usize {
    if is_ascii { ascii::frame_length(content.len()) } else { content.len() }
}

/// One byte of a request on the wire.
pub(super) fn wire_byte(is_ascii: bool, content: &[u8], index: usize) -> Option<u8> {
    if is_ascii { ascii::character_at(content, index) } else { content.get(index).copied() }
}
