//! The server's side of Modbus.
//!
//! [`Server`] is the trait for an owner of coils, inputs and registers: [`rtu`], [`ascii`] and [`tcp`] turn the frame
//! of a request into the frame of its response, [`respond`] does so for the data unit alone. A request is judged
//! whole before the owner is called, once, and the response is written where it is sent from. [`RamTables`] is an
//! owner with tables in memory.
//!
//! [`serve_rtu`] and [`serve_ascii`] are what the device dispatchers of this crate use, which judge requests by their
//! own manuals.

mod basic;
mod extended;
mod framing;
mod owner;
mod ram;
mod serial;
#[cfg(test)]
mod tests;
mod view;

pub use basic::respond;
pub(crate) use basic::{complete, data_unit, reading, written};
pub use framing::{ascii, rtu, rtu_with, tcp};
pub use owner::{Failure, Server};
pub use ram::RamTables;
pub use serial::{Destination, NoResponse, exception_for, serve_ascii, serve_rtu};
pub use view::{BitWriter, Bits, RegisterWriter, Registers};
