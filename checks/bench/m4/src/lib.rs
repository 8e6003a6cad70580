//! An image with one subject: it counts, under `-icount shift=0`, the instructions that a request takes, and what it
//! leaves of a painted stack; then it ends.
#![no_std]

mod semihosting;
mod stack;

use core::hint::black_box;

use cortex_m::Peripherals;
use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use jointbus_bench_subjects::{Empty, FRAME_MAX, REQUESTS, Request, Requests, Subject};

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
    let Requests { first, timed, longest } = &black_box(&REQUESTS)[S::KIND as usize];
    let (mut frame, mut out) = ([0; FRAME_MAX], [0; FRAME_MAX]);
    let (mut worst, mut wrong) = (0, 0);
    let mut clock = Peripherals::take().map(|peripherals| peripherals.SYST);
    for (request, is_timed) in first
        .iter()
        .map(untimed)
        .chain(timed.iter().map(|request| (request, true)))
        .chain(longest.iter().map(untimed))
    {
        let length = request.write(&mut frame);
        let (frame, out) = (black_box(&frame[..length]), &mut out);
        worst = worst.max(stack::used(|| call(&mut subject, frame, out)));
        out.fill(0);
        // so that the image without a subject has to look at the answer, too
        let length = black_box(call(&mut subject, frame, out));
        wrong += u32::from(!request.is_answered_by(length, out));
        if let (Some(clock), true) = (&mut clock, is_timed) {
            let ticks = ticks(clock, || call(&mut subject, frame, out));
            let idle = ticks_of_nothing(clock, frame, out);
            semihosting::print(request.name, ticks.saturating_sub(idle));
        }
    }
    semihosting::print("stack", worst as u32);
    semihosting::print("state", size_of::<S>() as u32);
    semihosting::print("wrong", wrong);
    semihosting::exit()
}

fn untimed(request: &Request) -> (&Request, bool) {
    (request, false)
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
