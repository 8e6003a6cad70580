use super::NoResponse;
use super::extended::rarer;
use super::owner::{Failure, Server};
use super::view::{BitWriter, Bits, RegisterWriter, Registers};
use crate::modbus::{
    AddressRange, COIL_OFF, COIL_ON, ExceptionCode, FunctionCode, READ_BITS_MAX, READ_REGISTERS_MAX, Request,
    WRITE_BITS_MAX, WRITE_REGISTERS_MAX, packed_len,
};
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
pub(super) fn answer(
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
        rarer(server, pdu, writer)
    };
    conclude(result, code, start, writer).map_err(|NoSpace| NoResponse::NoSpace)
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

/// The eight basic function codes.
fn basic(
    server: &mut impl Server,
    code: u8,
    function: FunctionCode,
    data: &[u8],
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    use FunctionCode as F;
    let Some((&head @ [a, b, c, d], data)) = data.split_first_chunk() else {
        return Err(ExceptionCode::IllegalDataValue.into());
    };
    let range @ AddressRange { start: address, quantity: value } =
        AddressRange::new(u16::from_be_bytes([a, b]), u16::from_be_bytes([c, d]));
    match function {
        F::ReadCoils | F::ReadDiscreteInputs => {
            judge(range, READ_BITS_MAX, data.is_empty())?;
            let data = reading(code, packed_len(range.quantity), writer)?;
            let mut bits = BitWriter::new(data, range.quantity);
            match function {
                F::ReadCoils => server.read_coils(range, &mut bits)?,
                _ => server.read_discrete_inputs(range, &mut bits)?,
            }
            complete(bits.remaining() == 0)?;
        }
        F::ReadHoldingRegisters | F::ReadInputRegisters => {
            judge(range, READ_REGISTERS_MAX, data.is_empty())?;
            let data = reading(code, bytes_of_registers(range.quantity), writer)?;
            let mut registers = RegisterWriter::new(data);
            match function {
                F::ReadHoldingRegisters => server.read_holding_registers(range, &mut registers)?,
                _ => server.read_input_registers(range, &mut registers)?,
            }
            complete(registers.remaining() == 0)?;
        }
        F::WriteSingleCoil => {
            let on = match value {
                COIL_ON if data.is_empty() => 1,
                COIL_OFF if data.is_empty() => 0,
                _ => return Err(ExceptionCode::IllegalDataValue.into()),
            };
            echoed(code, head, writer)?;
            server.write_coils(AddressRange::new(address, 1), Bits::new(&[on], 1))?;
        }
        F::WriteSingleRegister => {
            if !data.is_empty() {
                return Err(ExceptionCode::IllegalDataValue.into());
            }
            echoed(code, head, writer)?;
            server.write_registers(AddressRange::new(address, 1), Registers::new(&[c, d]))?;
        }
        F::WriteMultipleCoils => {
            let values = counted(range, WRITE_BITS_MAX, packed_len(range.quantity), data)?;
            echoed(code, head, writer)?;
            server.write_coils(range, Bits::new(values, range.quantity))?;
        }
        F::WriteMultipleRegisters => {
            let values = counted(range, WRITE_REGISTERS_MAX, bytes_of_registers(range.quantity), data)?;
            echoed(code, head, writer)?;
            server.write_registers(range, Registers::new(values))?;
        }
        _ => return Err(ExceptionCode::IllegalFunction.into()),
    }
    Ok(())
}

/// The values of a write of many: `data` is their byte count, which is to be `bytes`, and as many bytes.
fn counted(range: AddressRange, max: u16, bytes: usize, data: &[u8]) -> Result<&[u8], ExceptionCode> {
    let (count, values) = data.split_first().ok_or(ExceptionCode::IllegalDataValue)?;
    judge(range, max, values.len() == bytes && usize::from(*count) == bytes)?;
    Ok(values)
}

/// Appends the response to a write: function code, and what stood behind it in the request.
#[inline]
fn echoed(function: u8, [a, b, c, d]: [u8; 4], writer: &mut Writer<'_>) -> Result<(), Failure> {
    *writer.reserve(5)?.first_chunk_mut().ok_or(Failure::NoSpace)? = [function, a, b, c, d];
    Ok(())
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

/// Appends the response to a write: function code, and the first two values of the request.
#[inline]
pub(crate) fn written(
    function: u8,
    [first, second]: [u16; 2],
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let ([a, b], [c, d]) = (first.to_be_bytes(), second.to_be_bytes());
    let place = writer.reserve(5)?.first_chunk_mut().ok_or(Failure::NoSpace)?;
    *place = [function, a, b, c, d];
    Ok(())
}

/// Quantity and what depends on it (exception 03), then the address (exception 02).
pub(super) fn judge(range: AddressRange, max: u16, fits: bool) -> Result<(), ExceptionCode> {
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

pub(super) fn echo(writer: &mut Writer<'_>, first: u16, second: u16) -> Result<(), NoSpace> {
    writer.u16_be(first)?;
    writer.u16_be(second)
}

pub(super) const fn bytes_of_registers(quantity: u16) -> usize {
    (quantity as usize).saturating_mul(2)
}
