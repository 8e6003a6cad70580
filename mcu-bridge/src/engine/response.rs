//! How a serial bus spells a request on the wire, and how it finds the reply in what it hears.

use super::config::{Protocol, Route, Target};
use super::host::FRAME_MAX;
use super::queue::{Content, LATE_RESPONSES, LateResponses};
use super::transaction::Expected;
use heapless::Vec;
use jointbus_protocol::checksum;
use jointbus_protocol::decode::{Match, ResponseMatcher};
use jointbus_protocol::modbus::ascii;

/// Bytes that the search for a reply looks back on.
const WINDOW: usize = FRAME_MAX + 16;

/// Kinds of frame that a bus looks for: the reply in flight and those owed, each with an exception.
const KINDS: usize = 2 * (LATE_RESPONSES + 1);

/// What a bus waits for.
#[derive(Clone, Copy)]
pub(super) struct Wanted<'a> {
    pub(super) in_flight: Option<&'a Expected>,
    pub(super) owed: &'a LateResponses,
}

impl Wanted<'_> {
    fn all(&self) -> impl Iterator<Item = Option<&Expected>> {
        core::iter::once(self.in_flight).chain(self.owed.iter().map(Some))
    }
}

impl Match<KINDS> for Wanted<'_> {
    fn lengths(&self) -> [usize; KINDS] {
        let mut lengths = [0; KINDS];
        let all = self.all().map(|expected| expected.map_or([0; 2], Expected::lengths));
        lengths.as_chunks_mut::<2>().0.iter_mut().zip(all).for_each(|(place, two)| *place = two);
        lengths
    }

    fn accepts(&self, kind: usize, frame: &[u8]) -> bool {
        self.all().nth(kind / 2).flatten().is_some_and(|expected| expected.accepts(frame))
    }
}

/// A frame that a bus heard.
pub(super) enum Heard<'a> {
    /// The reply in flight, without address and checksum.
    Reply(&'a [u8]),
    /// One that is owed, likewise.
    LateResponse(usize, &'a [u8]),
    /// Whole, and wanted by nobody; RTU and NST frames can't be told from noise then.
    Foreign,
    /// Characters that are no frame.
    Broken,
}

/// Finds frames in the bytes of a serial bus.
#[derive(Debug)]
pub(super) enum Receiver {
    /// NST and Modbus RTU, which nothing delimits: slides to what is wanted.
    Sliding(ResponseMatcher<WINDOW, KINDS>),
    /// Modbus ASCII.
    Ascii(ascii::Decoder),
}

impl Receiver {
    pub(super) const fn new() -> Self {
        Self::Sliding(ResponseMatcher::new())
    }

    /// Starts afresh.
    pub(super) fn reset(&mut self, is_ascii: bool) {
        self.discard();
        match (&self, is_ascii) {
            (Self::Sliding(_), true) => *self = Self::Ascii(ascii::Decoder::new()),
            (Self::Ascii(_), false) => *self = Self::new(),
            _ => {}
        }
    }

    /// Takes bytes until a frame comes out or none are left.
    pub(super) fn feed(&mut self, wanted: Wanted<'_>, bytes: &mut &[u8]) -> Option<Heard<'_>> {
        match self {
            Self::Sliding(search) => {
                let (kind, frame) = search.feed(&wanted, bytes)?;
                Some(match (kind / 2).checked_sub(1) {
                    Some(index) => Heard::LateResponse(index, content(frame)),
                    None => Heard::Reply(content(frame)),
                })
            }
            Self::Ascii(decoder) => Some(match decoder.feed(bytes)? {
                ascii::Event::Frame(ascii::Frame { unit, pdu }) => {
                    let fits = |expected: &Expected| expected.accepts_pdu(unit, pdu);
                    match wanted.in_flight.is_some_and(fits) {
                        true => Heard::Reply(pdu),
                        false => match wanted.owed.iter().position(fits) {
                            Some(index) => Heard::LateResponse(index, pdu),
                            None => Heard::Foreign,
                        },
                    }
                }
                ascii::Event::Dropped(_) => Heard::Broken,
            }),
        }
    }

    /// The line fell silent: a reply of unknown length may end here.
    pub(super) fn end_of_frame(&mut self, expected: &Expected) -> Option<&[u8]> {
        match self {
            Self::Sliding(search) => search.end_of_frame(|frame| expected.accepts(frame)).map(content),
            Self::Ascii(_) => None,
        }
    }

    /// Whether a reply could be ended by silence alone.
    pub(super) const fn is_open(&self) -> bool {
        matches!(self, Self::Sliding(search) if search.has_leftovers())
    }

    /// Other kinds are waited for now, perhaps by what was received already.
    pub(super) const fn rescan(&mut self) {
        if let Self::Sliding(search) = self {
            search.rescan();
        }
    }

    /// Forgets received bytes that belong to nothing; tells whether there were any.
    pub(super) fn discard(&mut self) -> bool {
        match self {
            Self::Sliding(search) => {
                let leftovers = search.has_leftovers();
                search.clear();
                leftovers
            }
            Self::Ascii(decoder) => {
                let leftovers = decoder.is_inside();
                decoder.clear();
                leftovers
            }
        }
    }
}

/// An RTU or NST frame without address and CRC.
fn content(frame: &[u8]) -> &[u8] {
    match frame {
        [_, content @ .., _, _] => content,
        _ => &[],
    }
}

const _: () = assert!(checksum::CRC_LENGTH == 2);

/// What of a frame a bus is handed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Framing {
    /// Address, body and CRC.
    Sealed,
    /// Address and body: Modbus ASCII has a checksum of its own.
    Addressed,
    /// The body alone: on CAN the identifier names the node.
    Body,
}

impl Framing {
    /// What the bus of a route is handed.
    pub(super) const fn of(route: &Route) -> Self {
        match (route.bus, route.protocol) {
            (Target::Can, _) => Self::Body,
            (_, Protocol::ModbusAscii) => Self::Addressed,
            _ => Self::Sealed,
        }
    }

    /// Writes a request to `address`; all that came in one frame has room.
    pub(super) fn write(self, address: u8, body: &[u8], content: &mut Content) {
        if self != Self::Body {
            let _ = content.push(address);
        }
        let _ = content.extend_from_slice(body);
        if self == Self::Sealed {
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
