//! Ports: their numbers, what they are, and their settings.

use jointbus_protocol::time::Duration;

/// Most ports of a board: the host's and five buses.
pub const PORTS_MAX: usize = 6;

/// A port by its number in the register map: 0 is the host's, then come the serial buses, then the CAN buses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Port(u8);

impl Port {
    /// The host's port, full duplex.
    pub const HOST: Self = Self(0);

    /// The port with this number, which a board need not have.
    #[must_use]
    pub const fn new(number: u8) -> Self {
        Self(number)
    }

    /// Its number in the register map.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize
    }

    /// Its number in the register map, as an octet.
    #[must_use]
    pub const fn number(self) -> u8 {
        self.0
    }
}

/// What a port is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PortKind {
    /// A UART; a bus on it is half duplex.
    Serial {
        /// What its baud rates are made of.
        clock: UartClock,
    },
    /// A CAN controller.
    Can,
}

/// The clock of a UART: which baud rates it makes within 1 %.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UartClock {
    /// Frequency in Hz that is divided; 0 stands for a UART that makes every rate.
    pub hz: u32,
    /// Smallest divisor.
    pub divisor_min: u32,
    /// Largest divisor.
    pub divisor_max: u32,
}

impl UartClock {
    /// A UART that makes every rate, as a simulated one does.
    pub const ANY: Self = Self { hz: 0, divisor_min: 1, divisor_max: u32::MAX };

    /// The divisor that comes nearest to a baud rate.
    #[must_use]
    pub const fn divisor(self, baud: u32) -> u32 {
        let half = baud / 2;
        match self.hz.saturating_add(half).checked_div(baud) {
            None => self.divisor_max,
            Some(nearest) if nearest < self.divisor_min => self.divisor_min,
            Some(nearest) if nearest > self.divisor_max => self.divisor_max,
            Some(nearest) => nearest,
        }
    }

    /// Whether it makes a baud rate within 1 %.
    #[must_use]
    pub const fn makes(self, baud: u32) -> bool {
        if self.hz == 0 {
            return true;
        }
        // baud times divisor differs from the clock by at most 1 % of itself
        let wanted = (baud as u64).saturating_mul(self.divisor(baud) as u64);
        wanted.abs_diff(self.hz as u64).saturating_mul(100) <= wanted
    }
}

/// Parity of a serial port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parity {
    /// No parity bit.
    None,
    /// Even number of ones.
    Even,
    /// Odd number of ones.
    Odd,
}

/// Settings of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PortConfig {
    /// Baud rate in 100 bit/s; on CAN kbit/s.
    pub rate: u16,
    /// Parity; a CAN port ignores it.
    pub parity: Parity,
    /// Stop bits, 1 or 2; a CAN port ignores them.
    pub stop_bits: u8,
    /// Silence before a frame in 100 us; 0 stands for 3.5 characters.
    pub gap_100us: u16,
    /// The bridge's own node; a serial port ignores it.
    pub node: u8,
    /// Whether the port hears what it sends.
    pub echo: bool,
}

impl PortConfig {
    /// A serial port without parity and with one stop bit; a gap of 0 stands for 3.5 characters.
    #[must_use]
    pub const fn serial(baud: u32, gap_100us: u16) -> Self {
        let rate = (baud / 100) as u16;
        Self { rate, parity: Parity::None, stop_bits: 1, gap_100us, node: 0, echo: false }
    }

    /// A CAN port with a rate in kbit/s and the bridge's own node, 1 to 127.
    #[must_use]
    pub const fn can(rate: u16, node: u8) -> Self {
        Self { rate, node, ..Self::serial(0, 0) }
    }

    /// Baud rate in bit/s.
    #[must_use]
    pub const fn baud(&self) -> u32 {
        (self.rate as u32).wrapping_mul(100)
    }

    /// Time that so many characters take on a serial port.
    #[must_use]
    pub fn characters(&self, count: usize) -> Duration {
        Duration::from_micros(self.character_micros(count).into())
    }

    /// In 32 bits, which the processor divides by itself: a frame has at most 513 characters of 12 bits.
    fn character_micros(&self, count: usize) -> u32 {
        let bits =
            9u32.wrapping_add(self.stop_bits.into()).wrapping_add(u32::from(self.parity != Parity::None));
        let bits = bits.saturating_mul(u32::try_from(count).unwrap_or(u32::MAX));
        bits.saturating_mul(10_000).div_ceil(u32::from(self.rate.max(1)))
    }

    /// Three and a half characters: the silence between two frames.
    #[must_use]
    pub fn pause(&self) -> Duration {
        Duration::from_micros(self.character_micros(7).div_ceil(2).into())
    }

    /// Silence that the port keeps before a frame.
    #[must_use]
    pub fn gap(&self) -> Duration {
        match self.gap_100us {
            0 => self.pause(),
            steps => Duration::from_micros(u64::from(steps).wrapping_mul(100)),
        }
    }

    /// Longest time that so many frames of eight bytes take on CAN: 29-bit identifiers, all stuff bits.
    #[must_use]
    pub fn can_frames(&self, count: usize) -> Duration {
        const BITS: u32 = 160;
        let bits = BITS.saturating_mul(u32::try_from(count).unwrap_or(u32::MAX));
        Duration::from_micros(bits.saturating_mul(1000).div_ceil(u32::from(self.rate.max(1))).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uart_makes_what_its_divisors_reach_within_one_percent() {
        let clock = UartClock { hz: 42_000_000, divisor_min: 16, divisor_max: 0xFFFF };
        assert!([1200, 9600, 19_200, 115_200, 921_600, 2_000_000].into_iter().all(|baud| clock.makes(baud)));
        assert!(!clock.makes(600), "the divisor is too large");
        assert!(!clock.makes(1_950_000), "between two divisors");
        assert!(!clock.makes(3_000_000), "the divisor is too small");
        assert!(!clock.makes(0));
        assert!(UartClock::ANY.makes(1_950_000));
    }
}
