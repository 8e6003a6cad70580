//! The peripherals of an STM32F405 that the stock emulator lacks, as its plugin.
//!
//! [`rcc`], [`bxcan`], [`flash`], [`iwdg`], [`gpio`], [`analog`], [`counter`] and [`usart`] model clock control, CAN
//! controller, flash, independent watchdog, pins, converters, timer 5 and serial ports as the reference manual (RM0090) describes them;
//! [`bus`] is the CAN bus, [`adapter`] puts it on a byte stream as SLCAN lines, [`control`] names the faults that
//! tests inject. [`board`] wires them together. None of these knows the emulator, nor time: they are tested on
//! their own. `plugin` hangs the board into QEMU; it finds QEMU's functions when it is loaded, so this crate links
//! anywhere.

pub mod adapter;
pub mod analog;
pub mod board;
pub mod bus;
pub mod bxcan;
pub mod control;
pub mod counter;
pub mod flash;
pub mod gpio;
pub mod iwdg;
#[cfg(unix)]
mod plugin;
pub mod rcc;
pub mod usart;
