use super::Server;
use super::view::{BitWriter, Bits, RegisterWriter, Registers};
use crate::modbus::{AddressRange, ExceptionCode, FunctionCode, apply_mask};

/// Tables in memory, each from address 0 on: a [`Server`] of function codes 01 to 06, 0F, 10, 16 and 17.
///
/// `COILS` and `DISCRETE` count bytes of eight packed bits, `HOLDING` and `INPUT` count registers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RamTables<const COILS: usize, const DISCRETE: usize, const HOLDING: usize, const INPUT: usize> {
    /// Coils, the first in the least significant bit of the first byte.
    pub coils: [u8; COILS],
    /// Discrete inputs, packed likewise.
    pub discrete_inputs: [u8; DISCRETE],
    /// Holding registers.
    pub holding_registers: [u16; HOLDING],
    /// Input registers.
    pub input_registers: [u16; INPUT],
}

impl<const COILS: usize, const DISCRETE: usize, const HOLDING: usize, const INPUT: usize>
    RamTables<COILS, DISCRETE, HOLDING, INPUT>
{
    /// Tables full of 0.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            coils: [0; COILS],
            discrete_inputs: [0; DISCRETE],
            holding_registers: [0; HOLDING],
            input_registers: [0; INPUT],
        }
    }
}

impl<const COILS: usize, const DISCRETE: usize, const HOLDING: usize, const INPUT: usize> Default
    for RamTables<COILS, DISCRETE, HOLDING, INPUT>
{
    fn default() -> Self {
        Self::new()
    }
}

const ABSENT: ExceptionCode = ExceptionCode::IllegalDataAddress;

fn end(range: AddressRange) -> usize {
    usize::from(range.start).saturating_add(range.quantity.into())
}

#[inline]
fn read_bits(table: &[u8], range: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
    if end(range) > table.len().saturating_mul(8) {
        return Err(ABSENT);
    }
    bits.copy_from(table, range.start);
    Ok(())
}

fn read(table: &[u16], range: AddressRange, registers: &mut RegisterWriter<'_>) -> Result<(), ExceptionCode> {
    registers.extend(table.get(range.start.into()..end(range)).ok_or(ABSENT)?.iter().copied());
    Ok(())
}

impl<const COILS: usize, const DISCRETE: usize, const HOLDING: usize, const INPUT: usize> Server
    for RamTables<COILS, DISCRETE, HOLDING, INPUT>
{
    fn supports(&self, function: FunctionCode) -> bool {
        use FunctionCode as F;
        match function {
            F::ReadCoils | F::WriteSingleCoil | F::WriteMultipleCoils => COILS > 0,
            F::ReadDiscreteInputs => DISCRETE > 0,
            F::ReadHoldingRegisters
            | F::WriteSingleRegister
            | F::WriteMultipleRegisters
            | F::MaskWriteRegister
            | F::ReadWriteMultipleRegisters => HOLDING > 0,
            F::ReadInputRegisters => INPUT > 0,
            _ => false,
        }
    }

    fn read_coils(&mut self, range: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        read_bits(&self.coils, range, bits)
    }

    fn read_discrete_inputs(
        &mut self,
        range: AddressRange,
        bits: &mut BitWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        read_bits(&self.discrete_inputs, range, bits)
    }

    fn read_holding_registers(
        &mut self,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        read(&self.holding_registers, range, registers)
    }

    fn read_input_registers(
        &mut self,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        read(&self.input_registers, range, registers)
    }

    fn write_coils(&mut self, range: AddressRange, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        if end(range) > COILS.saturating_mul(8) {
            return Err(ABSENT);
        }
        bits.copy_to(&mut self.coils, range.start);
        Ok(())
    }

    fn write_registers(
        &mut self,
        range: AddressRange,
        registers: Registers<'_>,
    ) -> Result<(), ExceptionCode> {
        let table = self.holding_registers.get_mut(range.start.into()..end(range)).ok_or(ABSENT)?;
        registers.copy_to(table);
        Ok(())
    }

    fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
        let register = self.holding_registers.get_mut(usize::from(address)).ok_or(ABSENT)?;
        *register = apply_mask(*register, and, or);
        Ok(())
    }

    fn read_write_registers(
        &mut self,
        write: AddressRange,
        values: Registers<'_>,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        if end(range) > HOLDING {
            return Err(ABSENT);
        }
        self.write_registers(write, values)?;
        read(&self.holding_registers, range, registers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::rtu::ExpectedResponse;
    use crate::modbus::server::respond;
    use crate::modbus::{PDU_MAX, Request};
    use std::vec::Vec;

    type Tables = RamTables<2, 1, 200, 4>;

    fn ask(tables: &mut Tables, pdu: &[u8]) -> Vec<u8> {
        let mut out = [0xEE; PDU_MAX];
        let response = respond(tables, pdu, &mut out).unwrap();
        if let Ok(request) = Request::decode(pdu) {
            assert!(ExpectedResponse::new(1, &request).accepts_pdu(response), "{pdu:x?} -> {response:x?}");
        }
        response.to_vec()
    }

    #[test]
    fn what_is_written_is_read() {
        let mut tables = Tables::new();
        for (request, response) in [
            (&[0x05, 0, 3, 0xFF, 0][..], &[0x05, 0, 3, 0xFF, 0][..]),
            (&[0x0F, 0, 6, 0, 10, 2, 0b1010_0101, 0xFE], &[0x0F, 0, 6, 0, 10]),
            (&[0x01, 0, 0, 0, 16], &[0x01, 2, 0b0100_1000, 0b1010_1001]),
            (&[0x01, 0, 6, 0, 10], &[0x01, 2, 0b1010_0101, 0b10]),
            (&[0x06, 0, 1, 0x12, 0x34], &[0x06, 0, 1, 0x12, 0x34]),
            (&[0x10, 0, 2, 0, 2, 4, 1, 2, 3, 4], &[0x10, 0, 2, 0, 2]),
            (&[0x03, 0, 1, 0, 3], &[0x03, 6, 0x12, 0x34, 1, 2, 3, 4]),
            (&[0x16, 0, 1, 0, 0xF2, 0, 0x25], &[0x16, 0, 1, 0, 0xF2, 0, 0x25]),
            (&[0x03, 0, 1, 0, 1], &[0x03, 2, 0, 0x35]),
            // the read sees what was written by the same request
            (&[0x17, 0, 2, 0, 2, 0, 3, 0, 1, 2, 7, 8], &[0x17, 4, 1, 2, 7, 8]),
        ] {
            assert_eq!(ask(&mut tables, request), response, "{request:x?}");
        }
        tables.discrete_inputs = [0b0110_0000];
        tables.input_registers = [1, 2, 3, 0xABCD];
        assert_eq!(ask(&mut tables, &[0x02, 0, 5, 0, 3]), [0x02, 1, 0b011]);
        assert_eq!(ask(&mut tables, &[0x04, 0, 3, 0, 1]), [0x04, 2, 0xAB, 0xCD]);
    }

    #[test]
    fn a_table_ends_where_it_ends() {
        let mut tables = Tables::new();
        for pdu in [
            &[0x01, 0, 0, 0, 17][..],
            &[0x01, 0, 16, 0, 1],
            &[0x02, 0, 1, 0, 8],
            &[0x03, 0, 199, 0, 2],
            &[0x03, 0xFF, 0xFF, 0, 2],
            &[0x04, 0, 4, 0, 1],
            &[0x05, 0, 16, 0xFF, 0],
            &[0x06, 0, 200, 0, 0],
            &[0x0F, 0, 15, 0, 2, 1, 3],
            &[0x10, 0, 199, 0, 2, 4, 9, 9, 9, 9],
            &[0x16, 0, 200, 0, 0, 0, 0],
            &[0x17, 0, 199, 0, 2, 0, 0, 0, 1, 2, 9, 9],
            &[0x17, 0, 0, 0, 1, 0, 199, 0, 2, 4, 9, 9, 9, 9],
        ] {
            assert_eq!(ask(&mut tables, pdu), [pdu[0] | 0x80, 2], "{pdu:x?}");
            assert_eq!(tables, Tables::new(), "{pdu:x?} changed something");
        }
        let mut none = RamTables::<0, 0, 0, 0>::new();
        let mut out = [0; 8];
        assert_eq!(respond(&mut none, &[0x01, 0, 0, 0, 0], &mut out), Ok(&[0x81, 1][..]));
    }

    #[test]
    fn the_last_coil_of_the_largest_table() {
        let mut tables = RamTables::<8192, 0, 0, 0>::new();
        let mut out = [0; 8];
        respond(&mut tables, &[0x05, 0xFF, 0xFF, 0xFF, 0], &mut out).unwrap();
        assert_eq!(respond(&mut tables, &[0x01, 0xFF, 0xFF, 0, 1], &mut out), Ok(&[1, 1, 1][..]));
    }
}
