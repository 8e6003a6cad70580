//! The Modbus slave's side of a serial line: any bytes at any pace, then silence, then a request that must be taken.
#![no_main]

use jointbus_fuzz::{Script, sealed, survives};
use jointbus_protocol::decode::STRAY_MAX;
use jointbus_protocol::modbus::rtu::{FRAME_MAX, RequestFraming};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let request = sealed(&[1, 0x10, 0, 0, 0, 1, 2, 0xAB, 0xCD]);
    survives::<{ FRAME_MAX + STRAY_MAX }>(&RequestFraming, Script(data), &request);
});
