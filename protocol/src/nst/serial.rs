//! The form on RS232 and RS485: address, body, CRC low byte first (4.2.3).

use super::{COMMAND_LENGTH, FunctionCode, REPLY_DATA_MAX, REPLY_HEADER, Reply, Request, WRITE_DATA_MAX};
use crate::checksum;
use crate::deframe::{Format, FrameLength};
use crate::wire::{NoSpace, Writer};

/// Bytes around a body: address and CRC.
pub const OVERHEAD: usize = 1 + checksum::CRC_LENGTH;

/// Longest request frame.
pub const REQUEST_MAX: usize = COMMAND_LENGTH + WRITE_DATA_MAX + OVERHEAD;

/// Longest reply frame.
pub const REPLY_MAX: usize = REPLY_HEADER + REPLY_DATA_MAX + OVERHEAD;

/// A frame whose CRC was right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame<'a> {
    /// Address of the device.
    pub address: u8,
    /// Function code onward.
    pub body: &'a [u8],
}

impl<'a> Frame<'a> {
    /// Checks a whole frame and takes it apart; `None` where the CRC is wrong or there is nothing before it.
    #[must_use]
    pub fn decode(frame: &'a [u8]) -> Option<Self> {
        let (address, body) = checksum::verify(frame)?.split_first()?;
        Some(Self { address: *address, body })
    }
}

/// Writes a request as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_request<'b>(
    address: u8,
    request: &Request<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(address)?;
    request.encode(&mut writer)?;
    checksum::seal(&mut writer)?;
    Ok(writer.finish())
}

/// Writes a reply as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_reply<'b>(address: u8, reply: &Reply<'_>, buffer: &'b mut [u8]) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(address)?;
    reply.encode(&mut writer)?;
    checksum::seal(&mut writer)?;
    Ok(writer.finish())
}

/// Length of the request frame that starts with `prefix`.
#[must_use]
pub fn request_length(prefix: &[u8]) -> FrameLength {
    const COMMAND: usize = COMMAND_LENGTH + OVERHEAD;
    let Some(&code) = prefix.get(1) else { return FrameLength::AtLeast(2) };
    match FunctionCode::from_code(code) {
        FunctionCode::Unknown(_) => FrameLength::Impossible,
        FunctionCode::Write => match prefix.get(COMMAND_LENGTH) {
            None => FrameLength::AtLeast(COMMAND_LENGTH + 1),
            Some(&length) if usize::from(length) <= WRITE_DATA_MAX => {
                FrameLength::Exactly(COMMAND.saturating_add(usize::from(length)))
            }
            Some(_) => FrameLength::Impossible,
        },
        _ => FrameLength::Exactly(COMMAND),
    }
}

/// Requests to one device of a line that has no other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Requests;

impl Format for Requests {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        request_length(prefix)
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        checksum::verify(frame).is_some()
    }

    fn is_broadcast(&self, frame: &[u8]) -> bool {
        frame.first() == Some(&super::BROADCAST)
    }
}
