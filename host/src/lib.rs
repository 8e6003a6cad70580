//! What host software needs to talk to Jointbus devices and bridges, and to be tested beside hardware.
//!
//! - [`client`]: a small Modbus and NST master.
//! - [`bridge`]: the own unit of the bridge, as a host sees it.
//! - [`share`]: lets several hosts take turns at the one host port of a bridge.
//! - [`devices`]: simulated sensors and stations, deaf and clockless, and their way onto a TCP port.
//! - [`in_process`]: the bridge's engine in this process, without an image.
#![cfg_attr(unix, doc = "- [`emulator`]: the firmware's image in QEMU.")]
//! - [`bench`](mod@bench): a bridge with all its devices, ready to be asked.
//!
//! A bridge in this process, with its devices, answers like one on a wire:
//!
//! ```
//! use jointbus::bench::{Bench, RS485_A_UNIT};
//! use jointbus::bridge;
//!
//! # fn main() -> anyhow::Result<()> {
//! let bench = Bench::in_process()?;
//! let mut client = bench.client()?;
//! assert_eq!(bridge::about(&mut client)?.health, 0);
//! let sample = client.nst(RS485_A_UNIT).sample()?; // mN and mN.m
//! assert_eq!(sample.0.len(), 6);
//! # Ok(())
//! # }
//! ```

#[cfg(unix)]
pub mod emulator;

pub mod bench;
pub mod bridge;
pub mod client;
pub mod clock;
pub mod devices;
pub mod in_process;
pub mod share;

/// Version of this package, which is that of the whole workspace: major, minor, patch.
#[must_use]
pub fn version() -> [u16; 3] {
    let parts =
        [env!("CARGO_PKG_VERSION_MAJOR"), env!("CARGO_PKG_VERSION_MINOR"), env!("CARGO_PKG_VERSION_PATCH")];
    parts.map(|part| part.parse().unwrap_or(0))
}
