//! The floating-point unit is for the main loop alone.

use cortex_m::peripheral::FPU;
use cortex_m::register::control::{self, Fpca};

/// Has interrupts no longer keep floating-point registers: none of them uses any, which the analysis of the worst-case
/// stack proves, and room for them would be 72 bytes a priority.
pub fn keep_no_registers(fpu: &mut FPU) {
    /// FPCCR: automatic and lazy keeping (ARMv7-M reference manual, B3.2.21).
    const ASPEN: u32 = 1 << 31;
    const LSPEN: u32 = 1 << 30;
    // SAFETY: handlers leave these registers as they are
    unsafe { fpu.fpccr.modify(|bits| bits & !(ASPEN | LSPEN)) };
    // what has been calculated so far has set this, and it would stay
    let mut control = control::read();
    control.set_fpca(Fpca::NotActive);
    // SAFETY: as above; stack and privilege stay as they are
    unsafe { control::write(control) };
}
