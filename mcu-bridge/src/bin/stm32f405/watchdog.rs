//! The independent watchdog: half a second in which a part of the firmware stands still resets the chip.

use crate::constants::{HARDWARE_TRIES, WATCHDOG_STEPS, WATCHDOG_STRETCHED_STEPS};
use stm32f4xx_hal::pac;

const START: u16 = 0xCCCC;
const UNLOCK: u16 = 0x5555;
const FEED: u16 = 0xAAAA;

/// Prescaler 16.
const DIVIDE_BY_16: u8 = 2;

/// Prescaler 64.
const DIVIDE_BY_64: u8 = 4;

/// A running watchdog.
pub struct Watchdog(pac::IWDG);

impl Watchdog {
    /// Starts it; nothing but a reset stops it.
    pub fn start(iwdg: pac::IWDG) -> Self {
        // SAFETY: the key of RM0090, 21.4.1
        iwdg.kr().write(|w| unsafe { w.key().bits(START) });
        let mut watchdog = Self(iwdg);
        watchdog.set(DIVIDE_BY_16, WATCHDOG_STEPS);
        watchdog
    }

    /// Gives the flash the time that it needs to erase a sector; see [`Watchdog::relax`].
    pub fn stretch(&mut self) {
        self.set(DIVIDE_BY_64, WATCHDOG_STRETCHED_STEPS);
    }

    /// Returns to the period of every day.
    pub fn relax(&mut self) {
        self.set(DIVIDE_BY_16, WATCHDOG_STEPS);
    }

    fn set(&mut self, prescaler: u8, steps: u32) {
        // a former change takes a few cycles of the slow oscillator
        let _ = (0..HARDWARE_TRIES).any(|_| self.0.sr().read().bits() == 0);
        // SAFETY: keys and values of RM0090, 21.4
        unsafe {
            self.0.kr().write(|w| w.key().bits(UNLOCK));
            self.0.pr().write(|w| w.pr().bits(prescaler));
            self.0.rlr().write(|w| w.rl().bits(steps as u16));
        }
        let _ = (0..HARDWARE_TRIES).any(|_| self.0.sr().read().bits() == 0);
        self.feed();
    }

    /// Everything has advanced.
    pub fn feed(&mut self) {
        // SAFETY: the key of RM0090, 21.4.1
        self.0.kr().write(|w| unsafe { w.key().bits(FEED) });
    }
}
