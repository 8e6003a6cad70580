use super::{DecodeError, Dropped, Event, FrameEvent, FrameLength, Framing, STRAY_MAX};
use crate::time::{Duration, Instant};
use crate::wire;

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
    ) -> Option<FrameEvent<'s>> {
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
    pub fn poll(&mut self, format: &impl Framing, now: Instant) -> Option<FrameEvent<'_>> {
        if self.deadline().is_some_and(|end| now >= end) { self.end_of_burst(format) } else { None }
    }

    fn end_of_burst(&mut self, format: &impl Framing) -> Option<FrameEvent<'_>> {
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
        Some(Event::Dropped(Dropped { error, burst }))
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
