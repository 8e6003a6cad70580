//! RTU framing: unit address, protocol data unit, CRC ("Modbus over Serial Line", 2.5.1).

use super::{FunctionCode, Request, Response, bytes_of_bits};
use crate::checksum;
use crate::deframe::{Expectation, Format, FrameLength};
use crate::wire::{NoSpace, Writer};

/// Longest frame: unit address, 253 bytes, CRC.
pub const FRAME_MAX: usize = 256;

/// Shortest frame: unit address, function code, CRC.
pub const FRAME_MIN: usize = 4;

/// Length of an exception response.
pub const EXCEPTION_LENGTH: usize = 5;

/// A frame whose CRC was right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame<'a> {
    /// Unit address.
    pub unit: u8,
    /// Function code and data.
    pub pdu: &'a [u8],
}

/// Why bytes are no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// Shorter than [`FRAME_MIN`] or longer than [`FRAME_MAX`].
    Length,
    /// The CRC does not fit.
    Checksum,
}

impl<'a> Frame<'a> {
    /// Checks a whole frame and takes it apart.
    ///
    /// # Errors
    /// [`FrameError`] where length or CRC are wrong.
    pub fn decode(frame: &'a [u8]) -> Result<Self, FrameError> {
        if frame.len() < FRAME_MIN || frame.len() > FRAME_MAX {
            return Err(FrameError::Length);
        }
        let (unit, pdu) =
            checksum::verify(frame).ok_or(FrameError::Checksum)?.split_first().ok_or(FrameError::Length)?;
        Ok(Self { unit: *unit, pdu })
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
    let mut writer = Writer::new(buffer);
    writer.u8(unit)?;
    request.encode(&mut writer)?;
    checksum::seal(&mut writer)?;
    Ok(writer.finish())
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
    let mut writer = Writer::new(buffer);
    writer.u8(unit)?;
    response.encode(&mut writer)?;
    checksum::seal(&mut writer)?;
    Ok(writer.finish())
}

/// Length of the request frame that starts with `prefix`.
#[must_use]
pub fn request_length(prefix: &[u8]) -> FrameLength {
    use FunctionCode as F;
    let Some(&code) = prefix.get(1) else { return FrameLength::AtLeast(FRAME_MIN) };
    match FunctionCode::from_code(code) {
        F::ReadCoils
        | F::ReadDiscreteInputs
        | F::ReadHoldingRegisters
        | F::ReadInputRegisters
        | F::WriteSingleCoil
        | F::WriteSingleRegister
        | F::Diagnostics => FrameLength::Exactly(8),
        F::ReadExceptionStatus | F::GetCommEventCounter | F::GetCommEventLog | F::ReportServerId => {
            FrameLength::Exactly(4)
        }
        F::WriteMultipleCoils | F::WriteMultipleRegisters => with_byte_count(prefix, 6),
        F::MaskWriteRegister => FrameLength::Exactly(10),
        F::ReadWriteMultipleRegisters => with_byte_count(prefix, 10),
        F::EncapsulatedInterface => match prefix.get(2) {
            None => FrameLength::AtLeast(FRAME_MIN),
            Some(0x0E) => FrameLength::Exactly(7),
            Some(_) => FrameLength::UntilSilence,
        },
        F::Unknown(0x00 | 0x80..) => FrameLength::Impossible,
        F::Unknown(_) => FrameLength::UntilSilence,
    }
}

/// The frame's length where the byte at `at` counts the bytes between itself and the CRC.
fn with_byte_count(prefix: &[u8], at: usize) -> FrameLength {
    let head = at.wrapping_add(1);
    match prefix.get(at) {
        None => FrameLength::AtLeast(head),
        Some(&count) => {
            let length = head.wrapping_add(usize::from(count)).wrapping_add(checksum::CRC_LENGTH);
            if length > FRAME_MAX { FrameLength::Impossible } else { FrameLength::Exactly(length) }
        }
    }
}

/// Requests to one unit of a line that has no other: what a slave without neighbours receives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Requests;

impl Format for Requests {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        request_length(prefix)
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        Frame::decode(frame).is_ok()
    }

    fn is_broadcast(&self, frame: &[u8]) -> bool {
        frame.first() == Some(&super::BROADCAST)
    }
}

/// What a master remembers of a request to know the response: unit, function code, length, and for writes the echoed
/// address and quantity.
///
/// Modbus numbers nothing: a late response to an equal request fits as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ExpectedResponse {
    unit: u8,
    function: u8,
    shape: Shape,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
enum Shape {
    /// So many bytes behind a byte count.
    Data(u8),
    /// The first four bytes behind the function code come back.
    Echo([u8; 4]),
    /// Only an exception: no data unit can hold what was asked.
    Refusal,
    /// Anything, up to silence.
    Open,
}

impl ExpectedResponse {
    /// What `unit` may answer to `request`.
    #[must_use]
    pub fn new(unit: u8, request: &Request<'_>) -> Self {
        let data = |bytes: usize| match u8::try_from(bytes) {
            Ok(bytes) if usize::from(bytes) <= super::PDU_MAX.saturating_sub(2) => Shape::Data(bytes),
            _ => Shape::Refusal,
        };
        let echo = |address: u16, value: u16| {
            let ([a, b], [c, d]) = (address.to_be_bytes(), value.to_be_bytes());
            Shape::Echo([a, b, c, d])
        };
        let shape = match *request {
            Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
                data(bytes_of_bits(range.quantity))
            }
            Request::ReadHoldingRegisters(range) | Request::ReadInputRegisters(range) => {
                data(usize::from(range.quantity).saturating_mul(2))
            }
            Request::WriteSingleCoil { address, value } | Request::WriteSingleRegister { address, value } => {
                echo(address, value)
            }
            Request::WriteMultipleCoils { range, .. } | Request::WriteMultipleRegisters { range, .. } => {
                echo(range.start, range.quantity)
            }
            Request::Other { .. } => Shape::Open,
        };
        Self { unit, function: request.function().code(), shape }
    }

    /// Unit that was asked.
    #[must_use]
    pub const fn unit(&self) -> u8 {
        self.unit
    }

    /// Function code that was asked.
    #[must_use]
    pub const fn function(&self) -> FunctionCode {
        FunctionCode::from_code(self.function)
    }

    /// Whether only silence ends the response.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.shape == Shape::Open
    }

    /// Whether a whole frame is the response, its CRC included.
    #[must_use]
    pub fn accepts(&self, frame: &[u8]) -> bool {
        let Some((&[unit, function], rest)) = frame.split_first_chunk::<2>() else { return false };
        if unit != self.unit || function & !FunctionCode::EXCEPTION_FLAG != self.function {
            return false;
        }
        let fits = match (function == self.function, self.shape) {
            (false, _) => frame.len() == EXCEPTION_LENGTH,
            (true, Shape::Data(count)) => rest.len() == data_length(count) && rest.first() == Some(&count),
            (true, Shape::Echo(head)) => {
                rest.len() == head.len().wrapping_add(checksum::CRC_LENGTH) && rest.starts_with(&head)
            }
            (true, Shape::Refusal) => false,
            (true, Shape::Open) => frame.len() <= FRAME_MAX,
        };
        fits && checksum::verify(frame).is_some()
    }
}

/// Byte count, data and CRC.
fn data_length(count: u8) -> usize {
    usize::from(count).wrapping_add(1).wrapping_add(checksum::CRC_LENGTH)
}

/// The response itself, then an exception.
impl Expectation<2> for ExpectedResponse {
    fn lengths(&self) -> [usize; 2] {
        let length = match self.shape {
            Shape::Data(count) => data_length(count).wrapping_add(2),
            Shape::Echo(_) => 8,
            Shape::Refusal | Shape::Open => 0,
        };
        [length, EXCEPTION_LENGTH]
    }

    fn accepts(&self, _: usize, frame: &[u8]) -> bool {
        self.accepts(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::{ExceptionCode, Range};

    #[test]
    fn request_lengths() {
        use FrameLength::{AtLeast, Exactly, Impossible, UntilSilence};
        for (prefix, expected) in [
            (&[1][..], AtLeast(4)),
            (&[1, 3], Exactly(8)),
            (&[1, 5], Exactly(8)),
            (&[1, 8], Exactly(8)),
            (&[1, 7], Exactly(4)),
            (&[1, 0x10, 0, 0, 0, 1], AtLeast(7)),
            (&[1, 0x10, 0, 0, 0, 1, 2], Exactly(11)),
            (&[1, 0x0F, 0, 0, 0, 10, 0], Exactly(9)),
            (&[1, 0x10, 0, 0, 0, 1, 247], Exactly(256)),
            (&[1, 0x10, 0, 0, 0, 1, 248], Impossible),
            (&[1, 0x17, 0, 0, 0, 1, 0, 0, 0, 1, 2], Exactly(15)),
            (&[1, 0x2B, 0x0E], Exactly(7)),
            (&[1, 0x2B, 0x0D], UntilSilence),
            (&[1, 0x41], UntilSilence),
            (&[1, 0x83], Impossible),
            (&[1, 0x00], Impossible),
        ] {
            assert_eq!(request_length(prefix), expected, "{prefix:x?}");
        }
    }

    #[test]
    fn only_the_response_to_the_request_is_accepted() {
        let mut buffer = [0; FRAME_MAX];
        let request = Request::WriteMultipleRegisters { range: Range::new(0x60, 2), data: &[0, 1, 0, 2] };
        let expected = ExpectedResponse::new(5, &request);
        let function = FunctionCode::WriteMultipleRegisters;
        let right = Response::WriteMultiple { function, range: Range::new(0x60, 2) };
        let refused = Response::exception(function, ExceptionCode::ServerDeviceBusy);
        for (unit, response, fits) in [
            (5, right, true),
            (6, right, false),
            (5, Response::WriteMultiple { function, range: Range::new(0x60, 3) }, false),
            (5, Response::WriteMultiple { function, range: Range::new(0x61, 2) }, false),
            (5, refused, true),
            (4, refused, false),
            (5, Response::exception(FunctionCode::ReadCoils, ExceptionCode::ServerDeviceBusy), false),
        ] {
            let frame = encode_response(unit, &response, &mut buffer).unwrap();
            assert_eq!(expected.accepts(frame), fits, "{unit} {response:?}");
            for cut in 0..frame.len() {
                assert!(!expected.accepts(&frame[..cut]));
            }
        }
    }

    #[test]
    fn responses_to_reads_are_known_by_their_length() {
        let expected = ExpectedResponse::new(1, &Request::ReadInputRegisters(Range::new(0, 2)));
        assert_eq!(expected.lengths(), [9, 5]);
        let mut buffer = [0; FRAME_MAX];
        for bytes in 0..=250 {
            let response =
                Response::Read { function: FunctionCode::ReadInputRegisters, data: &[7; 250][..bytes] };
            let frame = encode_response(1, &response, &mut buffer).unwrap();
            assert_eq!(expected.accepts(frame), bytes == 4);
        }
        let impossible = ExpectedResponse::new(1, &Request::ReadCoils(Range::new(0, 2009)));
        assert_eq!(impossible.lengths(), [0, 5]);
        assert_eq!(ExpectedResponse::new(1, &Request::ReadCoils(Range::new(0, 2008))).lengths(), [256, 5]);
    }
}
