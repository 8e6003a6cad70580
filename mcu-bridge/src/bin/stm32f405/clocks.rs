//! Crystal and PLL (RM0090, 7.2 and 3.5.1), each tried with a bound. Set by their registers because the kept crate would
//! wait for them forever.

use crate::constants::{CORE_HZ, HARDWARE_TRIES, OSCILLATOR_HZ};
use stm32f4xx_hal::pac::{FLASH, RCC};

/// What runs how fast.
pub struct Clocks {
    /// The processor, in Hz.
    pub core_hz: u32,
    /// The first peripheral bus, in Hz: USART2, USART3, CAN.
    pub pclk1_hz: u32,
    /// Its timers, in Hz.
    pub timclk1_hz: u32,
    /// The second peripheral bus, in Hz: USART1.
    pub pclk2_hz: u32,
    /// The crystal is there.
    pub crystal: bool,
}

/// PLL settings for 8 MHz or 16 MHz up to 168 MHz (7.3.2).
fn pll_settings(crystal: bool) -> u32 {
    const N: u32 = 168 << 6;
    const Q: u32 = 7 << 24;
    const SOURCE_CRYSTAL: u32 = 1 << 22;
    if crystal { Q | SOURCE_CRYSTAL | N | 4 } else { Q | N | 8 }
}

/// Starts the clocks.
pub fn start(rcc: &RCC, flash: &FLASH) -> Clocks {
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    let crystal = becomes(|| rcc.cr().read().hserdy().bit_is_set());
    if !crystal {
        rcc.cr().modify(|_, w| w.hseon().clear_bit());
    }
    if start_pll(rcc, flash, crystal) {
        let (pclk1_hz, pclk2_hz) = (CORE_HZ / 4, CORE_HZ / 2);
        Clocks { core_hz: CORE_HZ, pclk1_hz, timclk1_hz: 2 * pclk1_hz, pclk2_hz, crystal }
    } else {
        // too slow for nothing: 921600 baud still fit into 16 MHz
        let hz = OSCILLATOR_HZ;
        Clocks { core_hz: hz, pclk1_hz: hz, timclk1_hz: hz, pclk2_hz: hz, crystal }
    }
}

/// Has the PLL clock the processor, and the buses as fast as they may run (data sheet, 5.3.1); tells whether it does.
fn start_pll(rcc: &RCC, flash: &FLASH, crystal: bool) -> bool {
    const FIVE_WAIT_STATES: u8 = 5;
    const DIVIDE_BY_4: u8 = 0b101;
    const DIVIDE_BY_2: u8 = 0b100;
    const PLL: u8 = 0b10;
    // SAFETY: a value that the reference manual allows, written while the PLL is off
    rcc.pllcfgr().write(|w| unsafe { w.bits(pll_settings(crystal)) });
    rcc.cr().modify(|_, w| w.pllon().set_bit());
    if !becomes(|| rcc.cr().read().pllrdy().bit_is_set()) {
        rcc.cr().modify(|_, w| w.pllon().clear_bit());
        return false;
    }
    // SAFETY: values of the table in 3.5.1 and of 7.3.3; the flash is slowed down before the processor is sped up
    unsafe {
        flash.acr().write(|w| {
            w.latency().bits(FIVE_WAIT_STATES).prften().set_bit().icen().set_bit().dcen().set_bit()
        });
        rcc.cfgr().modify(|_, w| w.ppre1().bits(DIVIDE_BY_4).ppre2().bits(DIVIDE_BY_2));
        rcc.cfgr().modify(|_, w| w.sw().bits(PLL));
    }
    if becomes(|| rcc.cfgr().read().sws().bits() == PLL) {
        return true;
    }
    // SAFETY: the state after a reset
    rcc.cfgr().modify(|_, w| unsafe { w.sw().bits(0).ppre1().bits(0).ppre2().bits(0) });
    false
}

/// Whether something comes true in time.
fn becomes(ready: impl Fn() -> bool) -> bool {
    (0..HARDWARE_TRIES).any(|_| ready())
}
