//! A device's place on an RS485 line that it shares with other NST devices.

use core::ops::RangeInclusive;

use super::register::{self, Access};
use super::serial::{self, ExpectedResponse, Frame, OVERHEAD, REQUEST_MAX, RESPONSE_MAX, request_length};
use super::{BROADCAST, COMMAND_LENGTH, FunctionCode, Request};
use crate::checksum;
use crate::decode::{DecodeError, FrameLength, MultidropEvent};
use crate::time::{Duration, Instant};
use crate::wire;

/// What comes out of a [`MultidropDecoder`].
pub type Event<'a> = MultidropEvent<Frame<'a>, DecodeError>;

/// Length of the frame of a command, and of the shortest request.
const COMMAND: usize = COMMAND_LENGTH + OVERHEAD;

/// What is left of a longer frame can hold no request if it has at most so many bytes.
const HARMLESS: usize = COMMAND - 1;

/// The longest frame.
const FRAME_MAX: usize = if REQUEST_MAX > RESPONSE_MAX { REQUEST_MAX } else { RESPONSE_MAX };

/// Requests out of the bytes of a line with several NST devices, of which some addresses are ours.
///
/// Requests to other devices and their responses are told apart by their lengths and passed over, each as soon as it is
/// complete: no silence is needed between frames, nothing in them is ever taken for a request to us, and a device that
/// does not answer is not waited for.
///
/// After something wrong nothing is executed before one of these has shown where frames start: silence, or a request to
/// another device with its response right behind it. A response that is due, has the right head and a wrong checksum ends
/// where its length says.
///
/// The acknowledgement of a write can by its first five bytes, checksum included, be the start of another write to the
/// same device, of five bytes and more. It is passed over once those bytes can't be such a write, or at the next
/// silence. A write that no device would carry out is not considered.
///
/// Bytes that our own transmitter sends are not to be fed.
///
/// ```
/// use jointbus_protocol::nst::line::{Event, MultidropDecoder};
/// use jointbus_protocol::nst::{Daq, RamHardware, SignEncoding, serial};
/// use jointbus_protocol::time::{Duration, Instant};
///
/// let mut daq = Daq::new(RamHardware::new(1), SignEncoding::TwosComplement);
/// let mut line = MultidropDecoder::new(1..=1, Duration::from_micros(1750));
/// let mut out = [0; serial::RESPONSE_MAX];
///
/// // from the UART: device 2 is asked for its address and answers, then we are asked to set zero (4.3.1.7)
/// let mut received = &[
///     0x02, 0x03, 0x01, 0x93, 0x01, 0xA1, 0x74, 0x02, 0x03, 0x01, 0x02, 0x71, 0xCD, 0x01, 0x12, 0x01, 0xA7, 0x18, 0x37, 0x42,
/// ][..];
/// let mut foreign = 0;
/// while let Some(event) = line.feed(&mut received, Instant::from_micros(500)) {
///     match event {
///         // to the UART
///         Event::Frame(frame) => assert_eq!(daq.serve_frame(&frame, &mut out)?, [0x01, 0x12, 0x18, 0x2C, 0xAA]),
///         Event::Foreign(_) => foreign += 1,
///         Event::Dropped(error) => panic!("{error:?}"),
///     }
/// }
/// assert_eq!(foreign, 2);
/// # Ok::<(), jointbus_protocol::nst::NoResponse>(())
/// ```
#[derive(Debug)]
pub struct MultidropDecoder {
    buffer: [u8; FRAME_MAX],
    /// The first byte that is not done with.
    start: usize,
    used: usize,
    state: State,
    due: Due,
    first: u8,
    last: u8,
    silence: Duration,
    heard: Instant,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// The next byte starts a frame.
    InStep,
    /// Nobody knows where a frame starts; a request to another device is looked for.
    Lost,
    /// That request was found; its response must be next.
    Probation,
}

/// Which response may come next.
#[derive(Debug, Clone, Copy)]
enum Due {
    /// None: the last request is answered, or was ours.
    Nothing,
    /// The one to the last request.
    To(ExpectedResponse),
    /// Any: the last request was not heard.
    Unknown,
}

/// What the bytes at hand are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    /// So many bytes are needed to tell.
    Need(usize),
    /// A frame of so many bytes.
    Frame(usize),
    /// A frame of so many bytes without doubt, its checksum wrong.
    Damaged(usize),
    /// No frame.
    Wrong(DecodeError),
}

/// What is to be told of the bytes at hand.
enum Told {
    /// A frame of so many bytes, and whether it is for us.
    Frame(usize, bool),
    Dropped(DecodeError),
}

impl MultidropDecoder {
    /// A line on which `addresses` are ours and `silence` ends a frame. The manual names none; 3.5 characters, or 1.75 ms
    /// above 19200 baud, is what Modbus has.
    #[must_use]
    pub const fn new(addresses: RangeInclusive<u8>, silence: Duration) -> Self {
        Self {
            buffer: [0; FRAME_MAX],
            start: 0,
            used: 0,
            state: State::InStep,
            due: Due::Unknown,
            first: *addresses.start(),
            last: *addresses.end(),
            silence,
            heard: Instant::from_micros(0),
        }
    }

    /// Changes the addresses that are ours: after a restart with another one.
    pub const fn set_addresses(&mut self, addresses: RangeInclusive<u8>) {
        (self.first, self.last) = (*addresses.start(), *addresses.end());
    }

    /// Changes the silence that ends a frame.
    pub const fn set_silence(&mut self, silence: Duration) {
        self.silence = silence;
    }

    /// When silence will end what has been received so far; `None` while nothing is pending.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        let pending = self.used > self.start || self.state != State::InStep;
        pending.then(|| self.heard.saturating_add(self.silence))
    }

    /// Takes bytes that ended at `now` until there is an event or none are left; call again while there is one.
    pub fn feed(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Event<'_>> {
        if !bytes.is_empty() {
            if self.deadline().is_some_and(|end| now >= end)
                && let Some(told) = self.end_of_frame()
            {
                return Some(self.event(told));
            }
            self.heard = now;
        }
        loop {
            match self.step() {
                Ok(told) => return Some(self.event(told)),
                Err(length) if bytes.is_empty() || length > FRAME_MAX => return None,
                Err(length) => self.fill(length, bytes),
            }
        }
    }

    /// Tells the time, so that silence is noticed.
    pub fn poll(&mut self, now: Instant) -> Option<Event<'_>> {
        if self.deadline().is_none_or(|end| now < end) {
            return None;
        }
        let told = self.end_of_frame()?;
        Some(self.event(told))
    }

    /// Silence: the next byte starts a frame. What it has ended, if that was not told before.
    fn end_of_frame(&mut self) -> Option<Told> {
        let state = core::mem::replace(&mut self.state, State::InStep);
        let length = self.pending().len();
        // the shorter one of two frames that it could have been
        let whole = self.lengths(self.pending()).contains(&FrameLength::Exactly(length))
            && !self.is_ours(self.pending())
            && checksum::strip_crc(self.pending()).is_some();
        match (state, length) {
            (State::InStep, 1..) if whole => {
                self.follow(length);
                Some(Told::Frame(length, false))
            }
            (State::InStep, 1..) => {
                self.forget();
                Some(Told::Dropped(DecodeError::Incomplete))
            }
            _ => {
                self.forget();
                None
            }
        }
    }

    fn forget(&mut self) {
        (self.start, self.used, self.due) = (0, 0, Due::Unknown);
    }

    fn event(&mut self, told: Told) -> Event<'_> {
        let (length, ours) = match told {
            Told::Frame(length, ours) => (length, ours),
            Told::Dropped(error) => return Event::Dropped(error),
        };
        let start = self.start;
        self.start = start.saturating_add(length);
        // its checksum was looked at when its length was told
        match self.buffer.get(start..self.start) {
            Some([address, body @ .., _, _]) => {
                let frame = Frame { address: *address, body };
                if ours { Event::Frame(frame) } else { Event::Foreign(frame) }
            }
            _ => Event::Dropped(DecodeError::Incomplete),
        }
    }

    fn pending(&self) -> &[u8] {
        self.buffer.get(self.start..self.used).unwrap_or(&[])
    }

    /// Takes bytes until `length` are pending or none are left.
    fn fill(&mut self, length: usize, bytes: &mut &[u8]) {
        if self.start.saturating_add(length) > FRAME_MAX {
            wire::close_gap(self.buffer.get_mut(..self.used).unwrap_or_default(), self.start);
            self.used = self.used.saturating_sub(self.start);
            self.start = 0;
        }
        let wanted = length.saturating_sub(self.pending().len()).min(bytes.len());
        let Some((taken, rest)) = bytes.split_at_checked(wanted) else { return };
        let end = self.used.saturating_add(wanted);
        if let Some(place) = self.buffer.get_mut(self.used..end) {
            wire::copy(taken, place);
            self.used = end;
        }
        *bytes = rest;
    }

    /// On to what is to be told next, or to how many bytes must be pending for it.
    fn step(&mut self) -> Result<Told, usize> {
        loop {
            let verdict = match self.state {
                State::InStep => self.verdict(self.pending()),
                State::Probation => self.verdict_on_response(self.pending()),
                State::Lost => self.verdict_on_request(self.pending()),
            };
            match (verdict, self.state) {
                (Verdict::Need(length), _) => return Err(length),
                (Verdict::Frame(length), state) => {
                    let ours = self.is_ours(self.pending());
                    match ours {
                        true => self.due = Due::Nothing,
                        false => self.follow(length),
                    }
                    self.state = if state == State::Lost { State::Probation } else { State::InStep };
                    return Ok(Told::Frame(length, ours));
                }
                (Verdict::Damaged(length), _) => {
                    self.start = self.start.saturating_add(length);
                    self.due = Due::Nothing;
                    return Ok(Told::Dropped(DecodeError::Checksum));
                }
                (Verdict::Wrong(_), State::Probation) => self.state = State::Lost,
                (Verdict::Wrong(error), state) => {
                    // a frame may start at any byte from here on
                    self.start = self.start.saturating_add(1).min(self.used);
                    self.state = State::Lost;
                    if state == State::InStep {
                        return Ok(Told::Dropped(error));
                    }
                }
            }
        }
    }

    /// Whether a frame starts like one to us or to all.
    fn is_ours(&self, frame: &[u8]) -> bool {
        let meant = |address: &u8| *address == BROADCAST || (self.first <= *address && *address <= self.last);
        frame.first().is_some_and(meant)
    }

    /// A frame of others has passed: which response may come next.
    fn follow(&mut self, length: usize) {
        let frame = self.pending().get(..length).unwrap_or(&[]);
        // what can be a request is taken for one: a response that does not come is not waited for
        self.due = match frame {
            [address, body @ .., _, _] => match Request::decode(body) {
                Ok(request) => Due::To(ExpectedResponse::new(*address, &request)),
                Err(_) => Due::Nothing,
            },
            _ => Due::Nothing,
        };
    }

    /// Length of the frame that starts with `prefix`, as a request and as the response that is due.
    fn lengths(&self, prefix: &[u8]) -> [FrameLength; 2] {
        let response = match self.due {
            _ if self.is_ours(prefix) => FrameLength::Impossible,
            Due::Nothing => FrameLength::Impossible,
            Due::To(expected) => expected.frame_length(prefix),
            Due::Unknown => serial::response_length(prefix),
        };
        match response {
            FrameLength::Impossible => [request_length(prefix), response],
            _ if is_plausible(prefix) => [request_length(prefix), response],
            _ => [FrameLength::Impossible, response],
        }
    }

    /// Checks what starts with a frame.
    fn verdict(&self, pending: &[u8]) -> Verdict {
        use FrameLength::{AtLeast, Exactly, Impossible, UntilSilence};
        if pending.is_empty() {
            return Verdict::Need(1);
        }
        let (short, long) = match self.lengths(pending).map(|length| match length {
            UntilSilence => Impossible,
            length => length,
        }) {
            [Impossible, Impossible] => return Verdict::Wrong(DecodeError::Impossible),
            [Impossible, response] => return whole(pending, response, self.is_certain(pending)),
            [request, Impossible] => return whole(pending, request, false),
            [Exactly(a) | AtLeast(a), Exactly(b) | AtLeast(b)] => (a.min(b), a.max(b)),
            _ => return Verdict::Wrong(DecodeError::Impossible),
        };
        if pending.len() < short {
            return Verdict::Need(short);
        }
        if long.saturating_sub(short) <= HARMLESS && is_valid(pending, short) {
            return Verdict::Frame(short);
        }
        whole(pending, if pending.len() < long { AtLeast(long) } else { Exactly(long) }, false)
    }

    /// Whether the length of the response that starts here is beyond doubt though its checksum may be wrong: it has the
    /// head that is due, and is no request, which would name a register that no device has.
    fn is_certain(&self, pending: &[u8]) -> bool {
        matches!(self.due, Due::To(expected) if expected.function().is_read()) && !is_valid(pending, COMMAND)
    }

    /// Checks what must start with the response that is due.
    fn verdict_on_response(&self, pending: &[u8]) -> Verdict {
        let [_, response] = self.lengths(pending);
        whole(pending, response, false)
    }

    /// Checks what may start with a request to another device.
    fn verdict_on_request(&self, pending: &[u8]) -> Verdict {
        if self.is_ours(pending) || !is_plausible(pending) {
            return Verdict::Wrong(DecodeError::Impossible);
        }
        match pending.len() {
            ..=COMMAND_LENGTH => Verdict::Need(COMMAND),
            _ => whole(pending, request_length(pending), false),
        }
    }
}

/// Whether the first `length` bytes are there and have the right checksum.
fn is_valid(pending: &[u8], length: usize) -> bool {
    pending.get(..length).is_some_and(|frame| checksum::strip_crc(frame).is_some())
}

/// Checks a frame that can have one length.
fn whole(pending: &[u8], length: FrameLength, certain: bool) -> Verdict {
    match length {
        FrameLength::AtLeast(length) => Verdict::Need(length),
        FrameLength::Exactly(length) if pending.len() < length => Verdict::Need(length),
        FrameLength::Exactly(length) if is_valid(pending, length) => Verdict::Frame(length),
        FrameLength::Exactly(length) if certain => Verdict::Damaged(length),
        FrameLength::Exactly(_) => Verdict::Wrong(DecodeError::Checksum),
        FrameLength::Impossible | FrameLength::UntilSilence => Verdict::Wrong(DecodeError::Impossible),
    }
}

/// Whether a device would carry out the request that starts so, as far as it is there.
fn is_plausible(prefix: &[u8]) -> bool {
    let (function, high, rest) = match prefix {
        [_, function, high, rest @ ..] => (FunctionCode::from_code(*function), *high, rest),
        [_, function] => return !matches!(FunctionCode::from_code(*function), FunctionCode::Unknown(_)),
        _ => return true,
    };
    let [low, length, ..] = rest else { return u16::from_be_bytes([high, 0]) <= register::DATA.last() };
    let first = u16::from_be_bytes([high, *low]);
    let last = first.saturating_add((*length).into()).saturating_sub(1);
    let mut touched = register::TABLE.iter().filter(|register| register.meets(first, last));
    match function {
        FunctionCode::Unknown(_) => false,
        _ if *length == 0 || last > register::DATA.last() => false,
        FunctionCode::Write => touched.all(|register| register.access == Access::ReadWrite),
        _ => true,
    }
}
