//! The general server: 512 coils, 512 discrete inputs, 128 holding and 128 input registers.

use jointbus_protocol::checksum;
use jointbus_protocol::modbus::server::{
    self, BitWriter, Bits, RamTables, RegisterWriter, Registers, Server,
};
use jointbus_protocol::modbus::{AddressRange, ExceptionCode};

use crate::{FRAME_MAX, Kind, Subject};

/// Tables that answer function codes 01 to 06, 0F and 10, as the others' servers here do.
struct Tables(RamTables<64, 64, 128, 128>);

impl Tables {
    const fn new() -> Self {
        Self(RamTables::new())
    }
}

impl Server for Tables {
    fn read_coils(&mut self, range: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        self.0.read_coils(range, bits)
    }

    fn read_discrete_inputs(
        &mut self,
        range: AddressRange,
        bits: &mut BitWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.0.read_discrete_inputs(range, bits)
    }

    fn read_holding_registers(
        &mut self,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.0.read_holding_registers(range, registers)
    }

    fn read_input_registers(
        &mut self,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.0.read_input_registers(range, registers)
    }

    fn write_coils(&mut self, range: AddressRange, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        self.0.write_coils(range, bits)
    }

    fn write_registers(
        &mut self,
        range: AddressRange,
        registers: Registers<'_>,
    ) -> Result<(), ExceptionCode> {
        self.0.write_registers(range, registers)
    }
}

/// The server with the CRC of the `crc` crate: a table of 512 bytes.
pub struct WithTable(Tables);

impl Subject for WithTable {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self(Tables::new())
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        server::rtu(&mut self.0, 1, frame, out).map_or(0, <[u8]>::len)
    }
}

/// The server with tables of 2 KiB: what is advised for a host.
pub struct WithSlices(Tables);

impl Subject for WithSlices {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self(Tables::new())
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        server::rtu_with(checksum::crc16_sliced, &mut self.0, 1, frame, out).map_or(0, <[u8]>::len)
    }
}

/// The server with a table of 32 bytes.
pub struct WithSmallTable(Tables);

impl Subject for WithSmallTable {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self(Tables::new())
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        server::rtu_with(checksum::crc16_small, &mut self.0, 1, frame, out).map_or(0, <[u8]>::len)
    }
}

/// The server without a table.
pub struct WithoutTable(Tables);

impl Subject for WithoutTable {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self(Tables::new())
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        server::rtu_with(checksum::crc16_bitwise, &mut self.0, 1, frame, out).map_or(0, <[u8]>::len)
    }
}
