//! ASCII framing: colon, hexadecimal characters of unit address, protocol data unit and LRC, CR LF ("Modbus over
//! Serial Line", 2.5.2).
//!
//! Upper case is sent, both cases are taken. The delimiter LF is fixed: function code 08 with sub-function 03 changes
//! nothing here.

use super::{PDU_MAX, Request, Response};
use crate::checksum;
use crate::decode;
use crate::error::error_text;
use crate::time::Instant;
use crate::wire::{NoSpace, Writer};

/// Longest frame in characters.
pub const FRAME_MAX: usize = frame_length(CONTENT_MAX);

/// Shortest frame in characters: unit address, function code, LRC.
pub const FRAME_MIN: usize = frame_length(2);

/// Longest content in bytes: unit address and protocol data unit.
pub const CONTENT_MAX: usize = 1 + PDU_MAX;

const _: () = assert!(FRAME_MAX == 513 && content_length(FRAME_MAX) == CONTENT_MAX);

/// Characters around the pairs: colon, CR, LF.
const DELIMITERS: usize = 3;

/// Characters of a frame with so many bytes of content: unit address and protocol data unit.
#[must_use]
pub const fn frame_length(content: usize) -> usize {
    content.saturating_add(1).saturating_mul(2).saturating_add(DELIMITERS)
}

/// Bytes of content for which a frame of so many characters has room.
pub(super) const fn content_length(frame: usize) -> usize {
    (frame.saturating_sub(DELIMITERS) / 2).saturating_sub(1)
}

/// A frame whose LRC was right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame<'a> {
    /// Unit address.
    pub unit: u8,
    /// Function code and data.
    pub pdu: &'a [u8],
}

/// Why characters are no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// Something other than a hexadecimal character between colon and CR LF.
    Character(u8),
    /// A single character where a pair stands for a byte, or fewer bytes than unit address, function code and LRC.
    Length,
    /// The LRC does not fit.
    Checksum,
    /// No CR LF within [`FRAME_MAX`] characters.
    Endless,
    /// A colon inside a frame: it starts the next one.
    Restarted,
    /// No colon in front, or no CR LF behind: only [`Frame::decode`] says so.
    Delimiter,
}

impl<'a> Frame<'a> {
    /// Checks a whole frame and takes it apart; its bytes are put into `buffer`.
    ///
    /// # Errors
    /// [`FrameError`], and [`FrameError::Endless`] where `buffer` has no room as well.
    pub fn decode(frame: &[u8], buffer: &'a mut [u8]) -> Result<Self, FrameError> {
        let pairs = frame.strip_prefix(b":").and_then(|rest| rest.strip_suffix(b"\r\n"));
        let pairs = pairs.ok_or(FrameError::Delimiter)?;
        if frame.len() > FRAME_MAX {
            return Err(FrameError::Endless);
        }
        let mut writer = Writer::new(buffer);
        let (pairs, single) = pairs.as_chunks::<2>();
        for [high, low] in pairs {
            let byte = nibble(*high)? << 4 | nibble(*low)?;
            writer.u8(byte).map_err(|NoSpace| FrameError::Endless)?;
        }
        if let Some(character) = single.first() {
            nibble(*character)?;
            return Err(FrameError::Length);
        }
        Self::of(writer.finish())
    }

    /// Checks unit address, data unit and LRC.
    fn of(bytes: &'a [u8]) -> Result<Self, FrameError> {
        let [unit, pdu @ .., _] = bytes else { return Err(FrameError::Length) };
        if pdu.is_empty() {
            return Err(FrameError::Length);
        }
        // with its LRC the sum is 0
        if checksum::lrc(bytes) != 0 {
            return Err(FrameError::Checksum);
        }
        Ok(Self { unit: *unit, pdu })
    }
}

const fn nibble(character: u8) -> Result<u8, FrameError> {
    match character {
        b'0'..=b'9' => Ok(character.wrapping_sub(b'0')),
        b'A'..=b'F' => Ok(character.wrapping_sub(b'A').wrapping_add(10)),
        b'a'..=b'f' => Ok(character.wrapping_sub(b'a').wrapping_add(10)),
        _ => Err(FrameError::Character(character)),
    }
}

const fn character(nibble: u8) -> u8 {
    match nibble {
        0..=9 => nibble.wrapping_add(b'0'),
        _ => nibble.wrapping_sub(10).wrapping_add(b'A'),
    }
}

/// Writes a request as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_request<'b>(
    unit: u8,
    request: &Request<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    encode(unit, buffer, |writer| request.encode(writer))
}

/// Writes a response as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_response<'b>(
    unit: u8,
    response: &Response<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    encode(unit, buffer, |writer| response.encode(writer))
}

fn encode(
    unit: u8,
    buffer: &mut [u8],
    pdu: impl FnOnce(&mut Writer<'_>) -> Result<(), NoSpace>,
) -> Result<&[u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(unit)?;
    pdu(&mut writer)?;
    let used = writer.written().len();
    spread(buffer, used)
}

/// Turns the first `used` bytes of `buffer`, a frame's content, into the frame.
pub(super) fn spread(buffer: &mut [u8], used: usize) -> Result<&[u8], NoSpace> {
    let frame = buffer.get_mut(..frame_length(used)).ok_or(NoSpace)?;
    let lrc = checksum::lrc(frame.get(..used).ok_or(NoSpace)?);
    // a pair never starts before its byte, so from the end on nothing is lost
    for at in (0..=used).rev() {
        let byte = if at == used { lrc } else { frame.get(at).copied().unwrap_or(0) };
        let start = at.wrapping_mul(2).wrapping_add(1);
        if let Some(pair) = frame.get_mut(start..).and_then(|rest| rest.first_chunk_mut::<2>()) {
            *pair = [character(byte >> 4), character(byte & 0x0F)];
        }
    }
    if let [colon, .., cr, lf] = frame {
        (*colon, *cr, *lf) = (b':', b'\r', b'\n');
    }
    Ok(frame)
}

/// The character at `index` of the frame around `content`, unit address and protocol data unit: for a sender without room
/// for the whole frame. `None` past its end.
#[must_use]
pub fn character_at(content: &[u8], index: usize) -> Option<u8> {
    let Some(pairs) = index.checked_sub(1) else { return Some(b':') };
    let at = pairs / 2;
    let byte = match at.checked_sub(content.len()) {
        None => content.get(at).copied()?,
        Some(0) => checksum::lrc(content),
        Some(1) => return Some(if pairs % 2 == 0 { b'\r' } else { b'\n' }),
        Some(_) => return None,
    };
    Some(character(if pairs % 2 == 0 { byte >> 4 } else { byte & 0x0F }))
}

/// What comes out of a [`Decoder`].
pub type Event<'a> = decode::Event<Frame<'a>, FrameError>;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// Waiting for a colon.
    Idle,
    /// The next character starts a pair or is CR.
    High,
    /// The next character ends a pair that starts with this.
    Low(u8),
    /// The next character is LF.
    LineFeed,
}

/// Frames out of a stream of characters, for both ends of a line: requests and responses look alike.
///
/// A colon always starts a frame; characters between frames are passed over. It needs no clock: a frame that never
/// ends costs nothing until the next colon.
#[derive(Debug)]
pub struct Decoder {
    buffer: [u8; CONTENT_MAX + 1],
    used: usize,
    state: State,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// A decoder that waits for a colon.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; CONTENT_MAX + 1], used: 0, state: State::Idle }
    }

    /// Forgets a frame that has begun.
    pub const fn clear(&mut self) {
        self.state = State::Idle;
    }

    /// Whether a frame has begun.
    #[must_use]
    pub fn is_inside(&self) -> bool {
        self.state != State::Idle
    }

    /// Takes characters until there is an event or none are left; call again while there is one. The time is of no account.
    pub fn feed(&mut self, characters: &mut &[u8], _now: Instant) -> Option<Event<'_>> {
        while let Some((character, rest)) = characters.split_first() {
            *characters = rest;
            match self.take(*character) {
                Ok(false) => {}
                Ok(true) => {
                    return Some(match Frame::of(self.buffer.get(..self.used).unwrap_or(&[])) {
                        Ok(frame) => Event::Frame(frame),
                        Err(error) => Event::Dropped(error),
                    });
                }
                Err(error) => return Some(Event::Dropped(error)),
            }
        }
        None
    }

    /// Whether the character ends a frame.
    fn take(&mut self, character: u8) -> Result<bool, FrameError> {
        let state = core::mem::replace(&mut self.state, State::Idle);
        match (state, character) {
            (State::Idle, b':') => self.start(),
            (_, b':') => {
                self.start();
                return Err(FrameError::Restarted);
            }
            (State::Idle, _) => {}
            (State::High, b'\r') => self.state = State::LineFeed,
            (State::High, _) if self.used >= self.buffer.len() => return Err(FrameError::Endless),
            (State::High, _) => self.state = State::Low(nibble(character)?),
            (State::Low(_), b'\r') => return Err(FrameError::Length),
            (State::Low(high), _) => {
                let byte = high << 4 | nibble(character)?;
                if let Some(place) = self.buffer.get_mut(self.used) {
                    *place = byte;
                    self.used = self.used.wrapping_add(1);
                }
                self.state = State::High;
            }
            (State::LineFeed, b'\n') => return Ok(true),
            (State::LineFeed, _) => return Err(FrameError::Character(character)),
        }
        Ok(false)
    }

    const fn start(&mut self) {
        self.used = 0;
        self.state = State::High;
    }
}

error_text! {
    FrameError {
        FrameError::Character(character) => ("character {character:#04x} is not hexadecimal"),
        FrameError::Length => ("half a byte, or too few of them"),
        FrameError::Checksum => ("the LRC does not fit"),
        FrameError::Endless => ("longer than a frame can be"),
        FrameError::Restarted => ("a colon inside a frame"),
        FrameError::Delimiter => ("not between colon and CR LF"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::{AddressRange, FunctionCode};
    use std::vec::Vec;

    const READ: Request<'_> = Request::ReadCoils(AddressRange::new(0, 1));

    /// What comes out, whatever the pieces are in which it goes in.
    fn run(characters: &[u8]) -> Vec<Result<(u8, Vec<u8>), FrameError>> {
        let mut results: Vec<Vec<_>> = Vec::new();
        for piece in [1, 2, 3, 7, 1000] {
            let (mut decoder, mut found) = (Decoder::new(), Vec::new());
            for mut chunk in characters.chunks(piece) {
                while let Some(event) = decoder.feed(&mut chunk, Instant::default()) {
                    found.push(match event {
                        Event::Frame(frame) => Ok((frame.unit, frame.pdu.to_vec())),
                        Event::Dropped(error) => Err(error),
                    });
                }
                assert!(chunk.is_empty());
            }
            results.push(found);
        }
        assert!(results.iter().all(|found| *found == results[0]), "pieces change the outcome: {results:?}");
        results.remove(0)
    }

    #[test]
    fn the_ndam_manuals_request_with_its_lrc_corrected() {
        let mut buffer = [0xEE; FRAME_MAX];
        let frame = encode_request(2, &READ, &mut buffer).unwrap();
        assert_eq!(frame, b":020100000001FC\r\n");
        let mut content = [0xEE; CONTENT_MAX + 1];
        let decoded = Frame::decode(frame, &mut content).unwrap();
        assert_eq!((decoded.unit, Request::decode(decoded.pdu)), (2, Ok(READ)));
        assert_eq!(run(frame), [Ok((2, [1, 0, 0, 0, 1].to_vec()))]);
        assert_eq!(run(b":020100000001fc\r\n"), [Ok((2, [1, 0, 0, 0, 1].to_vec()))], "lower case is taken");
        for space in 0..frame.len() {
            assert_eq!(encode_request(2, &READ, &mut [0; 32][..space]), Err(NoSpace));
        }
    }

    #[test]
    fn every_length_goes_both_ways() {
        let data: Vec<u8> = (0..=255).cycle().take(300).map(|byte: u8| byte.wrapping_mul(7)).collect();
        for length in (0..PDU_MAX).step_by(crate::stride(42)) {
            let request = Request::Other { function: FunctionCode::Unknown(0x41), data: &data[..length] };
            let mut buffer = [0xEE; FRAME_MAX];
            let frame = encode_request(9, &request, &mut buffer).unwrap().to_vec();
            let whole = [&[9, 0x41], &data[..length]].concat();
            let singly: Vec<u8> = (0..).map_while(|index| character_at(&whole, index)).collect();
            assert_eq!((&singly, frame_length(whole.len())), (&frame, frame.len()));
            let mut content = [0xEE; CONTENT_MAX + 1];
            let decoded = Frame::decode(&frame, &mut content).unwrap();
            assert_eq!(Request::decode(decoded.pdu), Ok(request));
            assert_eq!(run(&frame), [Ok((9, decoded.pdu.to_vec()))]);
        }
        let longer = Request::Other { function: FunctionCode::Unknown(0x41), data: &data[..PDU_MAX] };
        assert_eq!(encode_request(9, &longer, &mut [0; FRAME_MAX]), Err(NoSpace));
    }

    #[test]
    fn every_wrong_character_and_every_cut_is_refused() {
        let frame = b":020100000001FC\r\n";
        for at in 0..frame.len() {
            for other in (0..=u8::MAX).step_by(crate::stride(51)) {
                let mut wrong = frame.to_vec();
                wrong[at] = other;
                if wrong.eq_ignore_ascii_case(frame) {
                    continue;
                }
                assert!(run(&wrong).iter().all(Result::is_err), "{other} at {at}");
                assert!(Frame::decode(&wrong, &mut [0; 300]).is_err(), "{other} at {at}");
            }
        }
        for cut in 0..frame.len() {
            assert_eq!(run(&frame[..cut]), []);
            assert!(Frame::decode(&frame[..cut], &mut [0; 300]).is_err());
        }
    }

    #[test]
    fn every_error_has_its_name() {
        for (characters, error) in [
            (&b":0201G"[..], FrameError::Character(b'G')),
            (b":0201 ", FrameError::Character(b' ')),
            (b":0201\n", FrameError::Character(b'\n')),
            (b":0201\rX", FrameError::Character(b'X')),
            (b":020\r", FrameError::Length),
            (b":\r\n", FrameError::Length),
            (b":02FE\r\n", FrameError::Length),
            (b":0201FC\r\n", FrameError::Checksum),
            (b":0201:", FrameError::Restarted),
        ] {
            assert_eq!(run(characters), [Err(error)], "{}", characters.escape_ascii());
        }
        assert_eq!(Frame::decode(b"0201FD\r\n", &mut [0; 9]), Err(FrameError::Delimiter));
        assert_eq!(Frame::decode(b":0201FD\r\n", &mut [0; 2]), Err(FrameError::Endless));
    }

    #[test]
    fn a_colon_starts_afresh_and_what_lies_between_frames_is_passed_over() {
        let good = Ok((2, [1, 0, 0, 0, 1].to_vec()));
        assert_eq!(
            run(b"noise\r\n:0201:020100000001FC\r\n0201FD\r\n\0\xFF:020100000001FC\r\n"),
            [Err(FrameError::Restarted), good.clone(), good]
        );
    }

    #[test]
    fn a_frame_without_end_is_dropped_once() {
        let mut characters = b":".to_vec();
        characters.extend([b'A'; 2000]);
        assert_eq!(run(&characters), [Err(FrameError::Endless)]);
        characters.extend(b"\r\n:020100000001FC\r\n");
        assert_eq!(run(&characters), [Err(FrameError::Endless), Ok((2, [1, 0, 0, 0, 1].to_vec()))]);
        assert_eq!(
            Frame::decode(&[b":", &[b'A'; 512][..], b"\r\n"].concat(), &mut [0; 300]),
            Err(FrameError::Endless)
        );
    }
}
