//! The independent watchdog: half a second without a turn of the main loop resets the chip.

use crate::constants::WATCHDOG_STEPS;
use stm32f4xx_hal::pac;

const START: u16 = 0xCCCC;
const UNLOCK: u16 = 0x5555;
const FEED: u16 = 0xAAAA;

/// Prescaler 16.
const DIVIDE_BY_16: u8 = 2;

/// A running watchdog.
pub struct Watchdog(pac::IWDG);

impl Watchdog {
    /// Starts it; nothing but a reset stops it.
    pub fn start(iwdg: pac::IWDG) -> Self {
        // SAFETY: keys and values of RM0090, 21.4; the registers are idle after a reset, so there is nothing to wait for
        unsafe {
            iwdg.kr().write(|w| w.key().bits(START));
            iwdg.kr().write(|w| w.key().bits(UNLOCK));
            iwdg.pr().write(|w| w.pr().bits(DIVIDE_BY_16));
            iwdg.rlr().write(|w| w.rl().bits(WATCHDOG_STEPS as u16));
            iwdg.kr().write(|w| w.key().bits(FEED));
        }
        Self(iwdg)
    }

    /// The main loop has turned.
    pub fn feed(&mut self) {
        // SAFETY: the key of RM0090, 21.4.1
        self.0.kr().write(|w| unsafe { w.key().bits(FEED) });
    }
}
