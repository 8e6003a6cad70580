use super::Server;
use super::basic::basic;
use super::common::{Failure, NoResponse, conclude};
use super::extended::extended;
use crate::checksum::{self, CRC_LENGTH};
use crate::modbus::identification::MEI_TYPE;
use crate::modbus::rtu::{FRAME_MAX, FRAME_MIN, Frame, FrameError};
use crate::modbus::{BROADCAST, ExceptionCode, FunctionCode, ascii, tcp};
use crate::wire::{NoSpace, Writer};

/// Answers a request's data unit into `out`: the response, or an exception by the specification's state diagrams.
///
/// `out` must have room for the response even where an exception is the answer; [`PDU_MAX`](crate::modbus::PDU_MAX) bytes hold any.
///
/// # Errors
/// [`NoResponse::NoRequest`] or [`NoResponse::NoSpace`]; nothing has been written then.
pub fn respond<'b>(server: &mut impl Server, pdu: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
    let mut writer = Writer::new(out);
    answer(server, pdu, &mut writer)?;
    Ok(writer.finish())
}

/// Appends the response to `pdu`; tells the exception, if it is one.
fn answer(
    server: &mut impl Server,
    pdu: &[u8],
    writer: &mut Writer<'_>,
) -> Result<Option<ExceptionCode>, NoResponse> {
    let Some((&code @ 0x01..0x80, data)) = pdu.split_first() else { return Err(NoResponse::NoRequest) };
    let function = FunctionCode::from_code(code);
    let start = writer.written().len();
    let result = if !server.supports(function) {
        Err(Failure::Exception(ExceptionCode::IllegalFunction))
    } else if function.is_basic() {
        basic(server, code, function, data, writer)
    } else {
        extended(server, pdu, writer)
    };
    conclude(result, code, start, writer).map_err(|NoSpace| NoResponse::NoSpace)
}

/// Answers an RTU frame to `unit`, or to all, into `out`.
///
/// A broadcast that writes is carried out and never answered.
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn rtu<'b>(
    server: &mut impl Server,
    unit: u8,
    frame: &[u8],
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    rtu_with(checksum::crc16_rolled, server, unit, frame, out)
}

/// [`rtu`] with another way to compute the CRC: [`checksum::crc16_sliced`] on a host, [`checksum::crc16_small`] or
/// [`checksum::crc16_bitwise`] where flash is dearer than time, or a function of the board that uses its CRC unit.
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn rtu_with<'b>(
    crc16: impl Fn(&[u8]) -> u16,
    server: &mut impl Server,
    unit: u8,
    frame: &[u8],
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    if frame.len() < FRAME_MIN || frame.len() > FRAME_MAX {
        return Err(NoResponse::Frame(FrameError::Length));
    }
    let (Some((content, crc)), Some((&to, _))) =
        (frame.split_last_chunk::<CRC_LENGTH>(), frame.split_first())
    else {
        return Err(NoResponse::Frame(FrameError::Length));
    };
    // a frame for another unit need not be right
    if to != unit && to != BROADCAST {
        return Err(NoResponse::OtherUnit);
    }
    if crc16(content) != u16::from_le_bytes(*crc) {
        return Err(NoResponse::Frame(FrameError::Checksum));
    }
    // the CRC must find room after the owner was called
    let room = out.len().checked_sub(CRC_LENGTH).ok_or(NoResponse::NoSpace)?;
    let used = usize::from(serial(server, content, out.get_mut(..room).unwrap_or(&mut []))?);
    let (head, rest) = out.split_at_mut_checked(used).ok_or(NoResponse::NoSpace)?;
    let place = rest.first_chunk_mut::<CRC_LENGTH>().ok_or(NoResponse::NoSpace)?;
    *place = crc16(head).to_le_bytes();
    out.get(..used.saturating_add(CRC_LENGTH)).ok_or(NoResponse::NoSpace)
}

/// [`rtu`] of a frame whose checksum was looked at: from [`line::MultidropDecoder`](crate::modbus::line::MultidropDecoder).
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn rtu_frame<'b>(
    server: &mut impl Server,
    unit: u8,
    frame: &Frame<'_>,
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    if frame.unit != unit && frame.unit != BROADCAST {
        return Err(NoResponse::OtherUnit);
    }
    let room = out.len().checked_sub(CRC_LENGTH).ok_or(NoResponse::NoSpace)?;
    let used = parts(server, frame.unit, frame.pdu, out.get_mut(..room).unwrap_or(&mut []))?;
    let frame = out.get_mut(..usize::from(used).saturating_add(CRC_LENGTH)).ok_or(NoResponse::NoSpace)?;
    checksum::close(frame);
    Ok(frame)
}

/// Answers a frame of Modbus ASCII to `unit`, or to all, into `out`: the whole frame in characters.
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn ascii<'b>(
    server: &mut impl Server,
    unit: u8,
    frame: &ascii::Frame<'_>,
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    if frame.unit != unit && frame.unit != BROADCAST {
        return Err(NoResponse::OtherUnit);
    }
    // bytes become characters after the owner was called
    let room = ascii::content_length(out.len());
    let used = parts(server, frame.unit, frame.pdu, out.get_mut(..room).unwrap_or(&mut []))?;
    ascii::spread(out, used.into()).map_err(|NoSpace| NoResponse::NoSpace)
}

/// Answers a frame of Modbus TCP into `out`. Whether its unit is meant is for the caller to know: most servers answer
/// every one. There is no broadcast.
///
/// # Errors
/// [`NoResponse`]: why there is no answer.
pub fn tcp<'b>(
    server: &mut impl Server,
    frame: &tcp::Frame<'_>,
    out: &'b mut [u8],
) -> Result<&'b [u8], NoResponse> {
    let (header, rest) = out.split_at_mut_checked(tcp::HEADER_LENGTH).ok_or(NoResponse::NoSpace)?;
    let length = respond(server, frame.pdu, rest)?.len();
    let filled = tcp::Header::of(frame.transaction, frame.unit, length).map_err(|_| NoResponse::NoSpace)?;
    header.copy_from_slice(&filled.to_bytes());
    out.get(..tcp::HEADER_LENGTH.saturating_add(length)).ok_or(NoResponse::NoSpace)
}

/// [`Request::is_read`](crate::modbus::Request::is_read), told by the first bytes.
fn reads(pdu: &[u8]) -> bool {
    pdu.first().is_some_and(|code| FunctionCode::from_code(*code).is_read())
        || pdu.starts_with(&[FunctionCode::EncapsulatedInterface.code(), MEI_TYPE])
}

/// Unit address and data unit of the response to a request of both; their length.
fn serial(server: &mut impl Server, request: &[u8], out: &mut [u8]) -> Result<u16, NoResponse> {
    let (&to, pdu) = request.split_first().ok_or(NoResponse::NoRequest)?;
    parts(server, to, pdu, out)
}

/// [`serial`] of a request in two parts.
fn parts(server: &mut impl Server, to: u8, pdu: &[u8], out: &mut [u8]) -> Result<u16, NoResponse> {
    let broadcast = to == BROADCAST;
    if broadcast && reads(pdu) {
        return Err(NoResponse::BroadcastRead);
    }
    let mut writer = Writer::new(out);
    writer.u8(to).map_err(|NoSpace| NoResponse::NoSpace)?;
    let exception = answer(server, pdu, &mut writer)?;
    if broadcast {
        return Err(NoResponse::Broadcast(exception));
    }
    u16::try_from(writer.written().len()).map_err(|_| NoResponse::NoSpace)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::rtu::{encode_request, encode_response};
    use crate::modbus::server::RamTables;
    use crate::modbus::{AddressRange, Request, Response};
    use std::vec::Vec;

    type Tables = RamTables<0, 0, 4, 0>;

    const WRITE: Request<'_> = Request::WriteSingleRegister { address: 1, value: 0x0203 };

    fn request(unit: u8, request: &Request<'_>) -> Vec<u8> {
        encode_request(unit, request, &mut [0; FRAME_MAX]).unwrap().to_vec()
    }

    #[test]
    fn a_frame_in_a_frame_out_whatever_computes_the_crc() {
        let (frame, mut out) = (request(7, &WRITE), [0xEE; FRAME_MAX]);
        let mut tables = Tables::new();
        assert_eq!(rtu(&mut tables, 7, &frame, &mut out), Ok(&frame[..]));
        assert_eq!(tables.holding_registers, [0, 0x0203, 0, 0]);
        for crc in [checksum::crc16, checksum::crc16_sliced, checksum::crc16_small, checksum::crc16_bitwise] {
            assert_eq!(rtu_with(crc, &mut Tables::new(), 7, &frame, &mut out), Ok(&frame[..]));
        }
        let read = request(7, &Request::ReadHoldingRegisters(AddressRange::new(4, 1)));
        let function = FunctionCode::ReadHoldingRegisters;
        let refusal = Response::exception(function, ExceptionCode::IllegalDataAddress);
        let expected = encode_response(7, &refusal, &mut [0; 8]).unwrap().to_vec();
        assert_eq!(rtu(&mut tables, 7, &read, &mut out), Ok(&expected[..]));
    }

    #[test]
    fn silence_has_a_reason() {
        let (mut tables, mut out) = (Tables::new(), [0; FRAME_MAX]);
        let mut serve = |frame: &[u8]| rtu(&mut tables, 7, frame, &mut out).map(<[u8]>::to_vec);
        assert_eq!(serve(&request(8, &WRITE)), Err(NoResponse::OtherUnit));
        assert_eq!(serve(&[7, 3, 0]), Err(NoResponse::Frame(FrameError::Length)));
        assert_eq!(serve(&[7; 257]), Err(NoResponse::Frame(FrameError::Length)));
        assert_eq!(serve(&[7, 3, 0, 0]), Err(NoResponse::Frame(FrameError::Checksum)));
        assert_eq!(serve(&request(0, &WRITE)), Err(NoResponse::Broadcast(None)));
        let past = Request::WriteSingleRegister { address: 4, value: 0 };
        let refused = NoResponse::Broadcast(Some(ExceptionCode::IllegalDataAddress));
        assert_eq!(serve(&request(0, &past)), Err(refused));
        let read = Request::ReadHoldingRegisters(AddressRange::new(0, 1));
        assert_eq!(serve(&request(0, &read)), Err(NoResponse::BroadcastRead));
        let other = Request::Other { function: FunctionCode::Unknown(0x83), data: &[2] };
        assert_eq!(serve(&request(7, &other)), Err(NoResponse::NoRequest), "the response of another one");
        assert_eq!(tables.holding_registers, [0, 0x0203, 0, 0], "by broadcast");
    }

    #[test]
    fn without_room_for_the_response_nothing_is_written() {
        let (frame, mut characters) = (request(7, &WRITE), [0; 32]);
        let (content, _) = frame.split_last_chunk::<CRC_LENGTH>().unwrap();
        let in_ascii = ascii::Frame { unit: 7, pdu: &content[1..] };
        let in_tcp = tcp::Frame { transaction: 1, unit: 7, pdu: &content[1..] };
        let ascii_length = ascii::encode_request(7, &WRITE, &mut characters).unwrap().len();
        let mut tables = Tables::new();
        for space in 0..ascii_length {
            let mut out = [0; 32];
            if space < frame.len() {
                assert_eq!(rtu(&mut tables, 7, &frame, &mut out[..space]), Err(NoResponse::NoSpace));
            }
            if space < content.len() + tcp::HEADER_LENGTH - 1 {
                assert_eq!(tcp(&mut tables, &in_tcp, &mut out[..space]), Err(NoResponse::NoSpace));
            }
            assert_eq!(ascii(&mut tables, 7, &in_ascii, &mut out[..space]), Err(NoResponse::NoSpace));
            assert_eq!(tables, Tables::new(), "{space}");
        }
        let mut out = [0; 32];
        assert_eq!(ascii(&mut tables, 7, &in_ascii, &mut out), Ok(&characters[..ascii_length]));
        assert_eq!(ascii(&mut tables, 9, &in_ascii, &mut out), Err(NoResponse::OtherUnit));
        let everyone = ascii::Frame { unit: 0, ..in_ascii };
        assert_eq!(ascii(&mut tables, 9, &everyone, &mut out), Err(NoResponse::Broadcast(None)));
        let expected = [0, 1, 0, 0, 0, 6, 7, 6, 0, 1, 2, 3];
        assert_eq!(tcp(&mut tables, &in_tcp, &mut out), Ok(&expected[..]));
    }
}
