//! Frames out of a byte stream, for both ends of a line.
//!
//! [`FrameDecoder`] is the slave's side: it takes a frame the moment it is complete and right, and after anything
//! wrong nothing until the line was silent, so that bytes inside a frame are never executed.
//! [`ResponseMatcher`] is the master's side: it slides over noise to the one reply it waits for.
//! Both are bounded and do work in proportion to the bytes they are fed.

use crate::time::{Duration, Instant};
use crate::wire;

/// What the first bytes of a frame tell about its length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameLength {
    /// The frame has so many bytes, checksum included.
    Exactly(usize),
    /// So many bytes are needed before the length can be told.
    AtLeast(usize),
    /// Only silence ends the frame.
    UntilSilence,
    /// No frame starts like this.
    Impossible,
}

/// What a [`FrameDecoder`] must know of the frames on its line.
pub trait Framing {
    /// Length of the frame that starts with `prefix`, which is never empty.
    fn length(&self, prefix: &[u8]) -> FrameLength;

    /// Whether a frame of the right length has the right checksum.
    fn is_valid(&self, frame: &[u8]) -> bool;

    /// Whether the frame is a broadcast, which is not taken out of the middle of a burst.
    fn is_broadcast(&self, frame: &[u8]) -> bool;

    /// Whether a valid frame behind up to [`STRAY_MAX`] stray bytes is taken: not where the data of another frame can
    /// start there.
    fn forgives_stray_bytes(&self) -> bool {
        true
    }
}

/// Why a burst was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DecodeError {
    /// A frame was complete, its checksum wrong.
    Checksum,
    /// No frame starts with these bytes.
    Impossible,
    /// The line fell silent inside a frame.
    Incomplete,
}

/// What came out of a byte stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Event<'a> {
    /// A whole, valid frame.
    Frame(&'a [u8]),
    /// Silence ended a burst that held no frame.
    Dropped {
        /// What was wrong first.
        error: DecodeError,
        /// The burst, as far as it was kept.
        burst: &'a [u8],
    },
}

/// Stray bytes that may stand before a frame which then fills its burst to the end.
pub const STRAY_MAX: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// The last event has been handed out; the next byte starts afresh.
    Delivered,
    /// Collecting a frame; its length, or the part of it that tells the length, is so many bytes.
    Frame(usize),
    /// Collecting a frame that only silence ends.
    Open,
    /// Waiting for silence.
    Spoilt(DecodeError),
}

/// The slave's side of a line: takes a frame when it is complete and right, and after anything wrong drops all
/// until silence.
///
/// One exception: a valid frame that starts at most [`STRAY_MAX`] bytes into the burst and ends exactly where it
/// ends is taken, unless it is a broadcast. The data of a frame starts later than that.
///
/// `N` is the longest frame and the stray bytes before it.
#[derive(Debug)]
pub struct FrameDecoder<const N: usize> {
    buffer: [u8; N],
    used: usize,
    overflow: bool,
    state: State,
    silence: Duration,
    last: Instant,
}

impl<const N: usize> FrameDecoder<N> {
    /// A decoder for a line on which `silence` ends a burst.
    #[must_use]
    pub const fn new(silence: Duration) -> Self {
        Self {
            buffer: [0; N],
            used: 0,
            overflow: false,
            state: State::Delivered,
            silence,
            last: Instant::from_micros(0),
        }
    }

    /// Changes the silence that ends a burst.
    pub const fn set_silence(&mut self, silence: Duration) {
        self.silence = silence;
    }

    /// When silence will end what has been received so far; `None` while nothing is pending.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        let pending = self.used > 0 && self.state != State::Delivered;
        pending.then(|| self.last.saturating_add(self.silence))
    }

    /// Takes bytes that ended at `now` until something comes out or none are left; call again while it returns
    /// an event.
    pub fn feed<'s>(
        &'s mut self,
        format: &impl Framing,
        bytes: &mut &[u8],
        now: Instant,
    ) -> Option<Event<'s>> {
        if bytes.is_empty() {
            return None;
        }
        if self.deadline().is_some_and(|end| now >= end) {
            return self.end_of_burst(format);
        }
        if self.state == State::Delivered {
            self.restart();
        }
        self.last = now;
        while let State::Frame(wanted) = self.state {
            let Some((taken, rest)) = bytes.split_at_checked(wanted.saturating_sub(self.used)) else { break };
            self.keep(taken);
            *bytes = rest;
            let prefix = self.buffer.get(..self.used).unwrap_or(&[]);
            self.state = match format.length(prefix) {
                FrameLength::Exactly(length) | FrameLength::AtLeast(length) if length > N => {
                    State::Spoilt(DecodeError::Impossible)
                }
                FrameLength::Exactly(length) | FrameLength::AtLeast(length) if length > self.used => {
                    State::Frame(length)
                }
                FrameLength::Exactly(_) if format.is_valid(prefix) => State::Delivered,
                FrameLength::Exactly(_) => State::Spoilt(DecodeError::Checksum),
                FrameLength::AtLeast(_) | FrameLength::Impossible => State::Spoilt(DecodeError::Impossible),
                FrameLength::UntilSilence => State::Open,
            };
        }
        if self.state == State::Delivered {
            return Some(Event::Frame(self.buffer.get(..self.used).unwrap_or(&[])));
        }
        let rest = core::mem::take(bytes);
        self.keep(rest);
        None
    }

    /// Tells the decoder the time, so that it notices the silence after a burst.
    pub fn poll(&mut self, format: &impl Framing, now: Instant) -> Option<Event<'_>> {
        if self.deadline().is_some_and(|end| now >= end) { self.end_of_burst(format) } else { None }
    }

    fn end_of_burst(&mut self, format: &impl Framing) -> Option<Event<'_>> {
        let open = self.state == State::Open;
        let error = match self.state {
            State::Spoilt(error) => error,
            State::Open => DecodeError::Checksum,
            State::Frame(_) | State::Delivered => DecodeError::Incomplete,
        };
        self.state = State::Delivered;
        let burst = self.buffer.get(..self.used).unwrap_or(&[]);
        if !self.overflow {
            if open && format.is_valid(burst) {
                return Some(Event::Frame(burst));
            }
            let stray_max = if format.forgives_stray_bytes() { STRAY_MAX } else { 0 };
            let fills_the_rest = (1..=stray_max).filter_map(|stray| burst.get(stray..)).find(|frame| {
                let whole = match frame.is_empty() {
                    true => false,
                    false => match format.length(frame) {
                        FrameLength::Exactly(length) => length == frame.len(),
                        FrameLength::UntilSilence => true,
                        FrameLength::AtLeast(_) | FrameLength::Impossible => false,
                    },
                };
                whole && !format.is_broadcast(frame) && format.is_valid(frame)
            });
            if let Some(frame) = fills_the_rest {
                return Some(Event::Frame(frame));
            }
        }
        Some(Event::Dropped { error, burst })
    }

    fn keep(&mut self, bytes: &[u8]) {
        let free = N.saturating_sub(self.used);
        let kept = bytes.get(..free.min(bytes.len())).unwrap_or(&[]);
        self.overflow |= kept.len() < bytes.len();
        let end = self.used.saturating_add(kept.len());
        if let Some(place) = self.buffer.get_mut(self.used..end) {
            wire::copy(kept, place);
            self.used = end;
        }
    }

    const fn restart(&mut self) {
        self.used = 0;
        self.overflow = false;
        self.state = State::Frame(1);
    }
}

/// What a master waits for: up to `L` kinds of frame, told apart by their place.
pub trait Match<const L: usize> {
    /// Length in bytes, checksum included, of each kind; 0 stands for none.
    fn lengths(&self) -> [usize; L];

    /// Whether bytes of that kind's length are such a frame: address, function code and checksum.
    fn accepts(&self, kind: usize, frame: &[u8]) -> bool;
}

/// The master's side of a line: finds the replies it waits for behind any noise.
///
/// Each position is tried once for each kind, so the work is linear and a false start delays nothing.
/// `N` must exceed the longest reply.
#[derive(Debug)]
pub struct ResponseMatcher<const N: usize, const L: usize> {
    buffer: [u8; N],
    used: usize,
    /// First position not yet tried, for each kind.
    next: [usize; L],
    delivered: bool,
}

impl<const N: usize, const L: usize> Default for ResponseMatcher<N, L> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize, const L: usize> ResponseMatcher<N, L> {
    /// A search that has received nothing.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; N], used: 0, next: [0; L], delivered: false }
    }

    /// Forgets what has been received: to be called before anything else is expected.
    pub const fn clear(&mut self) {
        self.used = 0;
        self.next = [0; L];
        self.delivered = false;
    }

    /// Tries all positions anew and keeps the bytes: to be called when the kinds that are waited for have changed.
    pub const fn rescan(&mut self) {
        self.next = [0; L];
    }

    /// Whether bytes came in that belong to no reply so far.
    #[must_use]
    pub const fn has_leftovers(&self) -> bool {
        self.used > 0 && !self.delivered
    }

    /// Takes bytes until a reply is found or none are left; tells its kind.
    pub fn feed(&mut self, wanted: &impl Match<L>, bytes: &mut &[u8]) -> Option<(usize, &[u8])> {
        if self.delivered {
            self.clear();
        }
        let lengths = wanted.lengths();
        while let Some((byte, rest)) = bytes.split_first() {
            *bytes = rest;
            if self.used >= N {
                self.slide(&lengths);
            }
            if let Some(place) = self.buffer.get_mut(self.used) {
                *place = *byte;
                self.used = self.used.wrapping_add(1);
            }
            if let Some((kind, found)) = self.try_positions(wanted, &lengths) {
                self.delivered = true;
                return self.buffer.get(found).map(|frame| (kind, frame));
            }
        }
        None
    }

    /// The line fell silent: a reply of unknown length, of which `accepts` tells, may end here.
    pub fn end_of_frame(&mut self, accepts: impl Fn(&[u8]) -> bool) -> Option<&[u8]> {
        let start = (0..self.used).find(|&start| self.buffer.get(start..self.used).is_some_and(&accepts))?;
        self.delivered = true;
        self.buffer.get(start..self.used)
    }

    fn try_positions(
        &mut self,
        wanted: &impl Match<L>,
        lengths: &[usize; L],
    ) -> Option<(usize, core::ops::Range<usize>)> {
        for (kind, (length, next)) in lengths.iter().zip(&mut self.next).enumerate() {
            while *length > 0 && next.saturating_add(*length) <= self.used {
                let range = *next..next.saturating_add(*length);
                *next = next.wrapping_add(1);
                if self.buffer.get(range.clone()).is_some_and(|frame| wanted.accepts(kind, frame)) {
                    return Some((kind, range));
                }
            }
        }
        None
    }

    /// Drops the bytes that can no longer start a reply; all, where no kind has a length.
    fn slide(&mut self, lengths: &[usize; L]) {
        let tried = lengths.iter().zip(self.next).filter(|(length, _)| **length > 0);
        let done = tried.map(|(_, next)| next).min().filter(|done| *done > 0).unwrap_or(self.used);
        wire::close_gap(self.buffer.get_mut(..self.used).unwrap_or_default(), done);
        self.used = self.used.saturating_sub(done);
        self.next = self.next.map(|next| next.saturating_sub(done));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    /// `[length, …, sum]`: a toy with all that a format can say; length 0 ends by silence, above 8 is impossible.
    struct Toy;

    impl Framing for Toy {
        fn length(&self, prefix: &[u8]) -> FrameLength {
            match prefix[0] {
                0 => FrameLength::UntilSilence,
                1 if prefix.len() < 3 => FrameLength::AtLeast(3),
                1 => FrameLength::Exactly(3 + usize::from(prefix[2])),
                length @ 2..=8 => FrameLength::Exactly(length.into()),
                _ => FrameLength::Impossible,
            }
        }
        fn is_valid(&self, frame: &[u8]) -> bool {
            let (sum, content) = frame.split_last().unwrap();
            content.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)) == *sum
        }
        fn is_broadcast(&self, frame: &[u8]) -> bool {
            frame.get(1) == Some(&0xFF)
        }
    }

    const SILENCE: Duration = Duration::from_millis(20);

    #[derive(Debug, PartialEq)]
    enum Out {
        Frame(Vec<u8>),
        Dropped(DecodeError),
    }

    fn out(event: Event<'_>) -> Out {
        match event {
            Event::Frame(frame) => Out::Frame(frame.into()),
            Event::Dropped { error, .. } => Out::Dropped(error),
        }
    }

    /// Feeds each burst in pieces of every size, and a silence after it.
    fn run(bursts: &[&[u8]]) -> Vec<Out> {
        let mut results: Vec<Vec<Out>> = Vec::new();
        for piece in 1..=12 {
            let mut decoder = FrameDecoder::<12>::new(SILENCE);
            let (mut now, mut found) = (Instant::from_micros(5), Vec::new());
            for burst in bursts {
                for mut chunk in burst.chunks(piece) {
                    while let Some(event) = decoder.feed(&Toy, &mut chunk, now) {
                        found.push(out(event));
                    }
                    assert!(chunk.is_empty());
                    now = now.saturating_add(Duration::from_millis(1));
                }
                now = now.saturating_add(SILENCE);
                found.extend(decoder.poll(&Toy, now).map(out));
                assert_eq!(decoder.deadline(), None);
            }
            results.push(found);
        }
        assert!(results.iter().all(|found| *found == results[0]), "pieces change the outcome: {results:?}");
        results.remove(0)
    }

    #[test]
    fn frames_back_to_back_are_taken_without_silence() {
        assert_eq!(
            run(&[&[3, 1, 4, 4, 9, 9, 22, 1, 7, 2, 5, 15]]),
            [
                Out::Frame([3, 1, 4].into()),
                Out::Frame([4, 9, 9, 22].into()),
                Out::Frame([1, 7, 2, 5, 15].into())
            ]
        );
    }

    #[test]
    fn after_a_wrong_frame_nothing_is_taken_until_silence() {
        assert_eq!(
            run(&[&[3, 1, 5, 3, 1, 4, 3, 1, 4], &[3, 1, 4]]),
            [Out::Dropped(DecodeError::Checksum), Out::Frame([3, 1, 4].into())]
        );
        assert_eq!(run(&[&[99, 1, 2, 3, 9, 3, 1, 4]]), [Out::Dropped(DecodeError::Impossible)]);
        assert_eq!(run(&[&[8, 3, 1, 4]]), [Out::Frame([3, 1, 4].into())], "one stray byte in front");
        assert_eq!(run(&[&[8, 9, 9, 9, 9, 3, 1]]), [Out::Dropped(DecodeError::Incomplete)]);
    }

    #[test]
    fn stray_bytes_in_front_are_forgiven_up_to_four_and_never_for_a_broadcast() {
        for stray in 1..=6 {
            let mut burst = std::vec![200; stray];
            burst.extend([3, 1, 4]);
            let expected = match stray {
                ..=STRAY_MAX => Out::Frame([3, 1, 4].into()),
                _ => Out::Dropped(DecodeError::Impossible),
            };
            assert_eq!(run(&[&burst]), [expected], "{stray} stray bytes");
        }
        assert_eq!(run(&[&[200, 3, 0xFF, 2]]), [Out::Dropped(DecodeError::Impossible)]);
        assert_eq!(run(&[&[3, 0xFF, 2]]), [Out::Frame([3, 0xFF, 2].into())]);
        assert_eq!(
            run(&[&[200, 3, 1, 4, 7]]),
            [Out::Dropped(DecodeError::Impossible)],
            "does not fill the burst"
        );
    }

    #[test]
    fn silence_ends_what_has_no_length_of_its_own() {
        assert_eq!(run(&[&[0, 5, 5, 10]]), [Out::Frame([0, 5, 5, 10].into())]);
        assert_eq!(run(&[&[0, 5, 5, 11]]), [Out::Dropped(DecodeError::Checksum)]);
        assert_eq!(run(&[&[200, 0, 5, 5, 10]]), [Out::Frame([0, 5, 5, 10].into())]);
    }

    #[test]
    fn an_endless_burst_is_bounded_and_dropped_once() {
        let noise = [0x55; 300];
        assert_eq!(
            run(&[&noise, &[3, 1, 4]]),
            [Out::Dropped(DecodeError::Impossible), Out::Frame([3, 1, 4].into())]
        );
        let mut open = [1; 300];
        open[0] = 0;
        assert_eq!(run(&[&open]), [Out::Dropped(DecodeError::Checksum)]);
        assert_eq!(
            run(&[&[1, 0, 250, 9]]),
            [Out::Dropped(DecodeError::Impossible)],
            "longer than the buffer"
        );
    }

    #[test]
    fn silence_is_noticed_by_the_next_byte_as_well() {
        let mut decoder = FrameDecoder::<12>::new(SILENCE);
        let start = Instant::from_micros(0);
        assert_eq!(decoder.feed(&Toy, &mut &[3, 1][..], start), None);
        let mut next = &[3, 1, 4][..];
        let later = start.saturating_add(SILENCE);
        assert_eq!(
            decoder.feed(&Toy, &mut next, later).map(out),
            Some(Out::Dropped(DecodeError::Incomplete))
        );
        assert_eq!(next.len(), 3, "the new burst is still to be fed");
        assert_eq!(decoder.feed(&Toy, &mut next, later).map(out), Some(Out::Frame([3, 1, 4].into())));
    }

    struct Reply;

    impl Match<2> for Reply {
        fn lengths(&self) -> [usize; 2] {
            [6, 3]
        }
        fn accepts(&self, kind: usize, frame: &[u8]) -> bool {
            assert_eq!(frame.len(), self.lengths()[kind]);
            frame[0] == 7 && Toy.is_valid(frame)
        }
    }

    #[test]
    fn a_reply_that_was_begun_is_found_though_the_kinds_change() {
        /// First waits for a reply of three bytes, then in the same place for one of six.
        struct One(usize);
        impl Match<1> for One {
            fn lengths(&self) -> [usize; 1] {
                [self.0]
            }
            fn accepts(&self, _: usize, frame: &[u8]) -> bool {
                frame[0] == 7 && frame.len() == 6
            }
        }
        let mut search = ResponseMatcher::<16, 1>::default();
        assert_eq!(search.feed(&One(3), &mut &[7, 1, 1, 1][..]), None);
        search.rescan();
        assert_eq!(search.feed(&One(6), &mut &[1, 11][..]), Some((0, &[7, 1, 1, 1, 1, 11][..])));
    }

    #[test]
    fn the_reply_is_found_behind_noise_of_any_length() {
        for (kind, reply, noise) in [(0, &[7, 1, 1, 1, 1, 11][..], 7), (1, &[7, 2, 9], 7), (1, &[7, 2, 9], 1)]
        {
            for length in 0..40 {
                let mut search = ResponseMatcher::<16, 2>::default();
                let mut stream = std::vec![noise; length];
                stream.extend_from_slice(reply);
                stream.push(77);
                let mut rest = &stream[..];
                assert_eq!(search.feed(&Reply, &mut rest), Some((kind, reply)), "{length} bytes of noise");
                assert_eq!(rest, [77]);
                assert!(!search.has_leftovers());
                assert_eq!(search.feed(&Reply, &mut rest), None);
                assert!(search.has_leftovers());
            }
        }
    }

    #[test]
    fn a_reply_of_unknown_length_ends_at_silence() {
        let mut search = ResponseMatcher::<16, 2>::default();
        assert_eq!(search.feed(&Reply, &mut &[1, 2, 7, 5, 5, 17][..]), None);
        let accepts = |frame: &[u8]| frame[0] == 7 && frame.len() > 2 && Toy.is_valid(frame);
        assert_eq!(search.end_of_frame(accepts), Some(&[7, 5, 5, 17][..]));
    }
}
