//! What the parts of the server share: why there is no response, and how a response is begun, checked and ended.

use crate::error::error_text;
use crate::modbus::rtu::FrameError;
use crate::modbus::{AddressRange, ExceptionCode, FunctionCode, Request};
use crate::wire::{NoSpace, Truncated, Writer};

/// Why a request has no response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Failure {
    /// It is refused.
    Exception(ExceptionCode),
    /// The response does not fit the caller's buffer.
    NoSpace,
}

impl From<ExceptionCode> for Failure {
    fn from(exception: ExceptionCode) -> Self {
        Self::Exception(exception)
    }
}

impl From<Truncated> for Failure {
    fn from(Truncated: Truncated) -> Self {
        Self::Exception(ExceptionCode::IllegalDataValue)
    }
}

impl From<NoSpace> for Failure {
    fn from(NoSpace: NoSpace) -> Self {
        Self::NoSpace
    }
}

/// To whom a unit address speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Destination {
    /// To this server alone: it answers.
    Unit,
    /// To every server: writes only, never answered.
    Broadcast,
    /// To another one.
    Other,
}

/// Why a frame is not answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum NoResponse {
    /// Length or CRC are wrong.
    Frame(FrameError),
    /// For another unit.
    OtherUnit,
    /// A broadcast is never answered; it was carried out, or refused for the reason given.
    Broadcast(Option<ExceptionCode>),
    /// A broadcast that does not write.
    BroadcastRead,
    /// No server is asked by function code 0 or one above 0x7F: a response of another one, or noise.
    NoRequest,
    /// The response does not fit the caller's buffer; nothing has been written.
    NoSpace,
}

/// Puts an exception in place of a response that was begun at `start`, if there is one; tells it.
#[inline]
pub(super) fn conclude(
    result: Result<(), Failure>,
    code: u8,
    start: usize,
    writer: &mut Writer<'_>,
) -> Result<Option<ExceptionCode>, NoSpace> {
    match result {
        Ok(()) => Ok(None),
        Err(Failure::NoSpace) => Err(NoSpace),
        Err(Failure::Exception(exception)) => {
            writer.truncate(start);
            writer.slice(&[code | FunctionCode::EXCEPTION_FLAG, exception.code()])?;
            Ok(Some(exception))
        }
    }
}

/// The data unit of the response that `answer` appends, or of the exception that it refuses with.
pub(crate) fn data_unit<'b>(
    request: &Request<'_>,
    out: &'b mut [u8],
    answer: impl FnOnce(&mut Writer<'_>) -> Result<(), Failure>,
) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(out);
    let result = answer(&mut writer);
    conclude(result, request.function().code(), 0, &mut writer)?;
    Ok(writer.finish())
}

/// Appends the response to a write, which repeats the start of its request: function code, and what stood behind it.
#[inline]
pub(crate) fn echo(function: u8, [a, b, c, d]: [u8; 4], writer: &mut Writer<'_>) -> Result<(), Failure> {
    *writer.reserve(5)?.first_chunk_mut().ok_or(Failure::NoSpace)? = [function, a, b, c, d];
    Ok(())
}

/// Two words as [`echo`] takes them, most significant byte first.
pub(crate) const fn words([first, second]: [u16; 2]) -> [u8; 4] {
    let ([a, b], [c, d]) = (first.to_be_bytes(), second.to_be_bytes());
    [a, b, c, d]
}

/// Appends function code and byte count of the response to a read; the place of its data.
#[inline]
pub(crate) fn reading<'w>(
    function: u8,
    bytes: usize,
    writer: &'w mut Writer<'_>,
) -> Result<&'w mut [u8], Failure> {
    let count = u8::try_from(bytes).map_err(|_| ExceptionCode::IllegalDataValue)?;
    let [code, place, data @ ..] = writer.reserve(bytes.saturating_add(2))? else {
        return Err(Failure::NoSpace);
    };
    (*code, *place) = (function, count);
    Ok(data)
}

/// Quantity and what depends on it (exception 03), then the address (exception 02).
pub(super) fn check_range(range: AddressRange, max: u16, fits: bool) -> Result<(), ExceptionCode> {
    if range.quantity == 0 || range.quantity > max || !fits {
        return Err(ExceptionCode::IllegalDataValue);
    }
    if range.last().is_none() {
        return Err(ExceptionCode::IllegalDataAddress);
    }
    Ok(())
}

/// A value that the owner did not hand over is not made up.
pub(crate) fn complete(all: bool) -> Result<(), ExceptionCode> {
    if all { Ok(()) } else { Err(ExceptionCode::ServerDeviceFailure) }
}

pub(super) const fn bytes_of_registers(quantity: u16) -> usize {
    (quantity as usize).saturating_mul(2)
}

error_text! {
    NoResponse {
        NoResponse::Frame(error) => ("{error}"),
        NoResponse::OtherUnit => ("for another unit"),
        NoResponse::Broadcast(None) => ("a broadcast, carried out"),
        NoResponse::Broadcast(Some(exception)) => ("a broadcast, refused: {exception}"),
        NoResponse::BroadcastRead => ("a broadcast that does not write"),
        NoResponse::NoRequest => ("a function code that asks nothing"),
        NoResponse::NoSpace => ("the response does not fit the buffer"),
    }
}
