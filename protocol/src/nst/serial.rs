//! The form on RS232 and RS485: address, body, CRC low byte first (4.2.3).

use super::{
    COMMAND_LENGTH, FunctionCode, REPLY_DATA_MAX, RESPONSE_HEADER, Request, Response, WRITE_DATA_MAX,
};
use crate::checksum;
use crate::decode::{FrameLength, Framing, Match};
use crate::wire::NoSpace;

/// Bytes around a body: address and CRC.
pub const OVERHEAD: usize = 1 + checksum::CRC_LENGTH;

/// Longest request frame.
pub const REQUEST_MAX: usize = COMMAND_LENGTH + WRITE_DATA_MAX + OVERHEAD;

/// Longest reply frame.
pub const RESPONSE_MAX: usize = RESPONSE_HEADER + REPLY_DATA_MAX + OVERHEAD;

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
        let (address, body) = checksum::strip_crc(frame)?.split_first()?;
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
    checksum::frame(address, |writer| request.encode(writer), buffer)
}

/// Writes a reply as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_reply<'b>(
    address: u8,
    reply: &Response<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    checksum::frame(address, |writer| reply.encode(writer), buffer)
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

/// Length of the response frame that starts with `prefix`, whatever the request was.
#[must_use]
pub fn response_length(prefix: &[u8]) -> FrameLength {
    const HEAD: usize = 1 + RESPONSE_HEADER;
    let Some(&code) = prefix.get(1) else { return FrameLength::AtLeast(HEAD) };
    match (FunctionCode::from_code(code), prefix.get(2)) {
        (FunctionCode::Unknown(_), _) => FrameLength::Impossible,
        (_, None) => FrameLength::AtLeast(HEAD),
        (function, Some(_)) if !function.is_read() => FrameLength::Exactly(RESPONSE_HEADER + OVERHEAD),
        (_, Some(&length)) if usize::from(length) <= REPLY_DATA_MAX => {
            FrameLength::Exactly((RESPONSE_HEADER + OVERHEAD).saturating_add(length.into()))
        }
        _ => FrameLength::Impossible,
    }
}

/// Requests to one device of a line that has no other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RequestFraming;

impl Framing for RequestFraming {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        request_length(prefix)
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        checksum::strip_crc(frame).is_some()
    }

    fn is_broadcast(&self, frame: &[u8]) -> bool {
        frame.first() == Some(&super::BROADCAST)
    }
}

/// What a master remembers of a request to know the reply: address, function code and length.
///
/// NST numbers nothing: a late reply to a request of the same function code and length fits as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ExpectedResponse {
    address: u8,
    function: FunctionCode,
    length: u8,
}

impl ExpectedResponse {
    /// What the device at `address` may answer to `request`.
    #[must_use]
    pub fn new(address: u8, request: &Request<'_>) -> Self {
        Self { address, function: request.function(), length: request.length() }
    }

    /// Address that was asked.
    #[must_use]
    pub const fn address(&self) -> u8 {
        self.address
    }

    /// Function code that was asked.
    #[must_use]
    pub const fn function(&self) -> FunctionCode {
        self.function
    }

    /// Length that was asked.
    #[must_use]
    pub const fn length(&self) -> u8 {
        self.length
    }

    /// Length of the reply's body.
    #[must_use]
    pub fn body_length(&self) -> usize {
        let data = if self.function.is_read() { usize::from(self.length) } else { 0 };
        RESPONSE_HEADER.saturating_add(data)
    }

    /// Whether `body` is the reply: function code and length fit.
    #[must_use]
    pub fn accepts_body(&self, body: &[u8]) -> bool {
        self.fits(self.function, body)
    }

    /// Whether `body` is the reply to a read, but with function code 0x10, as the manual prints it for CAN (4.3.2.10).
    #[must_use]
    pub fn accepts_legacy_code(&self, body: &[u8]) -> bool {
        self.function.is_read() && self.fits(FunctionCode::Write, body)
    }

    /// Whether a whole frame is the reply, its CRC included.
    #[must_use]
    pub fn accepts(&self, frame: &[u8]) -> bool {
        frame.first() == Some(&self.address)
            && Frame::decode(frame).is_some_and(|frame| self.accepts_body(frame.body))
    }

    /// Length of the frame that starts with `prefix`, if that is the reply.
    pub(super) fn frame_length(&self, prefix: &[u8]) -> FrameLength {
        let head = [self.address, self.function.code(), self.length];
        match prefix.iter().zip(&head).all(|(came, due)| came == due) {
            false => FrameLength::Impossible,
            true if prefix.len() < head.len() => FrameLength::AtLeast(head.len()),
            true => FrameLength::Exactly(self.body_length().saturating_add(OVERHEAD)),
        }
    }

    fn fits(&self, function: FunctionCode, body: &[u8]) -> bool {
        body.split_first_chunk::<RESPONSE_HEADER>().is_some_and(|([code, length], _)| {
            *code == function.code() && *length == self.length && body.len() == self.body_length()
        })
    }
}

impl Match<1> for ExpectedResponse {
    fn lengths(&self) -> [usize; 1] {
        [self.body_length().saturating_add(OVERHEAD)]
    }

    fn accepts(&self, _: usize, frame: &[u8]) -> bool {
        self.accepts(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reply_fits_its_request_by_function_code_and_length() {
        let read = ExpectedResponse::new(1, &Request::read(0x0200, 2));
        assert!(read.accepts_body(&[3, 2, 9, 9]));
        assert!(!read.accepts_body(&[3, 2, 9]));
        assert!(!read.accepts_body(&[3, 3, 9, 9, 9]));
        assert!(!read.accepts_body(&[0x10, 2, 9, 9]));
        assert!(read.accepts_legacy_code(&[0x10, 2, 9, 9]));
        let write = ExpectedResponse::new(1, &Request::Write { register: 0x0193, data: &[5] });
        assert!(write.accepts_body(&[0x10, 1]));
        assert!(!write.accepts_body(&[0x10, 1, 5]));
        assert!(!write.accepts_legacy_code(&[0x10, 1]));
        // 4.3.1.1
        let printed = [0x01, 0x10, 0x01, 0xEC, 0x00];
        assert!(write.accepts(&printed));
        assert!(
            !ExpectedResponse::new(2, &Request::Write { register: 0x0193, data: &[5] }).accepts(&printed)
        );
        assert_eq!(write.lengths(), [printed.len()]);
    }

    #[test]
    fn request_lengths() {
        use FrameLength::{AtLeast, Exactly, Impossible};
        for (prefix, expected) in [
            (&[1][..], AtLeast(2)),
            (&[1, 3], Exactly(7)),
            (&[1, 0x19], Exactly(7)),
            (&[1, 4], Impossible),
            (&[1, 0x10, 0, 0], AtLeast(5)),
            (&[1, 0x10, 0, 0, 0], Exactly(7)),
            (&[1, 0x10, 0, 0, 249], Exactly(256)),
            (&[1, 0x10, 0, 0, 250], Impossible),
        ] {
            assert_eq!(request_length(prefix), expected, "{prefix:x?}");
        }
        assert_eq!(REQUEST_MAX, 256);
    }
}
