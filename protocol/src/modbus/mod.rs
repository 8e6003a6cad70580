//! Modbus: requests and responses as values ("Modbus Application Protocol Specification V1.1b3"), their framing on a
//! serial line, [`rtu`] and [`ascii`] ("Modbus over Serial Line V1.02"), and on [`tcp`] ("Messaging on TCP/IP
//! Implementation Guide V1.0b"), and the [`server`] that answers them.

pub mod ascii;
mod expected;
mod function;
pub mod identification;
pub mod line;
mod request;
mod response;
pub mod rtu;
pub mod server;
pub mod tcp;

pub use expected::ExpectedResponse;
pub use function::{DiagnosticSubfunction, ExceptionCode, FunctionCode};
pub use request::{Request, RequestError};
pub use response::{Response, ResponseError};

/// Unit address of a broadcast on a serial line: writes only, never answered.
pub const BROADCAST: u8 = 0;

/// Longest protocol data unit: function code and data.
pub const PDU_MAX: usize = 253;

/// Most coils or discrete inputs in one read (6.1, 6.2).
pub const READ_BITS_MAX: u16 = 2000;

/// Most registers in one read (6.3, 6.4).
pub const READ_REGISTERS_MAX: u16 = 125;

/// Most coils in one write (6.11).
pub const WRITE_BITS_MAX: u16 = 1968;

/// Most registers in one write (6.12).
pub const WRITE_REGISTERS_MAX: u16 = 123;

/// Most registers written by function code 17 (6.17), which reads up to [`READ_REGISTERS_MAX`].
pub const READ_WRITE_REGISTERS_MAX: u16 = 121;

/// Value of function code 05 that switches a coil on.
pub const COIL_ON: u16 = 0xFF00;

/// Value of function code 05 that switches a coil off.
pub const COIL_OFF: u16 = 0x0000;

/// A run of coils, inputs or registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct AddressRange {
    /// Address of the first, as on the wire (counted from 0).
    pub start: u16,
    /// How many.
    pub quantity: u16,
}

impl AddressRange {
    /// A run of `quantity` from `start`.
    #[must_use]
    pub const fn new(start: u16, quantity: u16) -> Self {
        Self { start, quantity }
    }

    /// Address of the last one; `None` for an empty run and for one that passes 0xFFFF.
    #[must_use]
    pub const fn last(self) -> Option<u16> {
        match self.quantity.checked_sub(1) {
            Some(steps) => self.start.checked_add(steps),
            None => None,
        }
    }

    /// Whether the run is not empty and lies in `first..=last`.
    #[must_use]
    pub fn within(self, first: u16, last: u16) -> bool {
        self.start >= first && self.last().is_some_and(|end| end <= last)
    }

    /// The addresses, in order; none for a run that passes 0xFFFF.
    pub fn addresses(self) -> impl Iterator<Item = u16> {
        let quantity = if self.last().is_some() { self.quantity } else { 0 };
        (0..quantity).map(move |offset| self.start.wrapping_add(offset))
    }
}

/// The registers in the data of a write or a read, in order, each most significant byte first.
pub fn registers(data: &[u8]) -> impl Iterator<Item = u16> {
    data.as_chunks::<2>().0.iter().map(|pair| u16::from_be_bytes(*pair))
}

/// Bit `index` of packed coils or inputs: the first is the least significant bit of the first byte.
#[must_use]
pub fn bit(data: &[u8], index: u16) -> bool {
    data.get(usize::from(index >> 3)).is_some_and(|byte| byte >> (index & 7) & 1 == 1)
}

/// Bytes that so many packed bits take.
#[must_use]
pub const fn packed_len(quantity: u16) -> usize {
    quantity.div_ceil(8) as usize
}

/// What function code 16 makes of a register (6.16).
#[must_use]
pub const fn apply_mask(value: u16, and: u16, or: u16) -> u16 {
    value & and | or & !and
}
