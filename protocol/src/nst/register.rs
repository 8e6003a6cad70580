//! The register map (manual table 4). A register is a byte; addresses and lengths count bytes.
//! Settings are little-endian, data is big-endian: the printed frames show both (4.3.1.2, 4.3.2.10).

/// Who may do what with a register.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Access {
    /// Read only.
    Read,
    /// Read and written.
    ReadWrite,
}

/// How the bytes of a register are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Encoding {
    /// Without a documented layout.
    Opaque,
    /// Text.
    Ascii,
    /// One number, or one number a byte.
    U8,
    /// Two bytes, least significant first.
    U16Le,
    /// Four bytes, least significant first.
    U32Le,
    /// Signed numbers of four bytes, least significant first.
    I32Le,
    /// Signed numbers of three bytes, most significant first.
    I24Be,
}

/// Which values a register takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Values {
    /// All of them.
    Any,
    /// From the first to the last, in each byte; anything else is refused.
    Between(u8, u8),
    /// One of these numbers; anything else is refused.
    OneOf(&'static [u32]),
    /// One of these numbers; anything else is stored as [`DEFAULT_BAUD`] and acknowledged.
    OneOfOrDefault(&'static [u32]),
}

/// One row of table 4.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Register {
    /// First byte address.
    pub first: u16,
    /// Length in bytes.
    pub length: u16,
    /// Access.
    pub access: Access,
    /// Encoding.
    pub encoding: Encoding,
    /// Values that it takes.
    pub values: Values,
    /// Value from the factory, where the manual names one.
    pub default: Option<u32>,
}

impl Register {
    /// Last byte address.
    #[must_use]
    pub const fn last(&self) -> u16 {
        self.first.saturating_add(self.length).saturating_sub(1)
    }

    /// Whether it has a byte in `first..=last`.
    #[must_use]
    pub const fn meets(&self, first: u16, last: u16) -> bool {
        self.first <= last && first <= self.last()
    }
}

impl Register {
    const fn values(self, values: Values) -> Self {
        Self { values, ..self }
    }

    const fn default(self, default: u32) -> Self {
        Self { default: Some(default), ..self }
    }
}

use Values::{Between, OneOf, OneOfOrDefault};

/// Rows of table 4: a constant each, whose page shows what the row says, and all of them in `TABLE`.
macro_rules! table {
    ($($name:ident = $first:literal, $length:literal, $access:ident, $encoding:ident, $text:literal
        $(, $set:ident($value:expr))*;)+) => {
        $(
            #[doc = concat!("`", stringify!($first), "`, length ", $length, ": ", $text)]
            #[doc = ""]
            #[doc = concat!("[`Access::", stringify!($access), "`], [`Encoding::", stringify!($encoding), "`].")]
            pub const $name: Register = Register {
                first: $first,
                length: $length,
                access: Access::$access,
                encoding: Encoding::$encoding,
                values: Values::Any,
                default: None,
            }$(.$set($value))*;
        )+

        /// Table 4, in its order.
        pub const TABLE: [Register; [$($first),+].len()] = [$($name),+];
    };
}

table! {
    SYSTEM_0 = 0x0000, 227, ReadWrite, Opaque, "used by the system.";
    USER_MATRIX = 0x00E3, 144, ReadWrite, Opaque, "user matrix; the manual gives no layout.";
    SERIAL_NUMBER = 0x0173, 16, Read, Ascii, "serial number, 13 characters used (4.1.1).";
    MODEL = 0x0183, 16, Read, Ascii, "model, 10 characters used (4.1.2).";
    ADDRESS = 0x0193, 1, ReadWrite, U8, "address, 0x01 to 0x7F (4.1.3).",
        values(Between(super::ADDRESS_MIN, super::ADDRESS_MAX));
    UART1_BAUD = 0x0194, 4, ReadWrite, U32Le,
        "baud rate of UART1, the RS232/RS485 port, one of [`UART1_BAUDS`] (4.1.4).",
        values(OneOfOrDefault(&UART1_BAUDS)), default(DEFAULT_BAUD);
    CAN_RATE = 0x0198, 4, ReadWrite, U32Le, "bit rate of CAN in kbit/s, one of [`CAN_RATES`] (4.1.5).",
        values(OneOf(&CAN_RATES));
    UART2_BAUD = 0x019C, 4, ReadWrite, U32Le,
        "baud rate of UART2, the USB port, one of [`UART2_BAUDS`] (4.1.6).",
        values(OneOfOrDefault(&UART2_BAUDS)), default(DEFAULT_BAUD);
    SYSTEM_1 = 0x01A0, 1, ReadWrite, Opaque, "used by the system.";
    IP_ADDRESS = 0x01A1, 4, ReadWrite, U8, "IPv4 address in reading order (4.1.7).";
    IP_PORT = 0x01A5, 2, ReadWrite, U16Le, "port (4.1.8).";
    ZERO_POINTS = 0x01A7, 24, ReadWrite, I32Le, "zero points Fx Fy Fz Tx Ty Tz (4.1.9).";
    SYSTEM_2 = 0x01BF, 3, ReadWrite, Opaque, "used by the system.";
    CHANNEL = 0x01C2, 1, ReadWrite, U8, "0 = CAN, 1 = RS485 on the shared pins of an NST2000 (4.1.10).",
        values(Between(0, 1));
    SYSTEM_3 = 0x01C3, 4, ReadWrite, Opaque, "used by the system.";
    ETHERNET_MODE = 0x01C7, 1, ReadWrite, U8, "Ethernet mode: 0 = UDP, 1 = TCP server (4.1.11).",
        values(Between(0, 1));
    SYSTEM_4 = 0x01C8, 56, ReadWrite, Opaque, "used by the system.";
    DATA = 0x0200, 256, Read, I24Be, "data Fx Fy Fz Tx Ty Tz in 18 bytes, the rest 0 (4.1.12).";
}

/// Bytes below the data registers: all that a device keeps over power-off.
pub const SETTINGS_LENGTH: usize = DATA.first as usize;

/// Baud rates of UART1 (table 5); anything else is stored as [`DEFAULT_BAUD`].
pub const UART1_BAUDS: [u32; 4] = [4800, 9600, 19200, 115_200];

/// Bit rates of CAN in kbit/s (table 6); anything else is refused.
pub const CAN_RATES: [u32; 8] = [1000, 500, 250, 125, 100, 50, 20, 10];

/// Baud rates of UART2 (table 7); anything else is stored as [`DEFAULT_BAUD`].
pub const UART2_BAUDS: [u32; 7] = [4800, 9600, 19200, 115_200, 230_400, 345_600, 460_800];

/// Baud rate that an unknown one is replaced by (4.1.4, 4.1.6).
pub const DEFAULT_BAUD: u32 = 115_200;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_covers_every_address_once() {
        let mut next = 0;
        for register in TABLE {
            assert_eq!(register.first, next);
            next = register.last() + 1;
        }
        assert_eq!(next, 0x0300);
        assert_eq!(SETTINGS_LENGTH, 0x0200);
    }
}
