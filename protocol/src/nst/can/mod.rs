//! The form on CAN: a body cut into frames with 29-bit identifiers (4.2.1.2, 4.2.4).
//!
//! Identifier: bits 28:24 zero, 23:16 source node, 15:8 destination node, 7:4 frame type, 3:0 counter. The manual
//! lets type and counter share bit 4; sixteen frames of eight bytes are exactly its 128 bytes, so the counter is 3:0.

use super::Request;
use crate::can::{Frame, Id};
use crate::codes::code_table;
use crate::error::error_text;
use crate::time::{Duration, Instant};

/// Most bytes of one transfer (4.2.1.2).
pub const TRANSFER_MAX: usize = 128;

/// Most frames of one transfer.
pub const FRAMES_MAX: usize = TRANSFER_MAX / FRAME_DATA_MAX;

/// A bit for each frame type that there is.
const KNOWN_TYPES: u16 = 1 << FrameType::Single.code()
    | 1 << FrameType::First.code()
    | 1 << FrameType::Middle.code()
    | 1 << FrameType::Last.code();

/// Bytes of every frame but the last one.
const FRAME_DATA_MAX: usize = 8;

/// Most data bytes that one read moves.
pub const READ_MAX: usize = TRANSFER_MAX - super::RESPONSE_HEADER;

/// Most data bytes that one write moves.
pub const WRITE_MAX: usize = TRANSFER_MAX - super::COMMAND_LENGTH;

/// Destination of a broadcast.
pub const BROADCAST: u8 = super::BROADCAST;

code_table! {
    /// Place of a frame in its transfer (4.2.1.2, bits 7:4).
    FrameType {
        /// The only frame
        Single = 0b0001,
        /// The first of several
        First = 0b0010,
        /// Neither first nor last
        Middle = 0b0100,
        /// The last of several
        Last = 0b1000,
    }
}

/// A 29-bit identifier, taken apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Identifier {
    /// Node that sends.
    pub source: u8,
    /// Node that is meant.
    pub destination: u8,
    /// Place of the frame in its transfer.
    pub frame_type: FrameType,
    /// Number of the frame in its transfer, 0 to 15.
    pub counter: u8,
}

impl Identifier {
    /// Takes a raw identifier apart; `None` where one of bits 28:24 is set.
    #[must_use]
    pub const fn from_raw(raw: u32) -> Option<Self> {
        match raw.to_be_bytes() {
            [0, source, destination, format] => Some(Self {
                source,
                destination,
                frame_type: FrameType::from_code(format >> 4),
                counter: format & 0x0F,
            }),
            _ => None,
        }
    }

    /// The raw identifier; of type and counter the low four bits each.
    #[must_use]
    pub const fn to_raw(self) -> u32 {
        let format = (self.frame_type.code() << 4) | (self.counter & 0x0F);
        u32::from_be_bytes([0, self.source, self.destination, format])
    }
}

/// The transfer is empty or longer than [`TRANSFER_MAX`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TransferLength;

/// The request that moves what one transfer can hold of `request`, behind the first `moved` bytes; `None` when all has
/// been moved. A command that moves nothing is one transfer.
#[must_use]
pub fn next_fragment<'a>(request: &Request<'a>, moved: u8) -> Option<Request<'a>> {
    let (length, reads) = (request.length(), request.function().is_read());
    if moved > 0 && moved >= length {
        return None;
    }
    let register = request.register().wrapping_add(moved.into());
    match *request {
        Request::Write { data, .. } => {
            let rest = data.get(usize::from(moved)..)?;
            Some(Request::Write { register, data: rest.get(..WRITE_MAX).unwrap_or(rest) })
        }
        Request::Command { function, .. } if reads => {
            let most = u8::try_from(READ_MAX).unwrap_or(u8::MAX);
            Some(Request::Command { function, register, length: length.saturating_sub(moved).min(most) })
        }
        Request::Command { .. } => (moved == 0).then_some(*request),
    }
}

/// The frames of one transfer, in order.
#[derive(Debug, Clone)]
pub struct Segments<'a> {
    source: u8,
    destination: u8,
    rest: &'a [u8],
    counter: u8,
}

/// Cuts a body into frames from node `source` to node `destination`.
///
/// # Errors
/// [`TransferLength`] where the body is empty or does not fit one transfer.
pub const fn segment(source: u8, destination: u8, body: &[u8]) -> Result<Segments<'_>, TransferLength> {
    if body.is_empty() || body.len() > TRANSFER_MAX {
        return Err(TransferLength);
    }
    Ok(Segments { source, destination, rest: body, counter: 0 })
}

impl Iterator for Segments<'_> {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        if self.rest.is_empty() {
            return None;
        }
        let (frame_type, length, payload, rest) = match self.rest.split_first_chunk() {
            Some((payload, rest)) => {
                let is_last = rest.is_empty();
                let frame_type = match (self.counter == 0, is_last) {
                    (true, true) => FrameType::Single,
                    (true, false) => FrameType::First,
                    (false, false) => FrameType::Middle,
                    (false, true) => FrameType::Last,
                };
                (frame_type, FRAME_DATA_MAX, *payload, rest)
            }
            None => {
                let mut payload = [0; FRAME_DATA_MAX];
                payload.iter_mut().zip(self.rest).for_each(|(place, byte)| *place = *byte);
                let frame_type = if self.counter == 0 { FrameType::Single } else { FrameType::Last };
                (frame_type, self.rest.len(), payload, &[][..])
            }
        };
        let identifier = Identifier {
            source: self.source,
            destination: self.destination,
            frame_type,
            counter: self.counter,
        };
        self.rest = rest;
        self.counter = self.counter.wrapping_add(1);
        let length = u8::try_from(length).unwrap_or(0);
        Some(Frame::extended(identifier.to_raw(), length, payload))
    }
}

/// Why a transfer, or a frame of none, was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReassemblyError {
    /// Not an extended data frame with bits 28:24 zero.
    NotNst,
    /// For another node than this one, or than the frames before it: that transfer is dropped.
    OtherDestination,
    /// Its frame type is in no table.
    UnknownType,
    /// The counter is not the next one: the transfer is dropped.
    Counter,
    /// A middle or last frame without a first one.
    NoFirst,
    /// No data, or a frame before the last one with fewer than eight bytes: the transfer is dropped.
    Length,
    /// The frame came later than the limit after the one before: the transfer is dropped.
    Late,
    /// A first or single frame while a transfer of that source was under way: that one is dropped, this one counts.
    Restarted,
    /// All contexts are taken by other sources.
    NoContext,
}

/// What a frame brought.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Outcome<'a> {
    /// The transfer goes on.
    More,
    /// The transfer is complete.
    Complete {
        /// Node that sent it.
        source: u8,
        /// Node that is meant: this one, or [`BROADCAST`].
        destination: u8,
        /// The body.
        body: &'a [u8],
    },
}

/// What [`Reassembler::push`] says of a frame: what came of it, and what was wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct PushResult<'a> {
    /// What the frame brought; `None` where it brought nothing.
    pub outcome: Option<Outcome<'a>>,
    /// What was irregular; a new first frame can be taken and yet end another transfer.
    pub error: Option<ReassemblyError>,
}

#[derive(Debug, Clone, Copy)]
struct Context {
    source: u8,
    destination: u8,
    /// Number of the next frame; 0 while the context is free.
    counter: u8,
    last: Instant,
    body: [[u8; FRAME_DATA_MAX]; FRAMES_MAX],
}

impl Context {
    const FREE: Self = Self {
        source: 0,
        destination: 0,
        counter: 0,
        last: Instant::from_micros(0),
        body: [[0; FRAME_DATA_MAX]; FRAMES_MAX],
    };

    const fn is_free(&self) -> bool {
        self.counter == 0
    }

    /// Whether its next frame had to come before `now`. In numbers, because it is asked of every frame.
    const fn is_overdue(&self, limit: Duration, now: Instant) -> bool {
        now.as_micros().saturating_sub(self.last.as_micros()) > limit.as_micros()
    }
}

/// Joins frames into transfers: one context a source node, at most `CONTEXTS` at once. Nothing is ever delivered in
/// part.
#[derive(Debug)]
pub struct Reassembler<const CONTEXTS: usize> {
    node: u8,
    limit: Duration,
    contexts: [Context; CONTEXTS],
}

impl<const CONTEXTS: usize> Reassembler<CONTEXTS> {
    /// For transfers to `node` (and, for a device, to [`BROADCAST`]) whose frames come at most `limit` apart.
    #[must_use]
    pub const fn new(node: u8, limit: Duration) -> Self {
        Self { node, limit, contexts: [Context::FREE; CONTEXTS] }
    }

    /// Changes the node; transfers under way are forgotten.
    pub fn set_node(&mut self, node: u8) {
        self.node = node;
        self.clear();
    }

    /// Forgets a transfer of `source` that is under way.
    pub fn forget(&mut self, source: u8) {
        let of_source = self.contexts.iter_mut().filter(|context| context.source == source);
        of_source.for_each(|context| context.counter = 0);
    }

    /// Forgets all transfers under way.
    pub fn clear(&mut self) {
        self.contexts.iter_mut().for_each(|context| context.counter = 0);
    }

    /// Takes a frame that ended at `now`.
    pub fn push(&mut self, frame: &Frame, now: Instant) -> PushResult<'_> {
        let raw = match frame.id() {
            Id::Extended(raw) if !frame.is_remote() => raw,
            _ => return PushResult::wrong(ReassemblyError::NotNst),
        };
        // `Identifier` by its bits: a branch for each frame type would be half of this function
        let [0, source, destination, format] = raw.to_be_bytes() else {
            return PushResult::wrong(ReassemblyError::NotNst);
        };
        if destination != self.node && destination != BROADCAST {
            return PushResult::wrong(ReassemblyError::OtherDestination);
        }
        let (frame_type, counter) = (format >> 4, format & 0x0F);
        if KNOWN_TYPES >> frame_type & 1 == 0 {
            self.forget(source);
            return PushResult::wrong(ReassemblyError::UnknownType);
        }
        let starts = frame_type & (FrameType::Single.code() | FrameType::First.code()) != 0;
        let ends = frame_type & (FrameType::Single.code() | FrameType::Last.code()) != 0;
        let limit = self.limit;
        let mine = self.contexts.iter().position(|context| !context.is_free() && context.source == source);
        // a transfer whose next frame is overdue holds its context no longer than until another source wants it
        let place = match mine {
            None if starts => {
                self.contexts.iter().position(|context| context.is_free() || context.is_overdue(limit, now))
            }
            mine => mine,
        };
        let Some(context) = place.and_then(|index| self.contexts.get_mut(index)) else {
            return PushResult::wrong(if starts {
                ReassemblyError::NoContext
            } else {
                ReassemblyError::NoFirst
            });
        };
        let expected = if starts { 0 } else { context.counter };
        let error = if !starts && context.is_overdue(limit, now) {
            Some(ReassemblyError::Late)
        } else if !starts && destination != context.destination {
            Some(ReassemblyError::OtherDestination)
        } else if counter != expected {
            Some(ReassemblyError::Counter)
        } else if frame.dlc() == 0 || (frame.dlc() < 8 && !ends) {
            Some(ReassemblyError::Length)
        } else {
            None
        };
        // sixteen frames fill the body exactly, and the counter has no seventeenth
        let place = context.body.get_mut(usize::from(counter));
        let (None, Some(place)) = (error, place) else {
            context.counter = 0;
            return PushResult { outcome: None, error };
        };
        *place = *frame.payload();
        (context.source, context.destination) = (source, destination);
        context.last = now;
        let error = (starts && mine.is_some()).then_some(ReassemblyError::Restarted);
        if !ends {
            context.counter = counter.wrapping_add(1);
            return PushResult { outcome: Some(Outcome::More), error };
        }
        context.counter = 0;
        let length = usize::from(counter).wrapping_mul(FRAME_DATA_MAX).wrapping_add(frame.data().len());
        let body = context.body.as_flattened().get(..length).unwrap_or(&[]);
        PushResult { outcome: Some(Outcome::Complete { source, destination, body }), error }
    }
}

impl PushResult<'_> {
    const fn wrong(error: ReassemblyError) -> Self {
        Self { outcome: None, error: Some(error) }
    }
}

error_text! {
    TransferLength {
        TransferLength => ("a transfer has 1 to 128 bytes"),
    }
}

#[cfg(test)]
mod tests;
