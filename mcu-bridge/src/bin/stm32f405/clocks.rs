//! Crystal and PLL, each tried with a bound: the HAL would wait for them forever.

use crate::constants::{CORE_HZ, CRYSTAL_HZ, HARDWARE_TRIES};
use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::{Config, Rcc};

/// PLL settings for the trial, 8 MHz or 16 MHz up to 168 MHz: RM0090, 7.3.2.
fn pll_settings(crystal: bool) -> u32 {
    const N: u32 = 168 << 6;
    const Q: u32 = 7 << 24;
    const SOURCE_CRYSTAL: u32 = 1 << 22;
    if crystal { Q | SOURCE_CRYSTAL | N | 4 } else { Q | N | 8 }
}

/// Starts the clocks; tells whether the crystal is there.
pub fn start(rcc: pac::RCC) -> (Rcc, bool) {
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    let crystal = (0..HARDWARE_TRIES).any(|_| rcc.cr().read().hserdy().bit_is_set());
    if !crystal {
        rcc.cr().modify(|_, w| w.hseon().clear_bit());
    }
    let config = match (crystal, pll_locks(&rcc, crystal)) {
        (true, true) => Config::hse(CRYSTAL_HZ.Hz()).sysclk(CORE_HZ.Hz()),
        (false, true) => Config::hsi().sysclk(CORE_HZ.Hz()),
        // too slow for nothing: 921600 baud still fit into 16 MHz
        (_, false) => Config::hsi(),
    };
    (rcc.freeze(config), crystal)
}

/// Tries the PLL and switches it off again, so that it can be configured.
fn pll_locks(rcc: &pac::RCC, crystal: bool) -> bool {
    // SAFETY: a value that the reference manual allows, written while the PLL is off
    rcc.pllcfgr().write(|w| unsafe { w.bits(pll_settings(crystal)) });
    rcc.cr().modify(|_, w| w.pllon().set_bit());
    let locks = (0..HARDWARE_TRIES).any(|_| rcc.cr().read().pllrdy().bit_is_set());
    rcc.cr().modify(|_, w| w.pllon().clear_bit());
    let stops = (0..HARDWARE_TRIES).any(|_| rcc.cr().read().pllrdy().bit_is_clear());
    locks && stops
}
