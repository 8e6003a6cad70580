//! LAWICEL ("SLCAN") lines: how a serial CAN adapter and its host talk.
//!
//! A line is a letter, hexadecimal digits and a carriage return. [`LineReader`] cuts a byte stream into lines,
//! [`Command::decode`] makes a value of a line, [`Command::encode`] a line of a value.
//!
//! | line | meaning |
//! |---|---|
//! | `tiiildd..` `riiil` | data or remote frame, 11 bit identifier |
//! | `Tiiiiiiiildd..` `Riiiiiiiil` | data or remote frame, 29 bit identifier |
//! | `Sn` `sxxyy` | bit rate by number, by the SJA1000's timing registers |
//! | `O` `L` `C` | open, open as a listener, close the channel |
//! | `V` `N` `F` | version, serial number, status flags |
//! | `Zn` | time stamps on received frames off or on |
//! | `Mxxxxxxxx` `mxxxxxxxx` | acceptance code and mask |
//!
//! The adapter answers with [`DONE`] or [`REFUSED`], and with [`SENT_STANDARD`] or [`SENT_EXTENDED`] for a frame.

use crate::can::{Frame, Id};
use crate::decode;
use crate::error::error_text;
use crate::time::Instant;

/// Ends a line; alone it is the adapter's "done".
pub const DONE: u8 = b'\r';
/// The adapter's "refused", which ends a line like [`DONE`] does.
pub const REFUSED: u8 = 0x07;
/// The adapter's "a frame with an 11 bit identifier is sent".
pub const SENT_STANDARD: &[u8] = b"z\r";
/// The adapter's "a frame with a 29 bit identifier is sent".
pub const SENT_EXTENDED: &[u8] = b"Z\r";

/// Bytes of the longest line that is encoded, carriage return included.
pub const ENCODED_MAX: usize = 1 + 8 + 1 + 2 * 8 + 1;
/// Bytes of the longest line that is decoded, carriage return not included: with a time stamp.
pub const LINE_MAX: usize = ENCODED_MAX - 1 + TIMESTAMP_DIGITS;

const TIMESTAMP_DIGITS: usize = 4;

/// What a host asks of its adapter. The adapter hands received frames to the host in the same form.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Command {
    /// `t` `T` `r` `R`: a frame. A time stamp behind it is checked and dropped.
    Frame(Frame),
    /// `S`: one of nine bit rates, 0 to 8; see [`bit_rate`].
    SetBitrate(u8),
    /// `s`: BTR0 and BTR1 of an SJA1000.
    SetBitTiming(u16),
    /// `O`: open the channel.
    Open,
    /// `L`: open the channel without ever sending a dominant bit.
    Listen,
    /// `C`: close the channel.
    Close,
    /// `V`: hardware and software version.
    Version,
    /// `N`: serial number.
    SerialNumber,
    /// `F`: status flags.
    StatusFlags,
    /// `Z`: time stamps on received frames off or on.
    Timestamp(bool),
    /// `M`: acceptance code of an SJA1000.
    AcceptanceCode(u32),
    /// `m`: acceptance mask of an SJA1000.
    AcceptanceMask(u32),
}

/// Why a line is not a [`Command`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DecodeError {
    /// Nothing between two carriage returns; hosts send that to get an adapter's attention.
    Empty,
    /// No command starts with this letter.
    UnknownCommand(u8),
    /// The line is shorter or longer than its command wants.
    Length,
    /// This byte stands where a hexadecimal digit should.
    Digit(u8),
    /// A number is outside its range: bit rate, time stamp switch, identifier.
    Range,
}

error_text! {
    DecodeError {
        DecodeError::Empty => ("an empty line"),
        DecodeError::UnknownCommand(letter) => ("no command starts with {letter:#04x}"),
        DecodeError::Length => ("shorter or longer than the command"),
        DecodeError::Digit(byte) => ("{byte:#04x} is no hexadecimal digit"),
        DecodeError::Range => ("a number is outside its range"),
    }
}

impl Command {
    /// The value of a line, given without its carriage return.
    ///
    /// # Errors
    /// [`DecodeError`] where the line is no command or not all of one.
    pub fn decode(line: &[u8]) -> Result<Self, DecodeError> {
        let (&letter, digits) = line.split_first().ok_or(DecodeError::Empty)?;
        let mut digits = Digits(digits);
        let command = match letter {
            b't' => Self::Frame(digits.frame(Format { extended: false, remote: false })?),
            b'T' => Self::Frame(digits.frame(Format { extended: true, remote: false })?),
            b'r' => Self::Frame(digits.frame(Format { extended: false, remote: true })?),
            b'R' => Self::Frame(digits.frame(Format { extended: true, remote: true })?),
            b'S' => Self::SetBitrate(digits.at_most(8)?),
            b's' => Self::SetBitTiming(u16::try_from(digits.number(4)?).map_err(|_| DecodeError::Range)?),
            b'O' => Self::Open,
            b'L' => Self::Listen,
            b'C' => Self::Close,
            b'V' => Self::Version,
            b'N' => Self::SerialNumber,
            b'F' => Self::StatusFlags,
            b'Z' => Self::Timestamp(digits.at_most(1)? == 1),
            b'M' => Self::AcceptanceCode(digits.number(8)?),
            b'm' => Self::AcceptanceMask(digits.number(8)?),
            other => return Err(DecodeError::UnknownCommand(other)),
        };
        digits.end()?;
        Ok(command)
    }

    /// The line of this command, carriage return included: the used part of `buffer`.
    ///
    /// ```
    /// use jointbus_protocol::can::{Frame, Id};
    /// use jointbus_protocol::slcan::{Command, ENCODED_MAX};
    ///
    /// let frame = Frame::data_frame(Id::Standard(0x123), &[0xde, 0xad]).unwrap();
    /// assert_eq!(Command::Frame(frame).encode(&mut [0; ENCODED_MAX]), b"t1232DEAD\r");
    /// ```
    pub fn encode<'buffer>(&self, buffer: &'buffer mut [u8; ENCODED_MAX]) -> &'buffer [u8] {
        let mut line = Line { buffer, length: 0 };
        match *self {
            Self::Frame(frame) => line.frame(&frame),
            Self::SetBitrate(code) => line.letter(b'S').hex(u32::from(code), 1),
            Self::SetBitTiming(registers) => line.letter(b's').hex(u32::from(registers), 4),
            Self::Open => line.letter(b'O'),
            Self::Listen => line.letter(b'L'),
            Self::Close => line.letter(b'C'),
            Self::Version => line.letter(b'V'),
            Self::SerialNumber => line.letter(b'N'),
            Self::StatusFlags => line.letter(b'F'),
            Self::Timestamp(on) => line.letter(b'Z').hex(u32::from(on), 1),
            Self::AcceptanceCode(code) => line.letter(b'M').hex(code, 8),
            Self::AcceptanceMask(mask) => line.letter(b'm').hex(mask, 8),
        };
        line.letter(DONE);
        let Line { buffer, length } = line;
        buffer.get(..length).unwrap_or(&[])
    }
}

/// Bits per second of the rate that [`Command::SetBitrate`] numbers.
#[must_use]
pub const fn bit_rate(code: u8) -> Option<u32> {
    match code {
        0 => Some(10_000),
        1 => Some(20_000),
        2 => Some(50_000),
        3 => Some(100_000),
        4 => Some(125_000),
        5 => Some(250_000),
        6 => Some(500_000),
        7 => Some(800_000),
        8 => Some(1_000_000),
        _ => None,
    }
}

/// Whether a line, given without its carriage return, is the adapter's word that a frame is sent.
#[must_use]
pub const fn is_confirmation(line: &[u8]) -> bool {
    matches!(line, b"z" | b"Z")
}

/// Which of the four frame letters.
#[derive(Clone, Copy)]
struct Format {
    extended: bool,
    remote: bool,
}

impl Format {
    const fn identifier_digits(self) -> usize {
        if self.extended { 8 } else { 3 }
    }
}

/// What is left of a line.
struct Digits<'line>(&'line [u8]);

impl Digits<'_> {
    fn digit(&mut self) -> Result<u8, DecodeError> {
        let (&first, rest) = self.0.split_first().ok_or(DecodeError::Length)?;
        self.0 = rest;
        let value = char::from(first).to_digit(16).and_then(|value| u8::try_from(value).ok());
        value.ok_or(DecodeError::Digit(first))
    }

    fn at_most(&mut self, largest: u8) -> Result<u8, DecodeError> {
        self.digit().and_then(|value| if value <= largest { Ok(value) } else { Err(DecodeError::Range) })
    }

    /// A number of up to eight digits.
    fn number(&mut self, digits: usize) -> Result<u32, DecodeError> {
        (0..digits).try_fold(0_u32, |number, _| Ok(number << 4 | u32::from(self.digit()?)))
    }

    fn identifier(&mut self, format: Format) -> Result<Id, DecodeError> {
        let number = self.number(format.identifier_digits())?;
        if format.extended {
            Ok(Id::Extended(number))
        } else {
            u16::try_from(number).map(Id::Standard).map_err(|_| DecodeError::Range)
        }
    }

    fn frame(&mut self, format: Format) -> Result<Frame, DecodeError> {
        let id = self.identifier(format)?;
        let dlc = self.digit()?;
        let mut data = [0; 8];
        if !format.remote {
            for byte in data.iter_mut().take(usize::from(dlc)) {
                *byte = self.digit()? << 4 | self.digit()?;
            }
        }
        if self.0.len() == TIMESTAMP_DIGITS {
            self.number(TIMESTAMP_DIGITS)?;
        }
        Frame::from_parts(id, format.remote, dlc, data).map_err(|_| DecodeError::Range)
    }

    fn end(&self) -> Result<(), DecodeError> {
        if self.0.is_empty() { Ok(()) } else { Err(DecodeError::Length) }
    }
}

/// A line being written. The buffer holds the longest one, so nothing is ever cut.
struct Line<'buffer> {
    buffer: &'buffer mut [u8; ENCODED_MAX],
    length: usize,
}

impl Line<'_> {
    fn letter(&mut self, letter: u8) -> &mut Self {
        if let Some(place) = self.buffer.get_mut(self.length) {
            *place = letter;
            self.length = self.length.saturating_add(1);
        }
        self
    }

    /// The low `digits` digits of a number, most significant first.
    fn hex(&mut self, number: u32, digits: u32) -> &mut Self {
        (0..digits).rev().fold(self, |line, place| {
            let digit = number.wrapping_shr(place.saturating_mul(4)) & 0xf;
            line.letter(char::from_digit(digit, 16).map_or(b'0', |digit| digit.to_ascii_uppercase() as u8))
        })
    }

    fn frame(&mut self, frame: &Frame) -> &mut Self {
        match (frame.id(), frame.is_remote()) {
            (Id::Standard(id), false) => self.letter(b't').hex(u32::from(id), 3),
            (Id::Standard(id), true) => self.letter(b'r').hex(u32::from(id), 3),
            (Id::Extended(id), false) => self.letter(b'T').hex(id, 8),
            (Id::Extended(id), true) => self.letter(b'R').hex(id, 8),
        };
        self.hex(u32::from(frame.dlc()), 1);
        frame.data().iter().fold(self, |line, byte| line.hex(u32::from(*byte), 2))
    }
}

/// Why bytes are no line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum LineError {
    /// The adapter's [`REFUSED`]. What stood before it on the line is dropped.
    Refused,
    /// A line of more than `N` bytes has ended. It is dropped; the next one is read as usual.
    TooLong,
}

/// What comes out of a [`LineReader`]: a line without its carriage return, empty for a carriage return alone.
pub type Event<'a> = decode::Event<&'a [u8], LineError>;

/// Cuts a byte stream into lines of up to `N` bytes; [`LINE_MAX`] is enough for every command.
#[derive(Debug, Clone)]
pub struct LineReader<const N: usize> {
    buffer: [u8; N],
    length: usize,
    too_long: bool,
}

impl<const N: usize> LineReader<N> {
    /// A reader at the start of a line.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; N], length: 0, too_long: false }
    }

    /// Takes bytes until there is an event or none are left; call again while there is one. The time is of no account.
    pub fn feed(&mut self, bytes: &mut &[u8], _now: Instant) -> Option<Event<'_>> {
        while let Some((byte, rest)) = bytes.split_first() {
            *bytes = rest;
            if *byte == DONE || *byte == REFUSED {
                let length = core::mem::take(&mut self.length);
                let too_long = core::mem::take(&mut self.too_long);
                return Some(match self.buffer.get(..length) {
                    _ if *byte == REFUSED => Event::Dropped(LineError::Refused),
                    Some(line) if !too_long => Event::Frame(line),
                    _ => Event::Dropped(LineError::TooLong),
                });
            }
            match self.buffer.get_mut(self.length) {
                Some(place) => {
                    *place = *byte;
                    self.length = self.length.saturating_add(1);
                }
                None => self.too_long = true,
            }
        }
        None
    }
}

impl<const N: usize> Default for LineReader<N> {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn frame(id: Id, data: &[u8]) -> Frame {
        Frame::data_frame(id, data).unwrap()
    }

    #[test]
    fn frames_of_all_four_kinds_go_both_ways() {
        let remote = |id, dlc| Frame::from_parts(id, true, dlc, [0; 8]).unwrap();
        let long = [1, 2, 3, 4, 5, 6, 7, 0xff];
        let lines: [(&[u8], Frame); 6] = [
            (b"t1230\r", frame(Id::Standard(0x123), &[])),
            (b"t7FF2DEAD\r", frame(Id::Standard(0x7ff), &[0xde, 0xad])),
            (b"r0018\r", remote(Id::Standard(1), 8)),
            (b"T18FF0123801020304050607FF\r", frame(Id::Extended(0x18ff_0123), &long)),
            (b"T1FFFFFFF0\r", frame(Id::Extended(0x1fff_ffff), &[])),
            (b"R0000000A3\r", remote(Id::Extended(10), 3)),
        ];
        for (line, frame) in lines {
            assert_eq!(Command::decode(line.strip_suffix(b"\r").unwrap()), Ok(Command::Frame(frame)));
            assert_eq!(Command::Frame(frame).encode(&mut [0xaa; ENCODED_MAX]), line);
        }
    }

    #[test]
    fn commands_go_both_ways() {
        let lines: [(&[u8], Command); 13] = [
            (b"S0", Command::SetBitrate(0)),
            (b"S8", Command::SetBitrate(8)),
            (b"s031C", Command::SetBitTiming(0x031c)),
            (b"O", Command::Open),
            (b"L", Command::Listen),
            (b"C", Command::Close),
            (b"V", Command::Version),
            (b"N", Command::SerialNumber),
            (b"F", Command::StatusFlags),
            (b"Z0", Command::Timestamp(false)),
            (b"Z1", Command::Timestamp(true)),
            (b"M00000000", Command::AcceptanceCode(0)),
            (b"mFFFFFFFF", Command::AcceptanceMask(u32::MAX)),
        ];
        for (line, command) in lines {
            assert_eq!(Command::decode(line), Ok(command));
            assert_eq!(command.encode(&mut [0xaa; ENCODED_MAX]).strip_suffix(b"\r"), Some(line));
        }
    }

    #[test]
    fn length_codes_above_eight_carry_eight_bytes() {
        let frame = Frame::from_parts(Id::Standard(0x123), false, 15, [1, 2, 3, 4, 5, 6, 7, 8]).unwrap();
        assert_eq!(Command::decode(b"t123F0102030405060708"), Ok(Command::Frame(frame)));
        assert_eq!(Command::Frame(frame).encode(&mut [0; ENCODED_MAX]), b"t123F0102030405060708\r");
        assert_eq!(Command::decode(b"t123901020304050607"), Err(DecodeError::Length));
    }

    #[test]
    fn lower_case_and_time_stamps_are_accepted() {
        let expected = Ok(Command::Frame(frame(Id::Standard(0x12a), &[0xbe])));
        assert_eq!(Command::decode(b"t12a1be"), expected);
        assert_eq!(Command::decode(b"t12a1be0f3C"), expected);
        assert_eq!(Command::decode(b"t12a1be0f3"), Err(DecodeError::Length));
        assert_eq!(Command::decode(b"t12a1be0f3C0"), Err(DecodeError::Length));
        assert_eq!(Command::decode(b"t12a1be0f3g"), Err(DecodeError::Digit(b'g')));
    }

    #[test]
    fn every_cut_of_a_line_is_refused() {
        let line = b"T18FF01238010203040506070F";
        for length in 1..line.len() {
            assert_eq!(Command::decode(&line[..length]), Err(DecodeError::Length), "{length}");
        }
    }

    #[test]
    fn bad_lines_say_what_is_wrong() {
        assert_eq!(Command::decode(b""), Err(DecodeError::Empty));
        assert_eq!(Command::decode(b"X1"), Err(DecodeError::UnknownCommand(b'X')));
        assert_eq!(Command::decode(b"z"), Err(DecodeError::UnknownCommand(b'z')));
        assert_eq!(Command::decode(b"S9"), Err(DecodeError::Range));
        assert_eq!(Command::decode(b"Z2"), Err(DecodeError::Range));
        assert_eq!(Command::decode(b"S"), Err(DecodeError::Length));
        assert_eq!(Command::decode(b"O1"), Err(DecodeError::Length));
        assert_eq!(Command::decode(b"t8000"), Err(DecodeError::Range));
        assert_eq!(Command::decode(b"T200000000"), Err(DecodeError::Range));
        assert_eq!(Command::decode(b"t12 0"), Err(DecodeError::Digit(b' ')));
        assert_eq!(Command::decode(b"t12\xff0"), Err(DecodeError::Digit(0xff)));
    }

    #[test]
    fn bit_rates_are_those_that_decode() {
        for code in 0..=u8::MAX {
            let line = [b'S', char::from_digit(u32::from(code % 16), 16).unwrap() as u8];
            assert_eq!(code < 16 && Command::decode(&line).is_ok(), bit_rate(code).is_some());
        }
    }

    #[test]
    fn confirmations_are_told_from_commands() {
        for sent in [SENT_STANDARD, SENT_EXTENDED] {
            let line = sent.strip_suffix(&[DONE]).unwrap();
            assert!(is_confirmation(line) && Command::decode(line).is_err());
        }
        assert!(!is_confirmation(b"Z1"));
    }

    fn read<const N: usize>(bytes: &[u8]) -> Vec<Result<Vec<u8>, &'static str>> {
        let mut reader = LineReader::<N>::new();
        let (mut seen, mut rest) = (Vec::new(), bytes);
        while let Some(event) = reader.feed(&mut rest, Instant::default()) {
            seen.push(match event {
                Event::Frame(line) => Ok(line.to_vec()),
                Event::Dropped(LineError::Refused) => Err("refused"),
                Event::Dropped(LineError::TooLong) => Err("too long"),
            });
        }
        seen
    }

    #[test]
    fn a_stream_is_cut_into_lines() {
        assert_eq!(read::<4>(b"O\r\rS8\rV"), [Ok(b"O".to_vec()), Ok(Vec::new()), Ok(b"S8".to_vec())]);
        assert_eq!(read::<4>(b"12\x07O\r"), [Err("refused"), Ok(b"O".to_vec())]);
    }

    #[test]
    fn too_long_is_said_once_and_the_next_line_is_read() {
        assert_eq!(
            read::<4>(b"1234\r12345\r123456789\rO\r"),
            [Ok(b"1234".to_vec()), Err("too long"), Err("too long"), Ok(b"O".to_vec())]
        );
    }

    proptest! {
        #[test]
        fn whatever_decodes_survives_the_way_back(line in proptest::collection::vec(any::<u8>(), 0..40)) {
            if let Ok(command) = Command::decode(&line) {
                let mut buffer = [0; ENCODED_MAX];
                let encoded = command.encode(&mut buffer).strip_suffix(b"\r").unwrap();
                prop_assert_eq!(Command::decode(encoded), Ok(command));
            }
        }

        #[test]
        fn every_frame_survives_both_ways(
            extended: bool, remote: bool, id: u32, dlc in 0_u8..16, data: [u8; 8],
        ) {
            let id = if extended { Id::Extended(id >> 3) } else { Id::Standard((id >> 21) as u16) };
            let frame = Frame::from_parts(id, remote, dlc, data).unwrap();
            let mut buffer = [0; ENCODED_MAX];
            let line = Command::Frame(frame).encode(&mut buffer);
            prop_assert!(line.len() <= ENCODED_MAX);
            prop_assert_eq!(Command::decode(line.strip_suffix(b"\r").unwrap()), Ok(Command::Frame(frame)));
        }
    }
}
