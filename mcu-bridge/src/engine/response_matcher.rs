//! How a serial bus finds responses in what it hears.

use super::host::FRAME_MAX;
use super::pending_late::{LATE_MAX, PendingLate};
use super::request::Expected;
use jointbus_protocol::checksum;
use jointbus_protocol::decode::{Match, ResponseMatcher};
use jointbus_protocol::modbus::ascii;
use jointbus_protocol::time::Instant;

/// Bytes that the search for a reply looks back on.
const WINDOW: usize = FRAME_MAX + 16;

/// Kinds of frame that a bus looks for: the response in flight and the late ones, each with an exception.
const KINDS: usize = 2 * (LATE_MAX + 1);

/// What a bus waits for.
#[derive(Clone, Copy)]
pub(super) struct Wanted<'a> {
    pub(super) in_flight: Option<&'a Expected>,
    pub(super) late: &'a PendingLate,
}

impl Wanted<'_> {
    fn all(&self) -> impl Iterator<Item = Option<&Expected>> {
        core::iter::once(self.in_flight).chain(self.late.iter().map(Some))
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
pub(super) enum Received<'a> {
    /// The reply in flight, without address and checksum.
    Reply(&'a [u8]),
    /// A late one, likewise.
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
    pub(super) fn feed(&mut self, wanted: Wanted<'_>, bytes: &mut &[u8]) -> Option<Received<'_>> {
        match self {
            Self::Sliding(search) => {
                let (kind, frame) = search.feed(&wanted, bytes)?;
                Some(match (kind / 2).checked_sub(1) {
                    Some(index) => Received::LateResponse(index, content(frame)),
                    None => Received::Reply(content(frame)),
                })
            }
            Self::Ascii(decoder) => Some(match decoder.feed(bytes, Instant::default())? {
                ascii::Event::Frame(ascii::Frame { unit, pdu }) => {
                    let fits = |expected: &Expected| expected.accepts_pdu(unit, pdu);
                    match wanted.in_flight.is_some_and(fits) {
                        true => Received::Reply(pdu),
                        false => match wanted.late.iter().position(fits) {
                            Some(index) => Received::LateResponse(index, pdu),
                            None => Received::Foreign,
                        },
                    }
                }
                ascii::Event::Dropped(_) => Received::Broken,
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
