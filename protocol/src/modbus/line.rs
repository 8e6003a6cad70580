//! A server's place on a line that it shares with other servers.

use core::ops::RangeInclusive;

use super::rtu::{self, ExpectedResponse, FRAME_MAX, Frame, request_length};
use super::{BROADCAST, FunctionCode, Request, packed_len};
use crate::checksum;
use crate::decode::{
    self, DecodeError, Dropped, FrameDecoder, FrameEvent, FrameLength, Framing, MultidropEvent,
};
use crate::time::{Duration, Instant};

/// What comes out of a [`MultidropDecoder`].
pub type Event<'a> = MultidropEvent<Frame<'a>, DecodeError>;

/// RTU frames out of the bytes of a line with several servers, of which some units are ours.
///
/// Requests to other servers and their responses are told apart and passed over, each as soon as it is complete, so
/// that nothing in them is ever taken for a request to us; a server that does not answer is not waited for. After
/// anything wrong nothing is taken until silence. Stray bytes in front of a frame are not forgiven, as
/// [`FrameDecoder`] does on a line of one's own: the data of a response starts too early for that.
///
/// After power-up and after anything wrong the next frame of another server may be a response to a request that was not
/// heard, and is checked as such too.
///
/// Bytes that our own transmitter sends are not to be fed.
///
/// A frame of another server that is valid up to some length, and by its first bytes can as well be the start of a
/// longer one, is passed over at the next silence, or once the longer one is complete. So the line may do without the
/// silence between frames that Modbus demands, but for such a pair: a request sent again in the middle of which the
/// response to the first one could end, or the other way round.
#[derive(Debug)]
pub struct MultidropDecoder {
    decoder: FrameDecoder<FRAME_MAX>,
    parties: Parties,
}

/// Who is on the line, and who is about to answer.
#[derive(Debug)]
struct Parties {
    first: u8,
    last: u8,
    due: Due,
}

/// Which response may come next.
#[derive(Debug)]
enum Due {
    /// None: the last request is answered, or was ours.
    Nothing,
    /// The one to the last request.
    To(ExpectedResponse),
    /// Any: the last request was not heard, or not heard well.
    Unknown,
}

impl MultidropDecoder {
    /// A line on which `units` are ours and `silence` ends a frame: 3.5 characters, or 1.75 ms above 19200 baud
    /// ("Modbus over Serial Line", 2.5.1.1), or more where bytes come late.
    #[must_use]
    pub const fn new(units: RangeInclusive<u8>, silence: Duration) -> Self {
        let parties = Parties { first: *units.start(), last: *units.end(), due: Due::Unknown };
        Self { decoder: FrameDecoder::new(silence), parties }
    }

    /// Changes the silence that ends a frame.
    pub const fn set_silence(&mut self, silence: Duration) {
        self.decoder.set_silence(silence);
    }

    /// When silence will end what has been received so far; `None` while nothing is pending.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        self.decoder.deadline()
    }

    /// Takes bytes that ended at `now` until something was heard or none are left; call again while something was.
    pub fn feed(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Event<'_>> {
        let event = self.decoder.feed(&self.parties, bytes, now)?;
        Some(self.parties.classify(event))
    }

    /// Tells the time, so that silence is noticed.
    pub fn poll(&mut self, now: Instant) -> Option<Event<'_>> {
        let event = self.decoder.poll(&self.parties, now)?;
        Some(self.parties.classify(event))
    }
}

impl Parties {
    const fn are_meant(&self, unit: u8) -> bool {
        unit == BROADCAST || (self.first <= unit && unit <= self.last)
    }

    fn classify<'a>(&mut self, event: FrameEvent<'a>) -> Event<'a> {
        let bytes = match event {
            decode::Event::Frame(frame) => frame,
            // silence ended the shorter one of two frames that it could have been
            decode::Event::Dropped(Dropped { error: DecodeError::Incomplete, burst })
                if self.is_whole(burst) =>
            {
                burst
            }
            decode::Event::Dropped(Dropped { error, .. }) => {
                self.due = Due::Unknown;
                return Event::Dropped(error);
            }
        };
        // the checksum was looked at when the frame was found
        let [unit, pdu @ .., _, _] = bytes else { return Event::Dropped(DecodeError::Incomplete) };
        let (unit, frame) = (*unit, Frame { unit: *unit, pdu });
        let due = core::mem::replace(&mut self.due, Due::Nothing);
        if self.are_meant(unit) {
            return Event::Frame(frame);
        }
        let is_response = match due {
            Due::Nothing => false,
            Due::To(expected) => expected.unit() == unit && expected.accepts_pdu(pdu),
            Due::Unknown => {
                let length = request_length(bytes);
                length != FrameLength::Exactly(bytes.len()) && length != FrameLength::UntilSilence
            }
        };
        if !is_response {
            self.due = match Request::decode(pdu) {
                Ok(request) => Due::To(ExpectedResponse::new(unit, &request)),
                Err(_) => Due::Unknown,
            };
        }
        Event::Foreign(frame)
    }

    /// Whether a burst is a frame of another server, valid at one of the lengths that it can have.
    fn is_whole(&self, burst: &[u8]) -> bool {
        let exactly = FrameLength::Exactly(burst.len());
        let [request, response] = self.lengths(burst);
        burst.first().is_some_and(|unit| !self.are_meant(*unit))
            && (request == exactly || response == exactly)
            && checksum::strip_crc(burst).is_some()
    }

    /// Length of the frame that starts with `prefix`, as a request and as the response that is due.
    fn lengths(&self, prefix: &[u8]) -> [FrameLength; 2] {
        let response = match (&self.due, prefix) {
            (Due::Nothing, _) => FrameLength::Impossible,
            (Due::To(expected), _) => expected.frame_length(prefix),
            (Due::Unknown, [unit, function, ..]) => {
                let function = FunctionCode::from_code(function & !FunctionCode::EXCEPTION_FLAG);
                ExpectedResponse::any(*unit, function).frame_length(prefix)
            }
            (Due::Unknown, _) => FrameLength::AtLeast(2),
        };
        let request = match response {
            FrameLength::Impossible => request_length(prefix),
            _ if counts_wrong(prefix) => FrameLength::Impossible,
            _ => request_length(prefix),
        };
        [request, response]
    }
}

/// Whether what starts as a write of several coils or registers has a byte count that does not fit its quantity: then
/// it rather is the response to one, and the byte belongs to the CRC.
fn counts_wrong(prefix: &[u8]) -> bool {
    let Some([_, function, _, _, high, low, count]) = prefix.first_chunk::<7>() else { return false };
    let quantity = u16::from_be_bytes([*high, *low]);
    match FunctionCode::from_code(*function) {
        FunctionCode::WriteMultipleCoils => packed_len(quantity) != usize::from(*count),
        FunctionCode::WriteMultipleRegisters => quantity.checked_mul(2) != Some(u16::from(*count)),
        _ => false,
    }
}

/// What is left of the longer frame can hold no other one if it has at most so many bytes.
const HARMLESS: usize = rtu::FRAME_MIN - 1;

impl Framing for Parties {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        use FrameLength::{AtLeast, Exactly, Impossible, UntilSilence};
        let [request, response] = match prefix.first() {
            Some(unit) if self.are_meant(*unit) => return request_length(prefix),
            _ => self.lengths(prefix),
        };
        let (short, long) = match (request, response) {
            (Impossible, length) | (length, Impossible) => return length,
            (UntilSilence, _) | (_, UntilSilence) => return UntilSilence,
            (Exactly(a) | AtLeast(a), Exactly(b) | AtLeast(b)) => (a.min(b), a.max(b)),
        };
        let used = prefix.len();
        let is_frame = [request, response].contains(&Exactly(used)) && checksum::strip_crc(prefix).is_some();
        match used {
            _ if used < short => AtLeast(short),
            _ if is_frame && long.saturating_sub(used) <= HARMLESS => Exactly(used),
            _ if used < long => AtLeast(long),
            _ => Exactly(used),
        }
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        Frame::decode(frame).is_ok()
    }

    fn is_broadcast(&self, frame: &[u8]) -> bool {
        frame.first() == Some(&BROADCAST)
    }

    fn forgives_stray_bytes(&self) -> bool {
        false
    }
}
