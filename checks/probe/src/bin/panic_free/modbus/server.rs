//! The general server: over an owner that answers anything, and over tables in memory.

use jointbus_protocol::checksum;
use jointbus_protocol::modbus::identification::{ConformityLevel, ObjectId};
use jointbus_protocol::modbus::server::{
    self, BitWriter, Bits, Destination, Failure, RamTables, RegisterWriter, Registers, Server, exception_for,
    serve_ascii, serve_rtu,
};
use jointbus_protocol::modbus::{
    AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode, RequestError, ascii, rtu, tcp,
};

use jointbus_protocol::wire::Writer;

use super::{exception, function, range, response};
use crate::opaque::{any, buffer, byte, bytes, flag, sink, size, word};

pub(crate) fn all() {
    views();
    devices();
    serves(&mut Nothing);
    serves(&mut Anything);
    serves(&mut RamTables::<0, 0, 0, 0>::default());
    serves(&mut RamTables::<16, 250, 125, 300>::new());
}

#[inline(never)]
fn views() {
    let registers = Registers::new(bytes());
    sink((registers.len(), registers.is_empty(), registers.get(size())));
    registers.iter().for_each(sink);
    let mut table = any([0; 40]);
    if let Some(table) = table.get_mut(..size()) {
        registers.copy_to(table);
    }
    sink(table);
    let bits = Bits::new(bytes(), word());
    sink((bits.len(), bits.is_empty(), bits.get(word())));
    bits.iter().for_each(sink);
    buffer::<40>(|table| bits.copy_to(table, word()));
    buffer::<40>(|data| {
        let mut registers = RegisterWriter::new(data);
        registers.push(word());
        sink(registers.remaining());
        registers.extend((0..size()).map(|_| word()));
    });
    buffer::<40>(|data| {
        let mut bits = BitWriter::new(data, word());
        bits.push(flag());
        sink(bits.remaining());
        bits.extend((0..size()).map(|_| flag()));
        bits.copy_from(bytes(), word());
    });
}

/// What the device dispatchers stand on.
#[inline(never)]
fn devices() {
    let audience = |_| match any(0) {
        0 => Destination::Unit,
        1 => Destination::Broadcast,
        _ => Destination::Other,
    };
    let frame = ascii::Frame { unit: byte(), pdu: bytes() };
    buffer::<300>(|out| sink(serve_rtu(bytes(), audience, |_, _, writer| append(writer), out)));
    buffer::<600>(|out| sink(serve_ascii(&frame, audience, |_, _, writer| append(writer), out)));
    sink(exception_for(if flag() { RequestError::Empty } else { RequestError::Length(function()) }));
}

fn append(writer: &mut Writer<'_>) -> Result<(), Failure> {
    response().encode(writer)?;
    Ok(judge()?)
}

#[inline(never)]
fn serves(server: &mut impl Server) {
    buffer::<300>(|out| sink(server::respond(server, bytes(), out)));
    buffer::<300>(|out| sink(server::rtu(server, byte(), bytes(), out)));
    let frame = rtu::Frame { unit: byte(), pdu: bytes() };
    buffer::<300>(|out| sink(server::rtu_frame(server, byte(), &frame, out)));
    buffer::<300>(|out| sink(server::rtu_with(checksum::crc16_small, server, byte(), bytes(), out)));
    buffer::<300>(|out| sink(server::rtu_with(|_| word(), server, byte(), bytes(), out)));
    let frame = ascii::Frame { unit: byte(), pdu: bytes() };
    buffer::<600>(|out| sink(server::ascii(server, byte(), &frame, out)));
    let frame = tcp::Frame { transaction: word(), unit: byte(), pdu: bytes() };
    buffer::<300>(|out| sink(server::tcp(server, &frame, out)));
    methods(server);
}

/// The owner's methods themselves, as tables in memory have them.
#[inline(never)]
fn methods(server: &mut impl Server) {
    sink(server.supports(function()));
    buffer::<300>(|data| sink(server.read_coils(range(), &mut BitWriter::new(data, word()))));
    buffer::<300>(|data| sink(server.read_discrete_inputs(range(), &mut BitWriter::new(data, word()))));
    buffer::<300>(|data| sink(server.read_holding_registers(range(), &mut RegisterWriter::new(data))));
    buffer::<300>(|data| sink(server.read_input_registers(range(), &mut RegisterWriter::new(data))));
    sink(server.write_coils(range(), Bits::new(bytes(), word())));
    sink(server.write_registers(range(), Registers::new(bytes())));
    sink(server.mask_write_register(word(), word(), word()));
    buffer::<300>(|data| {
        let values = Registers::new(bytes());
        sink(server.read_write_registers(range(), values, range(), &mut RegisterWriter::new(data)));
    });
}

/// Has nothing: every method is the trait's own.
struct Nothing;

impl Server for Nothing {
    fn supports(&self, _: FunctionCode) -> bool {
        flag()
    }
}

/// Has everything, and refuses when it likes.
struct Anything;

fn judge() -> Result<(), ExceptionCode> {
    if flag() { Ok(()) } else { Err(exception()) }
}

impl Server for Anything {
    fn supports(&self, _: FunctionCode) -> bool {
        flag()
    }

    fn read_coils(&mut self, _: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        bits.copy_from(bytes(), word());
        judge()
    }

    fn read_discrete_inputs(
        &mut self,
        _: AddressRange,
        bits: &mut BitWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        bits.push(flag());
        judge()
    }

    fn read_holding_registers(
        &mut self,
        _: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        registers.push(word());
        judge()
    }

    fn read_input_registers(
        &mut self,
        _: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        registers.extend(core::iter::repeat_with(word));
        judge()
    }

    fn write_coils(&mut self, range: AddressRange, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        sink((range, bits));
        judge()
    }

    fn write_registers(
        &mut self,
        range: AddressRange,
        registers: Registers<'_>,
    ) -> Result<(), ExceptionCode> {
        sink((range, registers));
        judge()
    }

    fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
        sink((address, and, or));
        judge()
    }

    fn read_write_registers(
        &mut self,
        write: AddressRange,
        values: Registers<'_>,
        read: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        sink((write, values, read));
        registers.push(word());
        judge()
    }

    fn exception_status(&mut self) -> Result<u8, ExceptionCode> {
        judge().map(|()| byte())
    }

    fn diagnostics(
        &mut self,
        what: DiagnosticSubfunction,
        data: Registers<'_>,
    ) -> Result<Option<u16>, ExceptionCode> {
        sink((what, data));
        judge().map(|()| flag().then(word))
    }

    fn comm_event_counter(&mut self) -> Result<(u16, u16), ExceptionCode> {
        judge().map(|()| (word(), word()))
    }

    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        judge().map(|()| bytes())
    }

    fn conformity(&self) -> ConformityLevel {
        ConformityLevel::from_code(byte())
    }

    fn identification(&self, _: ObjectId) -> Option<&[u8]> {
        flag().then(bytes)
    }
}
