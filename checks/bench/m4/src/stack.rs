//! What a function uses of the stack.

use core::arch::asm;
use core::hint::black_box;
use core::ptr;

/// What an untouched word holds.
const PAINT: u32 = 0xA5A5_5A5A;

/// Bytes under the stack pointer that are left unpainted: the frame of the function that paints. What needs no more is
/// reported to need these.
const MARGIN: usize = 64;

unsafe extern "C" {
    /// The end of the static variables, from cortex-m-rt's linker script.
    static mut _stack_end: u32;
}

/// Runs a function; the bytes of stack that it touched.
#[inline(always)]
pub fn used<T>(run: impl FnOnce() -> T) -> usize {
    let top = pointer();
    paint(top - MARGIN);
    black_box(run());
    top - lowest_touched(top - MARGIN)
}

#[inline(always)]
fn pointer() -> usize {
    let pointer: usize;
    // SAFETY: it reads a register.
    unsafe { asm!("mov {}, sp", out(reg) pointer, options(nomem, nostack)) };
    pointer
}

#[inline(never)]
fn paint(end: usize) {
    let mut word = &raw mut _stack_end;
    while (word as usize) < end {
        // SAFETY: between the static variables and the frame of this function nobody keeps anything.
        unsafe { ptr::write_volatile(word, PAINT) };
        word = word.wrapping_add(1);
    }
}

#[inline(never)]
fn lowest_touched(end: usize) -> usize {
    let mut word = &raw mut _stack_end;
    // SAFETY: as in `paint`; it only reads.
    while (word as usize) < end && unsafe { ptr::read_volatile(word) } == PAINT {
        word = word.wrapping_add(1);
    }
    word as usize
}
