//! Why the chip started, kept across the reset that a panic or a fault leads to.

use core::sync::atomic::{AtomicU32, Ordering};
use cortex_m::peripheral::SCB;
use jointbus_mcu_bridge::engine::ResetCause;
use stm32f4xx_hal::pac;

/// Left for the next start: a mark, and its complement, so that memory after power-on says nothing.
// SAFETY: the section is memory that nothing else uses, and any content is a valid value
#[unsafe(link_section = ".kept")]
static MARK: [AtomicU32; 2] = [AtomicU32::new(0), AtomicU32::new(0)];

const PANIC: u32 = 0x5041_4E49;

/// Resets the chip after a panic or a fault.
pub extern "C" fn after_panic() -> ! {
    let [mark, complement] = &MARK;
    mark.store(PANIC, Ordering::SeqCst);
    complement.store(!PANIC, Ordering::SeqCst);
    SCB::sys_reset()
}

/// Resets the chip because the host asked for it.
pub fn by_command() -> ! {
    SCB::sys_reset()
}

/// Why the chip started; asked once, because it clears what it reads.
pub fn cause(rcc: &pac::RCC) -> ResetCause {
    let [mark, complement] = &MARK;
    let panicked = mark.swap(0, Ordering::SeqCst) == PANIC && complement.swap(0, Ordering::SeqCst) == !PANIC;
    let flags = rcc.csr().read();
    let (power, watchdog, software) =
        (flags.porrstf().bit_is_set(), flags.wdgrstf().bit_is_set(), flags.sftrstf().bit_is_set());
    rcc.csr().modify(|_, w| w.rmvf().set_bit());
    // every reset pulls the pin as well, and power-on leaves anything in memory
    match (power, watchdog, software) {
        (true, _, _) => ResetCause::PowerOn,
        (_, true, _) => ResetCause::Watchdog,
        (_, _, true) if panicked => ResetCause::Panic,
        (_, _, true) => ResetCause::Software,
        _ => ResetCause::Pin,
    }
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    after_panic()
}

/// Every fault ends here. The stack may be what has failed, and then nothing can be pushed: it starts anew first.
#[unsafe(naked)]
// SAFETY: the name is that of the vector table's entry (cortex-m-rt), and nothing else has it
#[unsafe(no_mangle)]
extern "C" fn HardFault() -> ! {
    core::arch::naked_asm!(
        "movw r0, :lower16:_stack_start",
        "movt r0, :upper16:_stack_start",
        "mov sp, r0",
        "b {after_panic}",
        after_panic = sym after_panic,
    )
}
