//! Microseconds since boot, from SysTick: the one timer that counts alike on the chip and in the emulator.

use crate::constants::TICK_US;
use core::sync::atomic::{AtomicU32, Ordering};
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::{SCB, SYST};
use jointbus_protocol::time::Instant;

/// Ticks since boot.
static TICKS: AtomicU32 = AtomicU32::new(0);

/// Core cycles in a microsecond.
static CYCLES: AtomicU32 = AtomicU32::new(1);

/// Starts the tick.
pub fn start(syst: &mut SYST, core_hz: u32) {
    let cycles = (core_hz / 1_000_000).max(1);
    CYCLES.store(cycles, Ordering::Relaxed);
    syst.set_clock_source(SystClkSource::Core);
    syst.set_reload(cycles * TICK_US - 1);
    syst.clear_current();
    syst.enable_interrupt();
    syst.enable_counter();
}

/// The tick's interrupt.
pub fn tick() {
    TICKS.fetch_add(1, Ordering::Relaxed);
}

/// Low half of the microseconds since boot, from anywhere.
pub fn micros() -> u32 {
    let cycles = CYCLES.load(Ordering::Relaxed).max(1);
    let reload = cycles * TICK_US - 1;
    // two tries meet a tick between the reads at most once
    for _ in 0..2 {
        let ticks = TICKS.load(Ordering::Relaxed);
        let left = SYST::get_current();
        let pending = SCB::is_pendst_pending();
        if TICKS.load(Ordering::Relaxed) == ticks {
            // the counter has wrapped, and the tick that tells it could not interrupt yet
            let missed = u32::from(pending && left > reload / 2);
            let whole = ticks.wrapping_add(missed).wrapping_mul(TICK_US);
            return whole.wrapping_add(reload.saturating_sub(left) / cycles);
        }
    }
    TICKS.load(Ordering::Relaxed).wrapping_mul(TICK_US)
}

/// Microseconds since boot in full; its owner asks more often than every 35 minutes.
#[derive(Default)]
pub struct Clock(u64);

impl Clock {
    /// Now; never before what it said last.
    pub fn now(&mut self) -> Instant {
        let passed = micros().wrapping_sub(self.0 as u32);
        // a tick that is told late makes the counter look one tick younger for a moment
        if passed < u32::MAX / 2 {
            self.0 += u64::from(passed);
        }
        Instant::from_micros(self.0)
    }
}
