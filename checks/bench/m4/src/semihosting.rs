//! Two calls to the emulator ("Semihosting for AArch32 and AArch64", 6.16 and 6.8).

use core::arch::asm;

/// Writes a text that ends with 0.
const SYS_WRITE0: usize = 0x04;
/// Ends the emulator.
const SYS_EXIT: usize = 0x18;
/// The program ended by itself.
const APPLICATION_EXIT: usize = 0x2_0026;

fn call(operation: usize, argument: usize) {
    // SAFETY: the emulator reads the text that `print` made, and nothing else of ours.
    unsafe { asm!("bkpt #0xAB", inout("r0") operation => _, in("r1") argument) };
}

/// Prints a name and a number of eight hexadecimal digits on a line.
pub fn print(name: &str, number: u32) {
    let mut line = [0; 48];
    let digits = (0..8).rev().map(|place| match (number >> (4 * place) & 0xF) as u8 {
        digit @ 0..=9 => b'0' + digit,
        digit => b'a' + digit - 10,
    });
    let text = name.bytes().chain([b' ']).chain(digits).chain([b'\n']);
    line.iter_mut().take(47).zip(text).for_each(|(place, character)| *place = character);
    call(SYS_WRITE0, line.as_ptr() as usize);
}

/// Ends the run.
pub fn exit() -> ! {
    loop {
        call(SYS_EXIT, APPLICATION_EXIT);
    }
}
