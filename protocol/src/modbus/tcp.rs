//! Modbus TCP: a header and the protocol data unit, no checksum ("Messaging on TCP/IP Implementation Guide V1.0b",
//! 3.1.3).
//!
//! A stream that is out of step can't be brought back: nothing marks where a frame starts. So every error here means
//! that the connection is to be closed, and that nothing more of it is to be believed.

use super::{PDU_MAX, Request, Response};
use crate::decode;
use crate::error::error_text;
use crate::time::Instant;
use crate::wire::{NoSpace, Writer};

/// Length of the header.
pub const HEADER_LENGTH: usize = 7;

/// Longest frame.
pub const FRAME_MAX: usize = HEADER_LENGTH + PDU_MAX;

/// Port of a server.
pub const PORT: u16 = 502;

/// Smallest and largest value of the header's length: the unit address, and a data unit of 1 to 253 bytes.
const LENGTHS: core::ops::RangeInclusive<u16> = 2..=1 + PDU_MAX as u16;

/// The header of a frame (MBAP). Its protocol identifier is always 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Header {
    /// Number that the client gave the request; the response bears it again.
    pub transaction: u16,
    /// Unit address, for gateways; a server of its own is 0xFF or whatever it was asked as.
    pub unit: u8,
    /// Length of the unit address and the protocol data unit.
    length: u16,
}

/// Why bytes are no frame: the connection is to be closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// The protocol identifier is not 0 but this.
    Protocol(u16),
    /// The length is not 2 to 254 but this.
    Length(u16),
}

impl Header {
    /// The header of a frame whose data unit has `pdu_length` bytes.
    ///
    /// # Errors
    /// [`FrameError::Length`] where that is none or more than [`PDU_MAX`].
    pub fn of(transaction: u16, unit: u8, pdu_length: usize) -> Result<Self, FrameError> {
        let length = u16::try_from(pdu_length.saturating_add(1)).unwrap_or(u16::MAX);
        if !LENGTHS.contains(&length) {
            return Err(FrameError::Length(length));
        }
        Ok(Self { transaction, unit, length })
    }

    /// Takes the bytes of a header apart.
    ///
    /// # Errors
    /// [`FrameError`] where protocol identifier or length are impossible.
    pub fn from_bytes(bytes: [u8; HEADER_LENGTH]) -> Result<Self, FrameError> {
        let [a, b, c, d, e, f, unit] = bytes;
        let word = |high, low| u16::from_be_bytes([high, low]);
        let (transaction, protocol, length) = (word(a, b), word(c, d), word(e, f));
        match protocol {
            0 if LENGTHS.contains(&length) => Ok(Self { transaction, unit, length }),
            0 => Err(FrameError::Length(length)),
            _ => Err(FrameError::Protocol(protocol)),
        }
    }

    /// The bytes of the header.
    #[must_use]
    pub const fn to_bytes(self) -> [u8; HEADER_LENGTH] {
        let ([a, b], [e, f]) = (self.transaction.to_be_bytes(), self.length.to_be_bytes());
        [a, b, 0, 0, e, f, self.unit]
    }

    /// Length of the data unit that follows, 1 to 253.
    #[must_use]
    pub fn pdu_length(self) -> usize {
        usize::from(self.length).saturating_sub(1)
    }
}

/// A whole frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame<'a> {
    /// Number that the client gave the request.
    pub transaction: u16,
    /// Unit address.
    pub unit: u8,
    /// Function code and data.
    pub pdu: &'a [u8],
}

/// Writes a request as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit the buffer or a frame.
pub fn encode_request<'b>(
    transaction: u16,
    unit: u8,
    request: &Request<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    encode(transaction, unit, buffer, |writer| request.encode(writer))
}

/// Writes a response as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit the buffer or a frame.
pub fn encode_response<'b>(
    transaction: u16,
    unit: u8,
    response: &Response<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    encode(transaction, unit, buffer, |writer| response.encode(writer))
}

fn encode(
    transaction: u16,
    unit: u8,
    buffer: &mut [u8],
    pdu: impl FnOnce(&mut Writer<'_>) -> Result<(), NoSpace>,
) -> Result<&[u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.reserve(HEADER_LENGTH)?;
    pdu(&mut writer)?;
    let length = writer.written().len().saturating_sub(HEADER_LENGTH);
    let header = Header::of(transaction, unit, length).map_err(|_| NoSpace)?;
    writer.patch(0, &header.to_bytes());
    Ok(writer.finish())
}

/// What comes out of a [`Decoder`].
pub type Event<'a> = decode::Event<Frame<'a>, FrameError>;

/// Frames out of a connection, for both ends: requests and responses look alike.
#[derive(Debug)]
pub struct Decoder {
    buffer: [u8; FRAME_MAX],
    used: usize,
    delivered: bool,
    fault: Option<FrameError>,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// For a connection that was just opened.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; FRAME_MAX], used: 0, delivered: false, fault: None }
    }

    /// Forgets everything: for the next connection.
    pub const fn clear(&mut self) {
        self.used = 0;
        self.delivered = false;
        self.fault = None;
    }

    /// Takes bytes until there is an event or none are left; call again while there is one. One segment may hold
    /// several frames, and one frame come in many segments. The time is of no account.
    ///
    /// [`Event::Dropped`](decode::Event::Dropped) tells to close the connection: it takes all bytes, and so does everything
    /// that is fed until [`clear`](Self::clear), with the same reason.
    pub fn feed(&mut self, bytes: &mut &[u8], _now: Instant) -> Option<Event<'_>> {
        if bytes.is_empty() {
            return None;
        }
        if self.delivered {
            self.clear();
        }
        if self.fault.is_none() {
            self.fill(HEADER_LENGTH, bytes);
        }
        let header = *self.buffer.get(..self.used).and_then(|kept| kept.first_chunk())?;
        let header = match self.fault.map_or_else(|| Header::from_bytes(header), Err) {
            Ok(header) => header,
            Err(fault) => {
                self.fault = Some(fault);
                *bytes = &[];
                return Some(Event::Dropped(fault));
            }
        };
        let length = HEADER_LENGTH.saturating_add(header.pdu_length());
        self.fill(length, bytes);
        if self.used < length {
            return None;
        }
        self.delivered = true;
        let pdu = self.buffer.get(HEADER_LENGTH..length)?;
        Some(Event::Frame(Frame { transaction: header.transaction, unit: header.unit, pdu }))
    }

    /// Takes bytes until there are `wanted`.
    fn fill(&mut self, wanted: usize, bytes: &mut &[u8]) {
        let Some(place) = self.buffer.get_mut(self.used..wanted) else { return };
        let count = place.len().min(bytes.len());
        if let (Some(place), Some((taken, rest))) = (place.get_mut(..count), bytes.split_at_checked(count)) {
            place.copy_from_slice(taken);
            self.used = self.used.saturating_add(count);
            *bytes = rest;
        }
    }
}

error_text! {
    FrameError {
        FrameError::Protocol(protocol) => ("protocol identifier {protocol} instead of 0"),
        FrameError::Length(length) => ("length {length} instead of 2 to 254"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::{AddressRange, FunctionCode};
    use std::vec::Vec;

    type Found = (u16, u8, Vec<u8>);

    /// What comes out, whatever the segments are in which it goes in.
    fn run(stream: &[u8]) -> (Vec<Found>, Option<FrameError>) {
        let mut results = Vec::new();
        for piece in [1, 2, 3, 5, 6, 7, 8, 13, 100_000] {
            let (mut decoder, mut found, mut fault) = (Decoder::new(), Vec::new(), None);
            for mut chunk in stream.chunks(piece) {
                while let Some(event) = decoder.feed(&mut chunk, Instant::default()) {
                    match event {
                        Event::Frame(frame) => {
                            found.push((frame.transaction, frame.unit, frame.pdu.to_vec()))
                        }
                        Event::Dropped(error) => fault = Some(error),
                    }
                }
                assert!(chunk.is_empty());
            }
            results.push((found, fault));
        }
        assert!(
            results.iter().all(|result| *result == results[0]),
            "segments change the outcome: {results:?}"
        );
        results.remove(0)
    }

    #[test]
    fn a_request_goes_both_ways() {
        let request = Request::ReadHoldingRegisters(AddressRange::new(4, 1));
        let mut buffer = [0xEE; FRAME_MAX];
        let frame = encode_request(0x1501, 0xFF, &request, &mut buffer).unwrap();
        assert_eq!(frame, [0x15, 0x01, 0, 0, 0, 6, 0xFF, 3, 0, 4, 0, 1]);
        assert_eq!(run(frame), ([(0x1501, 0xFF, frame[7..].to_vec())].to_vec(), None));
        for space in 0..frame.len() {
            assert_eq!(encode_request(1, 1, &request, &mut [0; 32][..space]), Err(NoSpace));
        }
        for cut in 0..frame.len() {
            assert_eq!(run(&frame[..cut]), (Vec::new(), None));
        }
    }

    #[test]
    fn several_frames_of_every_length_in_one_stream() {
        let (mut stream, mut expected) = (Vec::new(), Vec::new());
        for length in (0..PDU_MAX).step_by(crate::stride(42)) {
            let data = std::vec![length as u8; length];
            let response = Response::Other { function: FunctionCode::Unknown(0x41), data: &data };
            let mut buffer = [0xEE; FRAME_MAX];
            let frame = encode_response(length as u16, 3, &response, &mut buffer).unwrap();
            stream.extend_from_slice(frame);
            expected.push((length as u16, 3, frame[HEADER_LENGTH..].to_vec()));
        }
        assert_eq!(run(&stream), (expected, None));
        let longer = Response::Other { function: FunctionCode::Unknown(0x41), data: &[0; PDU_MAX] };
        assert_eq!(encode_response(0, 3, &longer, &mut [0; 300]), Err(NoSpace));
    }

    #[test]
    fn every_impossible_header_closes_the_connection() {
        let good = [0, 1, 0, 0, 0, 2, 9, 7];
        for length in (0..=u16::MAX).step_by(crate::stride(127)) {
            let [high, low] = length.to_be_bytes();
            let header = Header::from_bytes([0, 1, 0, 0, high, low, 9]);
            match header {
                Ok(header) => assert_eq!(header.pdu_length() + 1, usize::from(length)),
                Err(error) => assert_eq!(error, FrameError::Length(length)),
            }
            assert_eq!(header.is_ok(), (2..=254).contains(&length));
            let protocol = Header::from_bytes([0, 1, high, low, 0, 2, 9]);
            assert_eq!(protocol.err(), (length != 0).then_some(FrameError::Protocol(length)));
        }
        for length in [0, 1, 255, 256, u16::MAX] {
            let [high, low] = length.to_be_bytes();
            let stream = [&good[..], &[0, 2, 0, 0, high, low, 9, 7], &good].concat();
            let (found, fault) = run(&stream);
            assert_eq!(found.len(), 1, "what came before counts, nothing after");
            assert_eq!(fault, Some(FrameError::Length(length)));
        }
    }

    #[test]
    fn an_error_stays_until_the_next_connection() {
        let mut decoder = Decoder::new();
        let good = [0, 1, 0, 0, 0, 2, 9, 7];
        let now = Instant::default();
        let dropped = Some(Event::Dropped(FrameError::Protocol(9)));
        assert_eq!(decoder.feed(&mut &[0, 1, 0, 9, 0, 2, 9, 7][..], now), dropped);
        let mut more = &good[..];
        assert_eq!(decoder.feed(&mut more, now), dropped);
        assert!(more.is_empty(), "a loop over the events ends");
        decoder.clear();
        let frame = Frame { transaction: 1, unit: 9, pdu: &[7] };
        assert_eq!(decoder.feed(&mut &good[..], now), Some(Event::Frame(frame)));
    }
}
