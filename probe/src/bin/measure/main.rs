//! One server or dispatcher and what it needs to be asked: its size is that of the image less that of the image
//! without it; its stack is what it leaves of a painted one, in the emulator.
#![no_std]
#![no_main]

mod semihosting;
mod subject;

use core::cell::UnsafeCell;
use core::hint::black_box;
use core::panic::PanicInfo;
use core::ptr;

use cortex_m_rt::entry;

/// Longest frame.
const FRAME_MAX: usize = 256;

/// What an untouched word of the stack holds.
const PAINT: u32 = 0xA5A5_5A5A;

/// Bytes under the stack pointer of `main` that are left unpainted: the frame of the function that paints. A subject
/// that needs no more is reported to need these.
const MARGIN: usize = 64;

/// A variable that only `main` uses.
pub(crate) struct Single<T>(UnsafeCell<T>);

// SAFETY: there is one thread, and no interrupt handler.
unsafe impl<T> Sync for Single<T> {}

impl<T> Single<T> {
    pub(crate) const fn new(value: T) -> Self {
        Self(UnsafeCell::new(value))
    }

    /// To be called once.
    #[expect(clippy::mut_from_ref, reason = "there is one caller")]
    pub(crate) fn take(&self) -> &mut T {
        // SAFETY: `main` takes each of them once.
        unsafe { &mut *self.0.get() }
    }
}

static FRAME: Single<[u8; FRAME_MAX]> = Single::new([0; FRAME_MAX]);
static OUT: Single<[u8; FRAME_MAX]> = Single::new([0; FRAME_MAX]);

#[entry]
fn main() -> ! {
    let (frame, out) = (FRAME.take(), OUT.take());
    let mut subject = subject::new();
    let (mut worst, mut answers) = (0, 0);
    for request in subject::REQUESTS {
        let length = put(request, frame);
        let request = black_box(frame.get(..length).unwrap_or(&[]));
        let top = stack_pointer();
        paint(top - MARGIN);
        let answered = subject::serve(&mut subject, request, out);
        worst = worst.max(top - lowest_touched(top - MARGIN));
        answers += u32::from(answered);
    }
    semihosting::print(b"stack ", worst as u32);
    semihosting::print(b"answers ", answers);
    semihosting::print(b"requests ", subject::REQUESTS.len() as u32);
    semihosting::exit()
}

/// A request to be sent: its first bytes, and how many more follow before the CRC.
pub(crate) type Request = (&'static [u8], usize);

/// Writes the frame of a request; its length.
#[inline(never)]
fn put((head, more): &Request, frame: &mut [u8; FRAME_MAX]) -> usize {
    let length = head.len() + more;
    let mut crc = 0xFFFF_u16;
    let bytes = head.iter().copied().chain(core::iter::repeat_n(0, *more));
    for (place, byte) in frame.iter_mut().zip(bytes) {
        *place = byte;
        crc ^= u16::from(byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 };
        }
    }
    if let Some(place) = frame.get_mut(length..length + 2) {
        place.iter_mut().zip(crc.to_le_bytes()).for_each(|(place, byte)| *place = byte);
    }
    length + 2
}

unsafe extern "C" {
    /// The end of the static variables, from cortex-m-rt's linker script.
    static mut _stack_end: u32;
}

/// Where the stack of the caller ends now.
#[inline(always)]
fn stack_pointer() -> usize {
    let pointer: usize;
    // SAFETY: it reads a register.
    unsafe { core::arch::asm!("mov {}, sp", out(reg) pointer, options(nomem, nostack)) };
    pointer
}

/// Paints what is free of the stack, up to `end`.
#[inline(never)]
fn paint(end: usize) {
    let mut word = &raw mut _stack_end;
    while (word as usize) < end {
        // SAFETY: between the static variables and the frame of this function nobody keeps anything.
        unsafe { ptr::write_volatile(word, PAINT) };
        word = word.wrapping_add(1);
    }
}

/// The lowest address under `end` that was written since it was painted.
#[inline(never)]
fn lowest_touched(end: usize) -> usize {
    let mut word = &raw mut _stack_end;
    // SAFETY: as in `paint`; it only reads.
    while (word as usize) < end && unsafe { ptr::read_volatile(word) } == PAINT {
        word = word.wrapping_add(1);
    }
    word as usize
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    semihosting::exit()
}
