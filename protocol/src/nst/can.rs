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
mod tests {
    use super::*;
    use std::vec::Vec;

    const LIMIT: Duration = Duration::from_millis(10);

    fn at(millis: u64) -> Instant {
        Instant::from_micros(millis * 1000)
    }

    fn frames(source: u8, destination: u8, body: &[u8]) -> Vec<Frame> {
        segment(source, destination, body).unwrap().collect()
    }

    fn complete<const N: usize>(reassembler: &mut Reassembler<N>, frames: &[Frame]) -> Option<Vec<u8>> {
        let mut result = None;
        for frame in frames {
            if let Some(Outcome::Complete { body, .. }) = reassembler.push(frame, at(1)).outcome {
                assert!(result.replace(body.to_vec()).is_none(), "delivered twice");
            }
        }
        result
    }

    #[test]
    fn every_length_is_cut_and_joined_again() {
        let body: Vec<u8> = (0..128).collect();
        for length in 1..=TRANSFER_MAX {
            let cut = frames(1, 2, &body[..length]);
            assert_eq!(cut.len(), length.div_ceil(8));
            let mut reassembler = Reassembler::<1>::new(2, LIMIT);
            assert_eq!(complete(&mut reassembler, &cut).as_deref(), Some(&body[..length]));
        }
        assert_eq!(segment(1, 2, &[]).err(), Some(TransferLength));
        assert_eq!(segment(1, 2, &[0; 129]).err(), Some(TransferLength));
    }

    #[test]
    fn requests_are_split_into_parts_that_fit_a_transfer() {
        let data = [7; 249];
        for length in 0..=249u8 {
            let write = Request::Write { register: 0x10, data: &data[..length.into()] };
            for request in [Request::read(0x10, length), write] {
                let (mut moved, mut parts) = (0u8, 0);
                while let Some(part) = next_fragment(&request, moved) {
                    assert_eq!(part.register(), 0x10 + u16::from(moved));
                    assert!(part.length() <= if part.function().is_read() { 126 } else { 124 });
                    moved += part.length();
                    parts += 1;
                    if length == 0 {
                        break;
                    }
                }
                assert_eq!((moved, parts <= 3), (length, true));
            }
        }
        let command =
            Request::Command { function: super::super::FunctionCode::SetZero, register: 0, length: 200 };
        assert_eq!(next_fragment(&command, 0), Some(command));
        assert_eq!(next_fragment(&command, 200), None);
    }

    #[test]
    fn identifiers_of_the_printed_read_reply() {
        let ids: Vec<Id> = frames(1, 2, &[0; 20]).iter().map(Frame::id).collect();
        assert_eq!(ids, [0x0001_0220, 0x0001_0241, 0x0001_0282].map(Id::Extended));
    }

    #[test]
    fn any_frame_lost_or_swapped_delivers_nothing() {
        let cut = frames(1, 2, &[7; 40]);
        for lost in 0..cut.len() {
            let mut rest = cut.clone();
            rest.remove(lost);
            let mut reassembler = Reassembler::<1>::new(2, LIMIT);
            assert_eq!(complete(&mut reassembler, &rest), None, "frame {lost} lost");
            assert_eq!(complete(&mut reassembler, &cut), Some(std::vec![7; 40]), "and the next one arrives");
        }
        for first in 0..cut.len() - 1 {
            let mut swapped = cut.clone();
            swapped.swap(first, first + 1);
            assert_eq!(complete(&mut Reassembler::<1>::new(2, LIMIT), &swapped), None);
        }
    }

    #[test]
    fn every_irregularity_has_its_name() {
        let cut = frames(1, 2, &[7; 24]);
        let check = |frames: &[(Frame, u64)], expected: ReassemblyError| {
            let mut reassembler = Reassembler::<1>::new(2, LIMIT);
            let mut last = None;
            for (frame, millis) in frames {
                last = reassembler.push(frame, at(*millis)).error;
            }
            assert_eq!(last, Some(expected));
        };
        let raw = |raw: u32, data: &[u8]| Frame::data_frame(Id::Extended(raw), data).unwrap();
        check(&[(Frame::data_frame(Id::Standard(1), &[1]).unwrap(), 0)], ReassemblyError::NotNst);
        check(&[(raw(0x0101_0210, &[1]), 0)], ReassemblyError::NotNst);
        check(
            &[(Frame::from_parts(Id::Extended(0x0001_0210), true, 1, [0; 8]).unwrap(), 0)],
            ReassemblyError::NotNst,
        );
        check(&[(raw(0x0001_0310, &[1]), 0)], ReassemblyError::OtherDestination);
        check(&[(cut[0], 0), (raw(0x0001_FF41, &[1; 8]), 0)], ReassemblyError::OtherDestination);
        check(&[(cut[0], 0), (raw(0x0001_0231, &[1]), 0)], ReassemblyError::UnknownType);
        check(&[(cut[0], 0), (cut[2], 0)], ReassemblyError::Counter);
        check(&[(raw(0x0001_0211, &[1]), 0)], ReassemblyError::Counter);
        check(&[(cut[1], 0)], ReassemblyError::NoFirst);
        check(&[(raw(0x0001_0210, &[]), 0)], ReassemblyError::Length);
        check(&[(raw(0x0001_0220, &[1; 7]), 0)], ReassemblyError::Length);
        check(&[(cut[0], 0), (cut[1], 11)], ReassemblyError::Late);
        check(&[(cut[0], 0), (cut[0], 1)], ReassemblyError::Restarted);
        check(&[(cut[0], 0), (frames(3, 2, &[9; 20])[0], 1)], ReassemblyError::NoContext);
    }

    #[test]
    fn sources_do_not_disturb_each_other() {
        let (one, other) = (frames(1, 2, &[1; 24]), frames(3, 2, &[3; 24]));
        let mixed: Vec<Frame> = one.iter().zip(&other).flat_map(|(a, b)| [*a, *b]).collect();
        let mut reassembler = Reassembler::<2>::new(2, LIMIT);
        let mut found = Vec::new();
        for frame in &mixed {
            if let Some(Outcome::Complete { source, body, .. }) = reassembler.push(frame, at(0)).outcome {
                found.push((source, body.to_vec()));
            }
        }
        assert_eq!(found, [(1, std::vec![1; 24]), (3, std::vec![3; 24])]);
    }

    #[test]
    fn a_stalled_transfer_gives_its_context_to_another_source() {
        let mut reassembler = Reassembler::<1>::new(2, LIMIT);
        reassembler.push(&frames(1, 2, &[1; 24])[0], at(0));
        let report = reassembler.push(&frames(3, 2, &[3; 5])[0], at(11));
        assert_eq!(report.outcome, Some(Outcome::Complete { source: 3, destination: 2, body: &[3; 5] }));
    }

    #[test]
    fn a_forgotten_transfer_is_not_joined_and_the_others_are() {
        let mut reassembler = Reassembler::<2>::new(2, LIMIT);
        for source in [1, 3] {
            reassembler.push(&frames(source, 2, &[source; 12])[0], at(0));
        }
        reassembler.forget(1);
        let report = reassembler.push(&frames(1, 2, &[1; 12])[1], at(0));
        assert_eq!((report.outcome, report.error), (None, Some(ReassemblyError::NoFirst)));
        let report = reassembler.push(&frames(3, 2, &[3; 12])[1], at(0));
        assert_eq!(report.outcome, Some(Outcome::Complete { source: 3, destination: 2, body: &[3; 12] }));
    }

    #[test]
    fn sixteen_frames_and_no_seventeenth() {
        let mut reassembler = Reassembler::<1>::new(2, LIMIT);
        for counter in 0..16u32 {
            let kind = if counter == 0 { 0x20 } else { 0x40 };
            let id = Id::Extended(0x0001_0200 | kind | counter);
            let report = reassembler.push(&Frame::data_frame(id, &[0; 8]).unwrap(), at(0));
            assert_eq!(report.outcome, Some(Outcome::More));
        }
        let wrapped = Frame::data_frame(Id::Extended(0x0001_0240), &[0; 8]).unwrap();
        assert_eq!(reassembler.push(&wrapped, at(0)).error, Some(ReassemblyError::Counter));
    }
}
