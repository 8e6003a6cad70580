//! RTU framing: unit address, protocol data unit, CRC ("Modbus over Serial Line", 2.5.1).

use super::{FunctionCode, Request, Response, identification};
use crate::checksum;
use crate::decode::{FrameLength, Framing};
use crate::error::error_text;
use crate::wire::NoSpace;

pub use super::expected::ExpectedResponse;

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
        let (unit, pdu) = checksum::strip_crc(frame)
            .ok_or(FrameError::Checksum)?
            .split_first()
            .ok_or(FrameError::Length)?;
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
    checksum::frame(unit, |writer| request.encode(writer), buffer)
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
    checksum::frame(unit, |writer| response.encode(writer), buffer)
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
            Some(&identification::MEI_TYPE) => FrameLength::Exactly(7),
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
pub struct RequestFraming;

impl Framing for RequestFraming {
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

error_text! {
    FrameError {
        FrameError::Length => ("shorter or longer than a frame can be"),
        FrameError::Checksum => ("the CRC does not fit"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
