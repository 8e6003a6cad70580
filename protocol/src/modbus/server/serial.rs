use crate::error::error_text;
use crate::modbus::rtu::{self, Frame, FrameError};
use crate::modbus::{ExceptionCode, FunctionCode, PDU_MAX, Request, RequestError, Response, ascii};
use crate::wire::NoSpace;

/// To whom a unit address speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Audience {
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
pub enum Silence {
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
    /// The response does not fit the caller's buffer. A [`Server`](super::Server) has written nothing then; behind
    /// [`serve_rtu`] a write has been carried out all the same.
    NoSpace,
}

/// Answers an RTU frame into `out`: `dispatch` gets the unit, the request and room for the data of a read.
///
/// # Errors
/// [`Silence`]: why there is no answer.
pub fn serve_rtu<'b>(
    frame: &[u8],
    audience: impl FnOnce(u8) -> Audience,
    dispatch: impl for<'d> FnOnce(u8, &Request<'_>, &'d mut [u8]) -> Response<'d>,
    out: &'b mut [u8],
) -> Result<&'b [u8], Silence> {
    let Frame { unit, pdu } = Frame::decode(frame).map_err(Silence::Frame)?;
    let mut data = [0; PDU_MAX];
    let response = judge(unit, pdu, audience, dispatch, &mut data)?;
    rtu::encode_response(unit, &response, out).map_err(|NoSpace| Silence::NoSpace)
}

/// [`serve_rtu`] for a frame of Modbus ASCII; the answer is the whole frame in characters.
///
/// # Errors
/// [`Silence`]: why there is no answer.
pub fn serve_ascii<'b>(
    frame: &ascii::Frame<'_>,
    audience: impl FnOnce(u8) -> Audience,
    dispatch: impl for<'d> FnOnce(u8, &Request<'_>, &'d mut [u8]) -> Response<'d>,
    out: &'b mut [u8],
) -> Result<&'b [u8], Silence> {
    let mut data = [0; PDU_MAX];
    let response = judge(frame.unit, frame.pdu, audience, dispatch, &mut data)?;
    ascii::encode_response(frame.unit, &response, out).map_err(|NoSpace| Silence::NoSpace)
}

fn judge<'d>(
    unit: u8,
    pdu: &[u8],
    audience: impl FnOnce(u8) -> Audience,
    dispatch: impl FnOnce(u8, &Request<'_>, &'d mut [u8]) -> Response<'d>,
    data: &'d mut [u8],
) -> Result<Response<'d>, Silence> {
    let audience = audience(unit);
    if audience == Audience::Other {
        return Err(Silence::OtherUnit);
    }
    let response = match Request::decode(pdu) {
        Ok(Request::Other { function: FunctionCode::Unknown(0x00 | 0x80..), .. }) => {
            return Err(Silence::NoRequest);
        }
        Ok(request) if audience == Audience::Broadcast && request.is_read() => {
            return Err(Silence::BroadcastRead);
        }
        Ok(request) => dispatch(unit, &request, data),
        Err(error) => malformed(error),
    };
    match (audience, response) {
        (Audience::Broadcast, Response::Exception { exception, .. }) => {
            Err(Silence::Broadcast(Some(exception)))
        }
        (Audience::Broadcast, _) => Err(Silence::Broadcast(None)),
        _ => Ok(response),
    }
}

/// The answer to what is no request: exception 03 where a length or byte count does not fit a function code of the
/// devices in this crate, 01 for the others.
#[must_use]
pub const fn malformed(error: RequestError) -> Response<'static> {
    use FunctionCode as F;
    match error {
        RequestError::Empty => Response::exception(F::Unknown(0), ExceptionCode::IllegalFunction),
        RequestError::Length(
            function @ (F::ReadCoils
            | F::ReadDiscreteInputs
            | F::ReadHoldingRegisters
            | F::ReadInputRegisters
            | F::WriteSingleCoil
            | F::WriteSingleRegister
            | F::WriteMultipleCoils
            | F::WriteMultipleRegisters),
        ) => Response::exception(function, ExceptionCode::IllegalDataValue),
        RequestError::Length(function) => Response::exception(function, ExceptionCode::IllegalFunction),
    }
}

error_text! {
    Silence {
        Silence::Frame(error) => ("{error}"),
        Silence::OtherUnit => ("for another unit"),
        Silence::Broadcast(None) => ("a broadcast, carried out"),
        Silence::Broadcast(Some(exception)) => ("a broadcast, refused: {exception}"),
        Silence::BroadcastRead => ("a broadcast that does not write"),
        Silence::NoRequest => ("a function code that asks nothing"),
        Silence::NoSpace => ("the response does not fit the buffer"),
    }
}
