use super::Server;
use super::common::{Failure, bytes_of_registers, check_range, complete, reading};
use super::view::{RegisterWriter, Registers};
use crate::modbus::identification::{self, MEI_TYPE, OBJECT_MAX, ObjectId, ReadDeviceIdCode};
use crate::modbus::{
    DiagnosticSubfunction, ExceptionCode, PDU_MAX, READ_REGISTERS_MAX, READ_WRITE_REGISTERS_MAX, Request,
};
use crate::wire::Writer;

/// The function codes beside the basic ones.
pub(super) fn extended(server: &mut impl Server, pdu: &[u8], writer: &mut Writer<'_>) -> Result<(), Failure> {
    let request = Request::decode(pdu).map_err(|_| ExceptionCode::IllegalDataValue)?;
    let function = request.function();
    if let Request::ReadWriteMultipleRegisters { read, write, data } = request {
        let fits = data.len() == bytes_of_registers(write.quantity)
            && (1..=READ_REGISTERS_MAX).contains(&read.quantity);
        check_range(write, READ_WRITE_REGISTERS_MAX, fits)?;
        check_range(read, READ_REGISTERS_MAX, true)?;
        let mut registers =
            RegisterWriter::new(reading(function.code(), bytes_of_registers(read.quantity), writer)?);
        server.read_write_registers(write, Registers::new(data), read, &mut registers)?;
        return Ok(complete(registers.remaining() == 0)?);
    }
    if let Request::MaskWriteRegister { address, and, or } = request {
        writer.slice(pdu)?;
        return Ok(server.mask_write_register(address, and, or)?);
    }
    writer.u8(function.code())?;
    match request {
        Request::ReadExceptionStatus => {
            let place = writer.reserve(1)?;
            place.fill(server.exception_status()?);
        }
        Request::Diagnostics { subfunction, data } => diagnose(server, subfunction, data, writer)?,
        Request::GetCommEventCounter => {
            let mut place = RegisterWriter::new(writer.reserve(4)?);
            let (status, events) = server.comm_event_counter()?;
            place.extend([status, events]);
        }
        Request::ReportServerId => {
            let id = server.server_id()?;
            let length = u8::try_from(id.len()).ok().filter(|_| id.len() <= PDU_MAX.saturating_sub(2));
            writer.u8(length.ok_or(ExceptionCode::ServerDeviceFailure)?)?;
            writer.slice(id)?;
        }
        Request::ReadDeviceIdentification { category, object } => identify(server, category, object, writer)?,
        _ => return Err(ExceptionCode::IllegalFunction.into()),
    }
    Ok(())
}

fn diagnose(
    server: &mut impl Server,
    subfunction: DiagnosticSubfunction,
    data: &[u8],
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    if subfunction == DiagnosticSubfunction::ForceListenOnly {
        return Err(ExceptionCode::IllegalFunction.into());
    }
    let fits = match subfunction {
        DiagnosticSubfunction::ReturnQueryData => data.len().is_multiple_of(2) && !data.is_empty(),
        _ => data.len() == 2,
    };
    if !fits {
        return Err(ExceptionCode::IllegalDataValue.into());
    }
    writer.u16_be(subfunction.code())?;
    let place = writer.reserve(data.len())?;
    place.copy_from_slice(data);
    if let Some(answer) = server.diagnostics(subfunction, Registers::new(data))? {
        RegisterWriter::new(place).push(answer);
    }
    Ok(())
}

/// A stream of objects up to the last of its category, or one object. An unknown first object of a stream stands for
/// the first one of all (6.21).
fn identify(
    server: &mut impl Server,
    category: ReadDeviceIdCode,
    object: ObjectId,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let conformity = server.conformity();
    let (first, last) = match category {
        ReadDeviceIdCode::Unknown(_) => return Err(ExceptionCode::IllegalDataValue.into()),
        ReadDeviceIdCode::Individual if !conformity.is_individual() => {
            return Err(ExceptionCode::IllegalDataValue.into());
        }
        ReadDeviceIdCode::Individual if server.identification(object).is_none() => {
            return Err(ExceptionCode::IllegalDataAddress.into());
        }
        ReadDeviceIdCode::Individual => (object.code(), object.code()),
        ReadDeviceIdCode::Basic | ReadDeviceIdCode::Regular | ReadDeviceIdCode::Extended => {
            let offered = conformity.category().last_object().map_or(0, ObjectId::code);
            let last = category.last_object().map_or(0, ObjectId::code).min(offered);
            let known = object.code() <= last && server.identification(object).is_some();
            (if known { object.code() } else { 0 }, last)
        }
    };
    writer.slice(&[MEI_TYPE, category.code(), conformity.code()])?;
    // more follows, next object, number of objects: known at the end
    let mut room = PDU_MAX.saturating_sub(identification::RESPONSE_HEADER);
    let (mut more, mut next, mut count) = (0x00, 0, 0u8);
    let head = writer.written().len();
    writer.slice(&[more, next, count])?;
    for id in first..=last {
        let Some(value) = server.identification(ObjectId::from_code(id)) else { continue };
        let value = value.get(..OBJECT_MAX).unwrap_or(value);
        let Some(left) = room.checked_sub(value.len().saturating_add(2)) else {
            (more, next) = (0xFF, id);
            break;
        };
        room = left;
        count = count.saturating_add(1);
        writer.u8(id)?;
        writer.u8(u8::try_from(value.len()).unwrap_or(u8::MAX))?;
        writer.slice(value)?;
    }
    writer.patch(head, &[more, next, count]);
    Ok(())
}
