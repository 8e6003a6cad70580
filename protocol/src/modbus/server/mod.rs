//! The server's side of Modbus.
//!
//! [`Server`] is the trait for an owner of coils, inputs and registers: [`rtu`], [`ascii`] and [`tcp`] turn the frame
//! of a request into the frame of its response, [`respond`] does so for the data unit alone. A request is checked
//! whole before the owner is called, once, and the response is written where it is sent from. [`RamTables`] is an
//! owner with tables in memory.
//!
//! [`serve_rtu`] and [`serve_ascii`] are what the device dispatchers of this crate use, which check requests by their
//! own manuals.

mod basic;
mod common;
mod extended;
mod framing;
mod ram;
mod serial;
#[cfg(test)]
mod tests;
mod view;

pub use common::{Destination, Failure, NoResponse};
pub(crate) use common::{complete, data_unit, echo, reading, words};
pub use framing::{ascii, respond, rtu, rtu_frame, rtu_with, tcp};
pub use ram::RamTables;
pub use serial::{exception_for, serve_ascii, serve_rtu};
pub use view::{BitWriter, Bits, RegisterWriter, Registers};

use crate::modbus::identification::{ConformityLevel, ObjectId};
use crate::modbus::{AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode};

/// An owner of coils, inputs and registers. What it does not have it leaves out: its function codes are answered with
/// exception 01.
///
/// A request makes one call. Quantity, byte count and coil value have been checked (exception 03), and no range passes
/// 0xFFFF; the owner checks the addresses ([`ExceptionCode::IllegalDataAddress`]), the values
/// ([`ExceptionCode::IllegalDataValue`]) and what it has behind them ([`ExceptionCode::ServerDeviceFailure`] for a
/// fault, [`ExceptionCode::ServerDeviceBusy`] for later), *before* it changes anything: a write is all or nothing.
/// A read that hands over fewer values than were asked for is answered with exception 04: none is made up.
/// An error type of its own becomes an exception by `?` where `ExceptionCode` implements `From` for it.
///
/// # Errors
/// Each method: the exception that refuses the request; by default function code not supported.
#[expect(unused_variables, reason = "the arguments are named for the reader")]
pub trait Server {
    /// Whether a function code is supported: if not, the answer is exception 01 whatever else is wrong. By default the
    /// [basic](FunctionCode::is_basic) ones; who writes a method for another one names its code here, and who leaves one
    /// of the basic ones out says so, lest a malformed request for it is answered with exception 03.
    fn supports(&self, function: FunctionCode) -> bool {
        function.is_basic()
    }

    /// Function code 01: coils (6.1).
    fn read_coils(&mut self, range: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 02: discrete inputs (6.2).
    fn read_discrete_inputs(
        &mut self,
        range: AddressRange,
        bits: &mut BitWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 03: holding registers (6.3).
    fn read_holding_registers(
        &mut self,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 04: input registers (6.4).
    fn read_input_registers(
        &mut self,
        range: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function codes 05 and 0F: coils (6.5, 6.11).
    fn write_coils(&mut self, range: AddressRange, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function codes 06 and 10: holding registers (6.6, 6.12).
    fn write_registers(
        &mut self,
        range: AddressRange,
        registers: Registers<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 16: the register becomes its value and `and`, or `or` without `and` (6.16).
    /// [`apply_mask`](crate::modbus::apply_mask) computes that.
    fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 17: writes registers, then reads registers (6.17). Both ranges are to be checked first.
    fn read_write_registers(
        &mut self,
        write: AddressRange,
        values: Registers<'_>,
        read: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 07: eight status bits (6.7).
    fn exception_status(&mut self) -> Result<u8, ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 08 (6.8): `data` is the request's, one register but for [`DiagnosticSubfunction::ReturnQueryData`], and is
    /// sent back, with a counter or register in place of its first one if there is `Some`.
    /// [`DiagnosticSubfunction::ForceListenOnly`] never comes here, since it is never answered: exception 01.
    fn diagnostics(
        &mut self,
        subfunction: DiagnosticSubfunction,
        data: Registers<'_>,
    ) -> Result<Option<u16>, ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 0B: status, 0xFFFF while a program command is under way, else 0; number of requests carried out
    /// (6.9).
    fn comm_event_counter(&mut self) -> Result<(u16, u16), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 11: the server's ID, a run indicator (0x00 or 0xFF) and more, in a layout of its own, at most
    /// 251 bytes (6.13). What is longer is exception 04.
    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 2B with MEI type 0E (6.21): which objects there are.
    fn conformity(&self) -> ConformityLevel {
        ConformityLevel::BasicIndividual
    }

    /// An object of the device identification, at most [`OBJECT_MAX`](crate::modbus::identification::OBJECT_MAX) bytes; a longer one is cut. 00 to 02 are
    /// mandatory.
    fn identification(&self, object: ObjectId) -> Option<&[u8]> {
        None
    }
}
