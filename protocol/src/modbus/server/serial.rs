use super::common::{Destination, Failure, NoResponse, conclude};
use crate::checksum::{self, CRC_LENGTH};
use crate::modbus::rtu::Frame;
use crate::modbus::{ExceptionCode, FunctionCode, Request, RequestError, ascii};
use crate::wire::{NoSpace, Writer};

/// Answers an RTU frame into `out`: `dispatch` gets the unit and the request, and appends the data unit of the response.
///
/// `out` must have room for the response, also where a broadcast has none.
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn serve_rtu<'b>(
    frame: &[u8],
    audience: impl FnOnce(u8) -> Destination,
    dispatch: impl FnOnce(u8, &Request<'_>, &mut Writer<'_>) -> Result<(), Failure>,
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    let Frame { unit, pdu } = Frame::decode(frame).map_err(NoResponse::Frame)?;
    // the CRC must find room after what was asked has been done
    let room = out.len().checked_sub(CRC_LENGTH).ok_or(NoResponse::NoSpace)?;
    let used = answer(unit, pdu, audience, dispatch, out.get_mut(..room).unwrap_or(&mut []))?;
    let frame = out.get_mut(..used.saturating_add(CRC_LENGTH)).ok_or(NoResponse::NoSpace)?;
    checksum::close(frame);
    Ok(frame)
}

/// [`serve_rtu`] for a frame of Modbus ASCII; the answer is the whole frame in characters.
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn serve_ascii<'b>(
    frame: &ascii::Frame<'_>,
    audience: impl FnOnce(u8) -> Destination,
    dispatch: impl FnOnce(u8, &Request<'_>, &mut Writer<'_>) -> Result<(), Failure>,
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    // bytes become characters after what was asked has been done
    let room = ascii::content_length(out.len());
    let used = answer(frame.unit, frame.pdu, audience, dispatch, out.get_mut(..room).unwrap_or(&mut []))?;
    ascii::spread(out, used).map_err(|NoSpace| NoResponse::NoSpace)
}

/// Writes unit address and data unit of the response; its length.
fn answer(
    unit: u8,
    pdu: &[u8],
    audience: impl FnOnce(u8) -> Destination,
    dispatch: impl FnOnce(u8, &Request<'_>, &mut Writer<'_>) -> Result<(), Failure>,
    out: &mut [u8],
) -> Result<usize, NoResponse> {
    let audience = audience(unit);
    if audience == Destination::Other {
        return Err(NoResponse::OtherUnit);
    }
    let Some(code @ 0x01..0x80) = pdu.first().copied() else { return Err(NoResponse::NoRequest) };
    let mut writer = Writer::new(out);
    writer.u8(unit).map_err(|NoSpace| NoResponse::NoSpace)?;
    let result = match Request::decode(pdu) {
        Ok(request) if audience == Destination::Broadcast && request.is_read() => {
            return Err(NoResponse::BroadcastRead);
        }
        Ok(request) => dispatch(unit, &request, &mut writer),
        Err(error) => Err(exception_for(error).1.into()),
    };
    let exception = conclude(result, code, 1, &mut writer).map_err(|NoSpace| NoResponse::NoSpace)?;
    match audience {
        Destination::Broadcast => Err(NoResponse::Broadcast(exception)),
        Destination::Unit | Destination::Other => Ok(writer.written().len()),
    }
}

/// What refuses bytes that are no request: exception 03 where a length or byte count does not fit a function code of the
/// devices in this crate, 01 for the others.
#[must_use]
pub const fn exception_for(error: RequestError) -> (FunctionCode, ExceptionCode) {
    match error {
        RequestError::Empty => (FunctionCode::Unknown(0), ExceptionCode::IllegalFunction),
        RequestError::Length(function) if function.is_basic() => (function, ExceptionCode::IllegalDataValue),
        RequestError::Length(function) => (function, ExceptionCode::IllegalFunction),
    }
}
