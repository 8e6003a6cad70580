//! The NST slave's side of a serial line: any bytes at any pace, then silence, then a request that must be taken.
#![no_main]

use jointbus_fuzz::{Script, sealed, survives};
use jointbus_protocol::deframe::STRAY_MAX;
use jointbus_protocol::nst::serial::{REQUEST_MAX, Requests};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    survives::<{ REQUEST_MAX + STRAY_MAX }>(&Requests, Script(data), &sealed(&[1, 0x03, 2, 0, 0x12]));
});
