//! The NST device's side of a serial line and of a stream: any bytes at any pace, then silence, then a request that
//! must be taken.
#![no_main]

use jointbus_fuzz::{Script, sealed, survives};
use jointbus_protocol::decode::STRAY_MAX;
use jointbus_protocol::nst::{serial, stream};
use libfuzzer_sys::fuzz_target;

const READ: [u8; 5] = [1, 0x03, 2, 0, 0x12];

fuzz_target!(|data: &[u8]| {
    survives::<{ serial::REQUEST_MAX + STRAY_MAX }>(&serial::RequestFraming, Script(data), &sealed(&READ));
    survives::<{ serial::REQUEST_MAX + STRAY_MAX }>(&stream::RequestFraming, Script(data), &READ);
});
