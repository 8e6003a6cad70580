//! The host port: which frames come in, and the replies on their way out.

use super::counters::{Counters, count};
use super::router::Routes;
use crate::board::{PORTS_MAX, Protocol};
use heapless::Vec;
use jointbus_protocol::decode::{FrameDecoder, FrameLength, Framing, STRAY_MAX};
use jointbus_protocol::modbus::{self, ExceptionCode, FunctionCode, rtu};
use jointbus_protocol::{checksum, nst};

/// Longest frame of the host: NST and Modbus agree.
pub(super) const FRAME_MAX: usize = rtu::FRAME_MAX;
const _: () = assert!(nst::serial::REQUEST_MAX == FRAME_MAX && nst::serial::RESPONSE_MAX <= FRAME_MAX + 1);

/// Frames of the host out of its bytes.
pub(super) type HostDecoder = FrameDecoder<{ FRAME_MAX + STRAY_MAX }>;

/// The unit address selects the route, the route the codec, the codec the frame's length.
pub(super) struct HostFraming<'a>(pub(super) Routes<'a>);

impl Framing for HostFraming<'_> {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        match prefix.first() {
            Some(&modbus::BROADCAST) => rtu::request_length(prefix),
            Some(&nst::BROADCAST) => FrameLength::UntilSilence,
            Some(&unit) => match self.0.find(unit).map(|(_, route)| route.protocol) {
                Some(Protocol::ModbusRtu | Protocol::ModbusAscii) => rtu::request_length(prefix),
                Some(Protocol::Nst | Protocol::NstOverCan) => nst::serial::request_length(prefix),
                None => FrameLength::Impossible,
            },
            None => FrameLength::AtLeast(1),
        }
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        frame.len() >= rtu::FRAME_MIN && checksum::strip_crc(frame).is_some()
    }

    fn is_broadcast(&self, frame: &[u8]) -> bool {
        matches!(frame.first(), Some(&modbus::BROADCAST | &nst::BROADCAST))
    }
}

/// Room for one reply of each bus, for one of the board's own units, and for exceptions.
const OUTPUT: usize = USABLE + FRAME_MAX;

/// What replies may take: the rest stays free for exceptions. A board has at most as many buses as other ports.
const USABLE: usize = PORTS_MAX * FRAME_MAX;

/// Replies on their way to the host.
///
/// A transaction reserves room for its reply before it starts, so that a slow host link holds requests back and loses
/// no reply.
#[derive(Debug)]
pub(super) struct Output {
    buffer: Vec<u8, OUTPUT>,
    start: usize,
    reserved: usize,
}

impl Output {
    pub(super) const fn new() -> Self {
        Self { buffer: Vec::new(), start: 0, reserved: 0 }
    }

    /// What is to be sent next.
    pub(super) fn pending(&self) -> &[u8] {
        self.buffer.get(self.start..).unwrap_or(&[])
    }

    /// So many of the pending bytes were taken.
    pub(super) fn consume(&mut self, taken: usize) {
        self.start = self.start.saturating_add(taken).min(self.buffer.len());
        if self.start == self.buffer.len() {
            self.start = 0;
            self.buffer.clear();
        }
    }

    /// Whether a reply of any length fits beside those that are reserved for.
    pub(super) fn has_room(&self) -> bool {
        self.pending().len().saturating_add(self.reserved).saturating_add(FRAME_MAX) <= USABLE
    }

    pub(super) const fn reserve(&mut self) {
        self.reserved = self.reserved.saturating_add(FRAME_MAX);
    }

    pub(super) const fn release(&mut self) {
        self.reserved = self.reserved.saturating_sub(FRAME_MAX);
    }

    /// Queues the refusal of a Modbus request.
    pub(super) fn refuse(&mut self, counters: &mut Counters, unit: u8, function: u8, why: ExceptionCode) {
        self.relay(counters, unit, &[function | FunctionCode::EXCEPTION_FLAG, why.code()]);
    }

    /// Queues a reply of a data unit or body.
    pub(super) fn relay(&mut self, counters: &mut Counters, unit: u8, content: &[u8]) {
        if OUTPUT.saturating_sub(self.buffer.len()) <= FRAME_MAX && self.start > 0 {
            self.buffer.drain(..self.start);
            self.start = 0;
        }
        let frame = self.buffer.len();
        let whole = self
            .buffer
            .push(unit)
            .and_then(|()| self.buffer.extend_from_slice(content).map_err(|_| unit))
            .and_then(|()| {
                let crc = checksum::crc16(self.buffer.get(frame..).unwrap_or(&[]));
                self.buffer.extend_from_slice(&crc.to_le_bytes()).map_err(|_| unit)
            });
        match whole {
            Ok(()) => count(&mut counters.sent),
            Err(_) => {
                self.buffer.truncate(frame);
                count(&mut counters.overruns);
            }
        }
    }
}
