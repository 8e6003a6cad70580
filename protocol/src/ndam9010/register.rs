//! The register map of a module (manual, tables 3.4 and 3.5; 3.6.2).
//!
//! The manual's sections use 04 and 02 for DI, 10 01 05 0F for DO, 04 for AI and 03 06 10 for AO, its table 3.4 lists
//! 03 04 06 16 for all: both reads are accepted on every area and both writes on DO and AO.

/// A kind of channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Area {
    /// Digital inputs: registers `0x0000`, length 32, 16 inputs each; bits `0x0000`, length 512.
    DigitalInput,
    /// Digital outputs: registers `0x0020`, length 32, 16 outputs each; bits `0x0200`, length 512.
    DigitalOutput,
    /// Analog inputs: registers `0x0040`, length 32, one each.
    AnalogInput,
    /// Analog outputs: registers `0x0060`, length 32, one each.
    AnalogOutput,
}

/// Registers of an area, 32, and most registers of one request.
pub const AREA_REGISTERS: u16 = 0x20;

/// Bits of a digital area, 512, and most bits of one request.
pub const AREA_BITS: u16 = 0x200;

impl Area {
    /// The area of a register.
    #[must_use]
    pub const fn of_register(address: u16) -> Option<Self> {
        match address / AREA_REGISTERS {
            0 => Some(Self::DigitalInput),
            1 => Some(Self::DigitalOutput),
            2 => Some(Self::AnalogInput),
            3 => Some(Self::AnalogOutput),
            _ => None,
        }
    }

    /// The area of a bit.
    #[must_use]
    pub const fn of_bit(address: u16) -> Option<Self> {
        match address / AREA_BITS {
            0 => Some(Self::DigitalInput),
            1 => Some(Self::DigitalOutput),
            _ => None,
        }
    }
}
