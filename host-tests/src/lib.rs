//! What tests of host software, and of the bridge itself, need beside hardware.
//!
//! - [`devices`]: simulated sensors and stations, deaf and clockless, and their way onto a TCP port.
//! - [`client`]: a small Modbus and NST master.
//! - [`share`]: lets several hosts take turns at the one host port of a bridge.
#![cfg_attr(unix, doc = "- [`emulator`]: the firmware's image in QEMU.")]
//! - [`bridge`]: the own unit of the bridge, as a host sees it.
//! - [`in_process`]: the bridge's engine in this process, without an image.
//! - [`bench`](mod@bench): a bridge with all its devices, ready to be asked.
//!
//! The programs `demo` and `emulate` are made of these parts.

#[cfg(unix)]
pub mod emulator;

pub mod bench;
pub mod bridge;
pub mod client;
pub mod clock;
pub mod devices;
pub mod in_process;
pub mod share;
pub mod sim;

/// Version of this package, which is that of the whole workspace: major, minor, patch.
#[must_use]
pub fn version() -> [u16; 3] {
    let parts =
        [env!("CARGO_PKG_VERSION_MAJOR"), env!("CARGO_PKG_VERSION_MINOR"), env!("CARGO_PKG_VERSION_PATCH")];
    parts.map(|part| part.parse().unwrap_or(0))
}
