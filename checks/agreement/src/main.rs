//! The same requests, many of them wrong, to the general server of this project and to libmodbus: both answer the
//! same and do the same to their tables, or a rule says why not. A difference without a rule ends the run.
//!
//! `jointbus-agreement COUNT [SEED]`

mod requests;
mod rules;
mod theirs;

use std::error::Error;
use std::process::ExitCode;

use jointbus_protocol::decode::{Event, FrameDecoder, FrameEvent, STRAY_MAX};
use jointbus_protocol::modbus::BROADCAST;
use jointbus_protocol::modbus::rtu::{FRAME_MAX, RequestFraming};
use jointbus_protocol::modbus::server::{self, RamTables};
use jointbus_protocol::time::{Duration, Instant};

use rules::{Case, RULES};
use theirs::Theirs;

/// The tables of both servers: a read and a write as long as they get fit in.
pub(crate) type Tables = RamTables<250, 16, 128, 64>;

/// The unit of both servers.
const UNIT: u8 = 1;

/// Where the requests start unless told otherwise.
const SEED: u64 = 0x6A6F_696E_7462_7573;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let count: u64 = arguments.next().ok_or("how many requests?")?.parse()?;
    let seed = arguments.next().map_or(Ok(SEED), |seed| seed.parse())?;
    let mut ours = Tables::new();
    ours.discrete_inputs = core::array::from_fn(|byte| (byte as u8).wrapping_mul(37) ^ 0xA5);
    ours.input_registers = core::array::from_fn(|register| register as u16 * 257 + 1);
    let mut theirs = Theirs::new(UNIT, &ours)?;
    let mut random = requests::Random::new(seed);
    let (mut equal, mut answered) = (0u64, 0u64);
    let mut foreign = false;
    let mut explained = [0u64; RULES.len()];
    for number in 0..count {
        let frame = requests::next(&mut random, UNIT);
        let before = ours.clone();
        let our_answer = serve(&mut ours, &frame);
        let their_answer = theirs.serve(&frame)?;
        let their_tables = theirs.tables();
        let after_foreign = core::mem::replace(&mut foreign, !matches!(frame[..], [BROADCAST | UNIT, ..]));
        answered += u64::from(!our_answer.is_empty());
        if our_answer == their_answer && ours == their_tables {
            equal += 1;
            continue;
        }
        let case = Case {
            frame: &frame,
            ours: &our_answer,
            theirs: &their_answer,
            we_changed: ours != before,
            they_changed: their_tables != before,
            after_foreign,
        };
        let Some(rule) = RULES.iter().position(|rule| (rule.explains)(&case)) else {
            return Err(format!("request {number} of seed {seed}: no rule explains\n{case}").into());
        };
        explained[rule] += 1;
        theirs.set(&ours);
    }
    println!("{count} requests, {answered} of them answered by us; {equal} times alike, and where not:");
    for (rule, times) in RULES.iter().zip(explained) {
        println!("{times:>9}  {}: {}", rule.name, rule.reason);
    }
    Ok(())
}

/// What we answer to bytes that are followed by silence; empty for nothing.
fn serve(tables: &mut Tables, mut bytes: &[u8]) -> Vec<u8> {
    let silence = Duration::from_millis(2);
    let mut decoder = FrameDecoder::<{ FRAME_MAX + STRAY_MAX }>::new(silence);
    let (start, end) = (Instant::from_micros(0), Instant::from_micros(0).saturating_add(silence));
    let mut answers = Vec::new();
    let mut take = |event: FrameEvent<'_>| {
        let mut out = [0; FRAME_MAX];
        if let Event::Frame(frame) = event {
            answers.extend_from_slice(server::rtu(tables, UNIT, frame, &mut out).unwrap_or(&[]));
        }
    };
    while let Some(event) = decoder.feed(&RequestFraming, &mut bytes, start) {
        take(event);
    }
    if let Some(event) = decoder.poll(&RequestFraming, end) {
        take(event);
    }
    answers
}
