//! The subjects on the host, to be run in callgrind with `--toggle-collect=measured --dump-after=measured`: it leaves
//! one file a call of [`measured`], in the order of the lines that this prints.
//!
//! Everything is called twice in a row, and the second time counts: the first one resolves the functions of libraries.

#[cfg(feature = "others")]
mod libmodbus;
mod linear;
mod scale;

use std::hint::black_box;
use std::process::ExitCode;

use jointbus_bench_subjects::{Empty, server};
use jointbus_bench_subjects::{FRAME_MAX, REQUESTS, Request, Requests, Subject};

/// What is counted: this call, and all that it calls.
#[unsafe(no_mangle)]
#[inline(never)]
extern "Rust" fn measured(run: &mut dyn FnMut()) {
    run();
}

/// Prints what is measured next, and measures it.
fn count(subject: &str, request: &str, mut run: impl FnMut()) {
    for _ in 0..2 {
        count_once(subject, request, &mut run);
    }
}

fn count_once(subject: &str, request: &str, mut run: impl FnMut()) {
    println!("{subject}\t{request}");
    measured(black_box(&mut run));
}

/// Asks a subject all of its requests; whether all answers were right.
fn ask<S: Subject>(name: &str) -> bool {
    let mut subject = black_box(S::new());
    let serve = black_box(S::serve as Serve<S>);
    let Requests { first, timed, longest } = &REQUESTS[S::KIND as usize];
    let (mut frame, mut out) = ([0; FRAME_MAX], [0; FRAME_MAX]);
    let mut right = true;
    for (request, is_timed) in first
        .iter()
        .map(untimed)
        .chain(timed.iter().map(|request| (request, true)))
        .chain(longest.iter().map(untimed))
    {
        let length = request.write(&mut frame);
        let frame = black_box(&frame[..length]);
        let mut answer = 0;
        if is_timed {
            count(name, request.name, || answer = serve(&mut subject, frame, &mut out));
        } else {
            answer = serve(&mut subject, frame, &mut out);
        }
        if !request.is_answered_by(answer, &out) {
            eprintln!("{name}: {frame:02x?} was answered with {:02x?}", &out[..answer]);
            right = false;
        }
    }
    right
}

/// Called through a pointer, so that the call is there whatever is called.
type Serve<S> = fn(&mut S, &[u8], &mut [u8; FRAME_MAX]) -> usize;

fn untimed(request: &Request) -> (&Request, bool) {
    (request, false)
}

/// What the calls around a subject take.
fn nothing() {
    let mut out = [0; FRAME_MAX];
    let serve = black_box(Empty::serve as Serve<Empty>);
    let (frame, mut answer) = (black_box(&[0][..]), 0);
    count("nothing", "", || answer = serve(&mut Empty, frame, &mut out));
    assert_eq!(answer, 0, "nothing answers nothing");
}

fn main() -> ExitCode {
    nothing();
    let ours = [
        ask::<server::WithTable>("server"),
        ask::<server::WithSlices>("server_sliced"),
        ask::<server::WithSmallTable>("server_small"),
        ask::<server::WithoutTable>("server_bitwise"),
    ];
    linear::all();
    scale::all();
    if ours.into_iter().chain(others()).all(|right| right) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

#[cfg(feature = "others")]
fn others() -> Vec<bool> {
    use jointbus_bench_subjects::others::{mbus, modbus_core, rmodbus};
    vec![
        ask::<rmodbus::Rmodbus>("rmodbus"),
        ask::<modbus_core::ModbusCore>("modbus_core"),
        ask::<mbus::Mbus>("mbus"),
        libmodbus::ask("libmodbus"),
    ]
}

#[cfg(not(feature = "others"))]
const fn others() -> [bool; 0] {
    []
}
