//! The servers of others, with the same tables and function codes.
//!
//! Each is used as its documentation shows it, with what it leaves to its user written as short as it goes.

pub mod mbus;
pub mod modbus_core;
pub mod rmodbus;

/// Coils, and as many discrete inputs.
const BITS: usize = 512;
/// Holding registers, and as many input registers.
const REGISTERS: usize = 128;

/// So many from `first` on, where the table has them.
fn range(first: u16, count: usize) -> core::ops::Range<usize> {
    let first = usize::from(first);
    first..first.saturating_add(count)
}
