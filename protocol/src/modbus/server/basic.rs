use super::Server;
use super::common::{Failure, bytes_of_registers, check_range, complete, echo, reading};
use super::view::{BitWriter, Bits, RegisterWriter, Registers};
use crate::modbus::{
    AddressRange, COIL_OFF, COIL_ON, ExceptionCode, FunctionCode, READ_BITS_MAX, READ_REGISTERS_MAX,
    WRITE_BITS_MAX, WRITE_REGISTERS_MAX, packed_len,
};
use crate::wire::Writer;

/// The eight basic function codes.
pub(super) fn basic(
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
            check_range(range, READ_BITS_MAX, data.is_empty())?;
            let data = reading(code, packed_len(range.quantity), writer)?;
            let mut bits = BitWriter::new(data, range.quantity);
            match function {
                F::ReadCoils => server.read_coils(range, &mut bits)?,
                _ => server.read_discrete_inputs(range, &mut bits)?,
            }
            complete(bits.remaining() == 0)?;
        }
        F::ReadHoldingRegisters | F::ReadInputRegisters => {
            check_range(range, READ_REGISTERS_MAX, data.is_empty())?;
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
            echo(code, head, writer)?;
            server.write_coils(AddressRange::new(address, 1), Bits::new(&[on], 1))?;
        }
        F::WriteSingleRegister => {
            if !data.is_empty() {
                return Err(ExceptionCode::IllegalDataValue.into());
            }
            echo(code, head, writer)?;
            server.write_registers(AddressRange::new(address, 1), Registers::new(&[c, d]))?;
        }
        F::WriteMultipleCoils => {
            let values = counted(range, WRITE_BITS_MAX, packed_len(range.quantity), data)?;
            echo(code, head, writer)?;
            server.write_coils(range, Bits::new(values, range.quantity))?;
        }
        F::WriteMultipleRegisters => {
            let values = counted(range, WRITE_REGISTERS_MAX, bytes_of_registers(range.quantity), data)?;
            echo(code, head, writer)?;
            server.write_registers(range, Registers::new(values))?;
        }
        _ => return Err(ExceptionCode::IllegalFunction.into()),
    }
    Ok(())
}

/// The values of a write of many: `data` is their byte count, which is to be `bytes`, and as many bytes.
fn counted(range: AddressRange, max: u16, bytes: usize, data: &[u8]) -> Result<&[u8], ExceptionCode> {
    let (count, values) = data.split_first().ok_or(ExceptionCode::IllegalDataValue)?;
    check_range(range, max, values.len() == bytes && usize::from(*count) == bytes)?;
    Ok(values)
}
