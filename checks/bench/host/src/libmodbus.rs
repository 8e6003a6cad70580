//! libmodbus as an RTU server on one end of a pair of sockets, which are memory of the operating system: what the
//! library does in its own code is counted, the kernel's part is not.

use std::ffi::{c_char, c_int};
use std::io::{ErrorKind, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;

use jointbus_bench_subjects::{FRAME_MAX, Kind, REQUESTS, Requests};

use crate::count_once;

#[repr(C)]
struct Context {
    _private: [u8; 0],
}

#[repr(C)]
struct Mapping {
    _private: [u8; 0],
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
pub(crate) struct Libmodbus {
    context: *mut Context,
    mapping: *mut Mapping,
    /// Our end of the line.
    line: UnixStream,
    /// Its end, to be emptied of what it left unread.
    end: UnixStream,
}

impl Libmodbus {
    fn new() -> Self {
        let (line, end) = UnixStream::pair().expect("no pair of sockets");
        for socket in [&line, &end] {
            socket.set_nonblocking(true).expect("sockets can be nonblocking");
        }
        // SAFETY: the device is never opened; the results are checked before they are used.
        let (context, mapping) = unsafe {
            (
                modbus_new_rtu(c"/dev/null".as_ptr(), 19200, b'N' as c_char, 8, 1),
                modbus_mapping_new(512, 512, 128, 128),
            )
        };
        assert!(!context.is_null() && !mapping.is_null(), "libmodbus has no memory");
        // SAFETY: the context is valid and not shared. A microsecond: everything that will come has come.
        unsafe {
            assert_eq!(modbus_set_slave(context, 1), 0);
            assert_eq!(modbus_set_socket(context, end.as_raw_fd()), 0);
            assert_eq!(modbus_set_response_timeout(context, 0, 1), 0);
            assert_eq!(modbus_set_byte_timeout(context, 0, 1), 0);
        }
        Self { context, mapping, line, end }
    }

    /// What it does with the frame in its end of the line.
    fn serve(&self) {
        let mut request = [0; REQUEST_ROOM];
        // SAFETY: the context and the mapping are valid, and the buffer is longer than any frame it takes.
        unsafe {
            let length = modbus_receive(self.context, request.as_mut_ptr());
            if length > 0 {
                modbus_reply(self.context, request.as_ptr(), length, self.mapping);
            }
        }
    }
}

/// Asks it all requests; whether all answers were right.
pub(crate) fn ask(name: &str) -> bool {
    let mut server = Libmodbus::new();
    let Requests { first, timed, longest } = &REQUESTS[Kind::Server as usize];
    let (mut frame, mut out) = ([0; FRAME_MAX], [0; FRAME_MAX]);
    let mut right = true;
    // the first time around resolves the functions of libraries
    for request in first.iter().chain(timed.iter()).chain(timed.iter()).chain(longest.iter()) {
        let length = request.write(&mut frame);
        server.line.write_all(&frame[..length]).expect("the line takes a frame");
        count_once(name, request.name, || server.serve());
        // what it left unread of a wrong frame
        read(&mut server.end, &mut [0; FRAME_MAX]);
        let answer = read(&mut server.line, &mut out);
        if !request.is_answered_by(answer, &out) {
            eprintln!("{name}: {:02x?} was answered with {:02x?}", &frame[..length], &out[..answer]);
            right = false;
        }
    }
    right
}

/// What can be read without waiting.
fn read(socket: &mut UnixStream, bytes: &mut [u8; FRAME_MAX]) -> usize {
    match socket.read(bytes) {
        Ok(length) => length,
        Err(error) if error.kind() == ErrorKind::WouldBlock => 0,
        Err(error) => panic!("{error}"),
    }
}
