//! The independent watchdog (RM0090, chapter 21). Knows nothing of time: a write tells after how many nanoseconds it
//! bites unless it is written again.
//!
//! Modelled: start, feeding, prescaler and reload behind their key. Not modelled: the time until a new prescaler or
//! reload value is in force, the stop in debug mode, the option byte that starts it in hardware.

/// Size of the registers.
pub const SIZE: u32 = 0x400;

/// Nominal frequency of the oscillator that drives it.
const LSI_HZ: u64 = 32_000;

const FEED: u32 = 0xAAAA;
const UNLOCK: u32 = 0x5555;
const START: u32 = 0xCCCC;

/// The watchdog.
#[derive(Debug, Clone)]
pub struct Watchdog {
    running: bool,
    unlocked: bool,
    prescaler: u32,
    reload: u32,
}

impl Default for Watchdog {
    fn default() -> Self {
        Self { running: false, unlocked: false, prescaler: 0, reload: 0xFFF }
    }
}

impl Watchdog {
    /// A watchdog that has not been started.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Reads a register.
    #[must_use]
    pub const fn read(&self, offset: u32) -> u32 {
        match offset {
            0x04 => self.prescaler,
            0x08 => self.reload,
            _ => 0,
        }
    }

    /// Writes a register. Where that starts or feeds it: the nanoseconds after which it bites.
    pub fn write(&mut self, offset: u32, value: u32) -> Option<u64> {
        match (offset, value & 0xFFFF) {
            (0x00, UNLOCK) => self.unlocked = true,
            (0x00, key) => {
                self.unlocked = false;
                self.running |= key == START;
                return (self.running && matches!(key, START | FEED)).then(|| self.period_ns());
            }
            (0x04, value) if self.unlocked => self.prescaler = value & 0b111,
            (0x08, value) if self.unlocked => self.reload = value & 0xFFF,
            _ => {}
        }
        None
    }

    fn period_ns(&self) -> u64 {
        let divider = 4 << self.prescaler.min(6);
        u64::from(self.reload + 1) * divider * 1_000_000_000 / LSI_HZ
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_bites_after_its_period_unless_it_is_fed() {
        let mut watchdog = Watchdog::new();
        assert_eq!(watchdog.write(0x00, FEED), None, "not started");
        assert_eq!(
            watchdog.write(0x00, START),
            Some(512_000_000),
            "4096 steps of an eighth of a millisecond"
        );
        watchdog.write(0x04, 2);
        assert_eq!(watchdog.read(0x04), 0, "locked");
        watchdog.write(0x00, UNLOCK);
        watchdog.write(0x04, 2);
        watchdog.write(0x08, 999);
        assert_eq!((watchdog.read(0x04), watchdog.read(0x08)), (2, 999));
        assert_eq!(watchdog.write(0x00, FEED), Some(500_000_000));
        watchdog.write(0x08, 1);
        assert_eq!(watchdog.read(0x08), 999, "locked again");
    }
}
