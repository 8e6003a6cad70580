//! Microseconds since boot, from timer 5, whose counter one load reads; and the tick that wakes the main loop.

use crate::clocks::Clocks;
use crate::constants::TICK_US;
use core::sync::atomic::{AtomicU32, Ordering};
use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use jointbus_protocol::time::Instant;
use stm32f4xx_hal::pac::{RCC, TIM5};
use stm32f4xx_hal::rcc::{Enable, Reset};

/// What the last tick saw.
static LAST: AtomicU32 = AtomicU32::new(0);

/// Starts the counter and the tick.
pub fn start(timer: &TIM5, syst: &mut SYST, rcc: &mut RCC, clocks: &Clocks) {
    TIM5::enable(rcc);
    TIM5::reset(rcc);
    let divider = (clocks.timclk1_hz / 1_000_000).max(1);
    // SAFETY: any value is a prescaler, and all of the 32 bits a period
    unsafe {
        timer.psc().write(|w| w.psc().bits((divider - 1) as u16));
        timer.arr().write(|w| w.bits(u32::MAX));
    }
    // the prescaler is in force from the next update on
    timer.egr().write(|w| w.ug().set_bit());
    timer.cr1().write(|w| w.cen().set_bit());

    let cycles = (clocks.core_hz / 1_000_000).max(1);
    syst.set_clock_source(SystClkSource::Core);
    syst.set_reload(cycles * TICK_US - 1);
    syst.clear_current();
    syst.enable_interrupt();
    syst.enable_counter();
}

/// The tick's interrupt; tells whether time has passed.
pub fn tick() -> bool {
    let now = micros();
    LAST.swap(now, Ordering::Relaxed) != now
}

/// Low half of the microseconds since boot, from anywhere.
#[inline(always)]
pub fn micros() -> u32 {
    // SAFETY: a register that reading leaves as it is
    unsafe { (*TIM5::ptr()).cnt().read().bits() }
}

/// Microseconds since boot in full; its owner asks more often than every 71 minutes.
#[derive(Default)]
pub struct Clock(u64);

impl Clock {
    /// Now; never before what it said last.
    pub fn now(&mut self) -> Instant {
        self.0 += u64::from(micros().wrapping_sub(self.0 as u32));
        Instant::from_micros(self.0)
    }
}
