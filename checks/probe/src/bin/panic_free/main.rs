//! Calls every public function of `jointbus-protocol` with values that the compiler cannot know, and does not link if
//! one of them can panic: the panic handler calls a function that nobody has.
//!
//! `Debug` and `defmt::Format` are left out: what they print is for a developer's eyes.
#![no_std]
#![no_main]

mod can;
mod common;
mod decode;
mod errors;
mod modbus;
mod ndam;
mod nst;
mod nxi;
mod opaque;

use core::panic::PanicInfo;

/// The entry point: it is never run, only linked.
#[unsafe(no_mangle)]
pub extern "C" fn _start() -> ! {
    loop {
        common::all();
        can::all();
        decode::all();
        errors::all();
        modbus::all();
        nst::all();
        nxi::all();
        ndam::all();
        #[cfg(feature = "sabotage")]
        opaque::sink(opaque::bytes()[opaque::size()]);
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    unsafe extern "C" {
        /// Does not exist. The linker names it when a panic survives.
        fn jointbus_a_panic_survives() -> !;
    }
    // SAFETY: an image with this call does not link, so nobody ever makes it.
    unsafe { jointbus_a_panic_survives() }
}
