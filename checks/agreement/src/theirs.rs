//! libmodbus as an RTU server on one end of a pair of sockets.

use std::ffi::{c_char, c_int};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::slice;

use crate::Tables;

#[repr(C)]
struct Context {
    _private: [u8; 0],
}

/// `modbus_mapping_t` of modbus.h.
#[repr(C)]
struct Mapping {
    nb_bits: c_int,
    start_bits: c_int,
    nb_input_bits: c_int,
    start_input_bits: c_int,
    nb_input_registers: c_int,
    start_input_registers: c_int,
    nb_registers: c_int,
    start_registers: c_int,
    tab_bits: *mut u8,
    tab_input_bits: *mut u8,
    tab_input_registers: *mut u16,
    tab_registers: *mut u16,
}

unsafe extern "C" {
    fn modbus_new_rtu(
        device: *const c_char,
        baud: c_int,
        parity: c_char,
        bits: c_int,
        stop: c_int,
    ) -> *mut Context;
    fn modbus_set_slave(context: *mut Context, slave: c_int) -> c_int;
    fn modbus_set_socket(context: *mut Context, socket: c_int) -> c_int;
    fn modbus_set_response_timeout(context: *mut Context, seconds: u32, micros: u32) -> c_int;
    fn modbus_set_byte_timeout(context: *mut Context, seconds: u32, micros: u32) -> c_int;
    fn modbus_mapping_new(
        bits: c_int,
        input_bits: c_int,
        registers: c_int,
        input_registers: c_int,
    ) -> *mut Mapping;
    fn modbus_receive(context: *mut Context, request: *mut u8) -> c_int;
    fn modbus_reply(context: *mut Context, request: *const u8, length: c_int, mapping: *mut Mapping)
    -> c_int;
}

/// Room for what `modbus_receive` writes: more than `MODBUS_RTU_MAX_ADU_LENGTH`.
const REQUEST_ROOM: usize = 512;

/// A server of libmodbus. It lives as long as the program.
pub(crate) struct Theirs {
    context: *mut Context,
    mapping: *mut Mapping,
    /// Our end of the line.
    line: UnixStream,
    /// Its end, to be emptied of what it left unread.
    end: UnixStream,
}

impl Theirs {
    /// A server at `unit` with these tables.
    pub(crate) fn new(unit: u8, tables: &Tables) -> io::Result<Self> {
        let (line, end) = UnixStream::pair()?;
        line.set_nonblocking(true)?;
        end.set_nonblocking(true)?;
        let bits = |bytes: usize| c_int::try_from(8 * bytes).unwrap();
        let count = |registers: usize| c_int::try_from(registers).unwrap();
        // SAFETY: the device is never opened; the results are checked before they are used.
        let (context, mapping) = unsafe {
            (
                modbus_new_rtu(c"/dev/null".as_ptr(), 19200, b'N' as c_char, 8, 1),
                modbus_mapping_new(
                    bits(tables.coils.len()),
                    bits(tables.discrete_inputs.len()),
                    count(tables.holding_registers.len()),
                    count(tables.input_registers.len()),
                ),
            )
        };
        assert!(!context.is_null() && !mapping.is_null(), "libmodbus has no memory");
        // SAFETY: the context is valid and not shared. A microsecond: everything that will come has come.
        unsafe {
            assert_eq!(modbus_set_slave(context, unit.into()), 0);
            assert_eq!(modbus_set_socket(context, end.as_raw_fd()), 0);
            assert_eq!(modbus_set_response_timeout(context, 0, 1), 0);
            assert_eq!(modbus_set_byte_timeout(context, 0, 1), 0);
        }
        let mut server = Self { context, mapping, line, end };
        server.set(tables);
        Ok(server)
    }

    /// What it answers to a frame that is followed by silence; empty for nothing.
    pub(crate) fn serve(&mut self, frame: &[u8]) -> io::Result<Vec<u8>> {
        self.line.write_all(frame)?;
        let mut request = [0; REQUEST_ROOM];
        // SAFETY: the context and the mapping are valid, and the buffer is longer than any frame it takes.
        unsafe {
            let length = modbus_receive(self.context, request.as_mut_ptr());
            if length > 0 {
                modbus_reply(self.context, request.as_ptr(), length, self.mapping);
            }
        }
        drain(&mut self.end)?;
        drain(&mut self.line)
    }

    /// Its tables.
    pub(crate) fn tables(&self) -> Tables {
        let mut tables = Tables::new();
        let [coils, inputs] = self.bits();
        tables.coils = core::array::from_fn(|byte| pack(&coils[8 * byte..]));
        tables.discrete_inputs = core::array::from_fn(|byte| pack(&inputs[8 * byte..]));
        let [holding, input] = self.registers();
        tables.holding_registers.copy_from_slice(holding);
        tables.input_registers.copy_from_slice(input);
        tables
    }

    /// Makes its tables these.
    pub(crate) fn set(&mut self, tables: &Tables) {
        let unpack = |bytes: &[u8], bits: &mut [u8]| {
            bits.iter_mut().enumerate().for_each(|(index, bit)| *bit = bytes[index / 8] >> (index % 8) & 1);
        };
        let [coils, inputs] = self.bits();
        unpack(&tables.coils, coils);
        unpack(&tables.discrete_inputs, inputs);
        let [holding, input] = self.registers();
        holding.copy_from_slice(&tables.holding_registers);
        input.copy_from_slice(&tables.input_registers);
    }

    #[expect(clippy::mut_from_ref, reason = "the memory is libmodbus's own, used by one thread")]
    fn bits(&self) -> [&mut [u8]; 2] {
        // SAFETY: the mapping is valid, its tables are as long as it says, and nobody else uses them now.
        unsafe {
            let mapping = &*self.mapping;
            [
                slice::from_raw_parts_mut(mapping.tab_bits, mapping.nb_bits as usize),
                slice::from_raw_parts_mut(mapping.tab_input_bits, mapping.nb_input_bits as usize),
            ]
        }
    }

    #[expect(clippy::mut_from_ref, reason = "the memory is libmodbus's own, used by one thread")]
    fn registers(&self) -> [&mut [u16]; 2] {
        // SAFETY: as in `bits`.
        unsafe {
            let mapping = &*self.mapping;
            [
                slice::from_raw_parts_mut(mapping.tab_registers, mapping.nb_registers as usize),
                slice::from_raw_parts_mut(mapping.tab_input_registers, mapping.nb_input_registers as usize),
            ]
        }
    }
}

/// Eight bytes of one bit each in one.
fn pack(bits: &[u8]) -> u8 {
    bits.iter().take(8).enumerate().fold(0, |byte, (index, bit)| byte | (bit & 1) << index)
}

/// All that can be read without waiting.
fn drain(socket: &mut UnixStream) -> io::Result<Vec<u8>> {
    let (mut all, mut piece) = (Vec::new(), [0; 1024]);
    loop {
        match socket.read(&mut piece) {
            Ok(0) => return Ok(all),
            Ok(length) => all.extend_from_slice(&piece[..length]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(all),
            Err(error) => return Err(error),
        }
    }
}
