//! An image with one subject: it counts, under `-icount shift=0`, the instructions that a request takes, and what it
//! leaves of a painted stack; then it ends.
#![no_std]

mod semihosting;
mod stack;

use core::hint::black_box;

use cortex_m::Peripherals;
use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use jointbus_bench_subjects::{Empty, FRAME_MAX, Request, Subject};

/// How often a request is asked: a tick is six instructions, so the count is right to a hundredth of one.
const TIMES: u32 = 1000;

/// An image's `main`, with the subject of this name.
#[macro_export]
macro_rules! image {
    ($subject:ty) => {
        #[cortex_m_rt::entry]
        fn main() -> ! {
            $crate::run::<$subject>()
        }

        #[panic_handler]
        fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
            $crate::fail()
        }
    };
}

/// Measures a subject.
pub fn run<S: Subject>() -> ! {
    let mut subject = black_box(S::new());
    let (mut frame, mut out) = ([0; FRAME_MAX], [0; FRAME_MAX]);
    let (mut worst, mut clock) = (0, Peripherals::take().map(|peripherals| peripherals.SYST));
    for request in S::REQUESTS {
        let length = request.write(&mut frame);
        let (frame, out) = (black_box(&frame[..length]), &mut out);
        worst = worst.max(stack::used(|| call(&mut subject, frame, out)));
        if let Some(clock) = &mut clock {
            let ticks = ticks(clock, || call(&mut subject, frame, out));
            let idle = ticks_of_nothing(clock, frame, out);
            semihosting::print(b"ticks ", ticks.saturating_sub(idle));
        }
        semihosting::print(b"answer ", call(&mut subject, frame, out) as u32);
    }
    semihosting::print(b"stack ", worst as u32);
    semihosting::exit()
}

/// Something went wrong: the output ends too early.
pub fn fail() -> ! {
    semihosting::exit()
}

#[inline(never)]
fn call<S: Subject>(subject: &mut S, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
    subject.serve(frame, out)
}

/// Ticks of the system timer that so many calls take.
#[inline(always)]
fn ticks<T>(clock: &mut SYST, mut run: impl FnMut() -> T) -> u32 {
    const RELOAD: u32 = 0x00FF_FFFF;
    clock.set_clock_source(SystClkSource::Core);
    clock.set_reload(RELOAD);
    clock.clear_current();
    clock.enable_counter();
    let start = SYST::get_current();
    for _ in 0..TIMES {
        black_box(run());
    }
    start.wrapping_sub(SYST::get_current()) & RELOAD
}

#[inline(never)]
fn ticks_of_nothing(clock: &mut SYST, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> u32 {
    let mut nothing = Empty;
    ticks(clock, || call(&mut nothing, frame, out))
}

/// For the reader of the images' words: how often a request was asked.
pub const fn times() -> u32 {
    TIMES
}

const _: fn(&Request, &mut [u8; FRAME_MAX]) -> usize = Request::write;
