//! What must hold, whatever happens; each a function that runs for a while and tells what it counted.

use super::delay::Delay;
use super::fault::{Fault, Place};
use super::master::Tally;
use super::moment::{MICROS, MILLIS, Moment, Nanos, SECONDS};
use super::question::Question;
use super::run::{Manner, Plan, Run};
use super::settings::Settings;
use super::world::Notice;
use crate::devices::motion::spelt_moment;
use jointbus_mcu_bridge::io::serial::Queues;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::modbus::{self, Range, rtu};
use jointbus_protocol::nst::can::{FrameType, Identifier};
use std::ops::Range as Seeds;

/// Requests of one seed: few enough to repeat a failure in no time.
pub const REQUESTS: u64 = 1000;

/// Unit of the bridge itself, and its register of the first polling slot.
const BRIDGE: u8 = 247;
const FIRST_SLOT: u16 = 0x50;

/// Sensors on the first RS485 line, of which the middle one dies.
const SENSORS: [u8; 5] = [16, 17, 18, 19, 20];
const VICTIM: usize = 2;

/// Longest time that an injected fault is waited for.
const PATIENCE: Nanos = 3 * SECONDS;

/// What a property found.
#[derive(Debug, Clone, Default)]
pub struct Found {
    /// What was counted, in words.
    pub counted: String,
    /// How often it was violated.
    pub violated: u64,
    /// The first few violations, with the command that repeats them.
    pub violations: Vec<String>,
}

impl Found {
    fn violation(&mut self, what: String) {
        self.violated += 1;
        if self.violations.len() < 10 {
            self.violations.push(what);
        }
    }
}

/// Under all faults and reply times: no answer reaches the host that is not to its question; every request is answered
/// or counted; nothing is sent after its time to live; no write or command is carried out twice, or without a request
/// (also one that stands in the data of a broken frame).
#[must_use]
pub fn answers(seeds: Seeds<u64>) -> Found {
    let (mut found, mut tally) = (Found::default(), Tally::default());
    for seed in seeds {
        let one = Plan::of_seed(seed, REQUESTS, None).run();
        if one.violated > 0 {
            let first = one.violations.first().cloned().unwrap_or_default();
            found.violation(format!("cargo xtask sim --seed {seed}: {first}"));
        }
        tally.add(&one);
    }
    found.counted = format!(
        "{} requests: {} answered, {} refused, {} silent; {} frames on RS485, {} on CAN; {} writes and commands done; \
         {} replies right by coincidence of the CRC",
        tally.asked,
        tally.answered,
        tally.refused,
        tally.silent,
        tally.sent[0],
        tally.sent[1],
        tally.executed,
        tally.coincidences,
    );
    found
}

/// After a fault the service is back: one transaction may fail once the line has been silent, the next one may not.
#[must_use]
pub fn service_returns(seeds: Seeds<u64>) -> Found {
    let (mut found, mut transactions) = (Found::default(), 0);
    for seed in seeds {
        for fault in Fault::ALL {
            let mut queues = [Queues::new(), Queues::new(), Queues::new()];
            let plan = Plan {
                settings: Settings::new(seed),
                requests: 0,
                manner: Manner::Waits(0),
                faults: Vec::new(),
                fault_rate: 0,
                broadcast_rate: 0,
            };
            let mut run = Run::new(plan, &mut queues);
            let units = [1, 2, 3, 4, 5, 16, 17, 18, 19, 20, 32, 33, 34, 35, BRIDGE];
            let over = match fault.place() {
                Place::Host => run.host_fault(*fault),
                Place::Serial | Place::Can => run.world.inject(*fault),
            };
            if fault.place() == Place::Host {
                run.settle(over.since(run.world.now()) + 25 * MILLIS);
            }
            // what waits for a frame gets frames
            let end = run.world.now().after(PATIENCE);
            while (run.world.is_armed() || run.world.now() < over) && run.world.now() < end {
                for unit in units {
                    let question = run.questions.for_unit(&Settings::new(seed).network, unit);
                    if !run.master.is_open(unit, &question) {
                        run.ask_and_wait(unit, question);
                    }
                }
            }
            // a late reply is owed for the hold-off of a write, a dead device is asked once a second
            run.settle(1600 * MILLIS);
            for unit in units {
                let back = (0..2).any(|_| {
                    let question = run.questions.for_unit(&Settings::new(seed).network, unit);
                    transactions += 1;
                    run.ask_and_wait(unit, question)
                });
                if !back {
                    found.violation(format!("seed {seed}, {}: unit {unit} does not answer", fault.name()));
                }
            }
            if let Some(first) = run.master.tally.violations.first() {
                found.violation(format!("seed {seed}, {}: {first}", fault.name()));
            }
        }
    }
    found.counted = format!("{} kinds of fault, {transactions} transactions afterwards", Fault::ALL.len());
    found
}

/// One of five sensors on a line is dead: the others keep 95 % of their rate, and its return is noticed within a probe
/// period.
#[must_use]
pub fn a_dead_device_costs_little(seed: u64, span: Nanos) -> Found {
    const CYCLE: Nanos = 20 * MILLIS;
    let mut queues = [Queues::new(), Queues::new(), Queues::new()];
    let plan = Plan::of_seed(seed, 0, Some(&[]));
    let settings = Settings::new(seed);
    let probe = Nanos::from(settings.limits.probe_period_ms) * MILLIS;
    let mut run = Run::new(Plan { settings, ..plan }, &mut queues);
    // a write that is let through as a probe may take half a second by the contract
    run.questions.writes = 0;
    let cycle = |run: &mut Run<'_>, until: Moment, stop: Option<u8>| {
        let mut answers = [0u64; SENSORS.len()];
        while run.world.now() < until {
            for unit in SENSORS {
                let question = run.questions.for_unit(&Settings::new(seed).network, unit);
                if !run.master.is_open(unit, &question) {
                    let at = run.world.host_sends(&question.frame(unit));
                    run.master.ask(unit, question, at);
                }
            }
            let end = run.world.now().after(CYCLE);
            while let Some(notice) = run.world.next(end) {
                match notice {
                    Notice::HostHears(_) => {
                        let unit = run.notice(&notice);
                        let index = SENSORS.iter().position(|sensor| Some(*sensor) == unit);
                        if let Some(count) = index.and_then(|index| answers.get_mut(index)) {
                            *count += 1;
                        }
                        if unit.is_some() && unit == stop {
                            return answers;
                        }
                    }
                    notice => {
                        run.notice(&notice);
                    }
                }
            }
            run.master.forget(run.world.now());
        }
        answers
    };
    let others = |answers: [u64; SENSORS.len()]| -> u64 {
        answers.iter().enumerate().filter(|(index, _)| *index != VICTIM).map(|(_, count)| count).sum()
    };
    let start = run.world.now();
    let before = others(cycle(&mut run, start.after(span), None));
    let dead = run.world.now().after(span);
    run.world.lines[0].devices[VICTIM].absent = dead;
    let during = others(cycle(&mut run, dead, None));
    let back = run.world.now();
    cycle(&mut run, back.after(10 * SECONDS), Some(SENSORS[VICTIM]));
    let noticed = run.world.now().since(back);
    let mut found = Found {
        counted: format!(
            "{before} answers of the others before, {during} while one was dead; its return noticed after {} ms",
            noticed / MILLIS
        ),
        ..Found::default()
    };
    if during * 100 < before * 95 {
        found.violation(format!("seed {seed}: the others lost more than 5 %"));
    }
    if noticed > probe + 2 * CYCLE {
        found.violation(format!("seed {seed}: noticed too late"));
    }
    if let Some(first) = run.master.tally.violations.first() {
        found.violation(format!("seed {seed}: {first}"));
    }
    found
}

/// A sensor on CAN at 1 Mbit/s is polled with 1000 Hz beside a host that talks to the other buses: no period is missed,
/// no sample is torn, its time stamp is that of the reply's last frame.
#[must_use]
pub fn polling_is_on_time(seed: u64, span: Nanos) -> Found {
    const LOOK: u64 = 1;
    const ASK: u64 = 2;
    const STAMP: Nanos = 10 * MICROS;
    let mut queues = [Queues::new(), Queues::new(), Queues::new()];
    let mut settings = Settings::new(seed);
    settings.node_delay = Delay::Uniform(50 * MICROS, 200 * MICROS);
    let network = settings.network;
    let mut run = Run::new(Plan { settings, ..Plan::of_seed(seed, 0, Some(&[])) }, &mut queues);
    run.master.polls = true;
    run.questions.only(&[16, 17, 18, 19, 20, 32, 33, 34, 35, BRIDGE]);
    // unit 1, each 10 times 100 us
    let values = [0, 1, 0, 10];
    let request = modbus::Request::WriteMultipleRegisters { range: Range::new(FIRST_SLOT, 2), data: &values };
    let mut buffer = [0; rtu::FRAME_MAX];
    run.world.host_sends(rtu::encode_request(BRIDGE, &request, &mut buffer).unwrap_or(&[]));
    let mut heard = 0;
    let started = run.world.now();
    // the bridge's own acknowledgement of that
    while run.world.now() < started.after(10 * MILLIS) {
        if let Some(Notice::HostHears(_)) = run.world.next(started.after(10 * MILLIS)) {
            heard += 1;
        }
    }
    let mut found = Found::default();
    if heard != 8 {
        found.violation(format!("seed {seed}: the slot was not set"));
    }
    let end = run.world.now().after(span);
    run.world.set_alarm(run.world.now(), LOOK);
    run.world.set_alarm(run.world.now(), ASK);
    let mut sequence = run.world.engine().slot(0).map_or(0, |slot| slot.sequence);
    let (mut last_frame, mut samples) = (Moment::default(), 0u64);
    while let Some(notice) = run.world.next(end) {
        match notice {
            Notice::Alarm(LOOK) => {
                run.world.set_alarm(run.world.now().after(500 * MICROS), LOOK);
                let Some(slot) = run.world.engine().slot(0).filter(|slot| slot.sequence != sequence).copied()
                else {
                    continue;
                };
                (sequence, samples) = (slot.sequence, samples + 1);
                let measured = spelt_moment(&slot.sample);
                if measured.is_none_or(|measured| measured > slot.stamp) {
                    found.violation(format!("seed {seed}: sample {sequence} is torn"));
                }
                let stamp = Moment::of(slot.stamp);
                if stamp.since(last_frame) > STAMP || last_frame.since(stamp) > STAMP {
                    found.violation(format!("seed {seed}: the stamp of sample {sequence} is wrong"));
                }
            }
            Notice::Alarm(_) => {
                let (unit, question) = run.questions.next(&network);
                let is_open = run.master.is_open(unit, &question);
                if !is_open || matches!(question, Question::Loopback { .. }) {
                    let at = run.world.host_sends(&question.frame(unit));
                    run.master.ask(unit, question, at);
                }
                run.world.set_alarm(run.world.now().after(7 * MILLIS), ASK);
                run.master.forget(run.world.now());
            }
            Notice::BridgeHears(frame) if ends_transfer(&frame) => last_frame = run.world.now(),
            notice => {
                run.notice(&notice);
            }
        }
    }
    let slot = run.world.engine().slot(0).copied().unwrap_or_default();
    let periods = span / MILLIS;
    if slot.missed > 0 || slot.failures > 0 || u64::from(slot.sequence) + 20 < periods {
        found.violation(format!("seed {seed}: {} missed, {} failed", slot.missed, slot.failures));
    }
    if let Some(first) = run.master.tally.violations.first() {
        found.violation(format!("seed {seed}: {first}"));
    }
    found.counted = format!(
        "{periods} periods, {} samples, {samples} of them looked at, {} host requests answered",
        slot.sequence, run.master.tally.answered
    );
    found
}

/// Whether a frame is the last one of its transfer.
fn ends_transfer(frame: &Frame) -> bool {
    let Id::Extended(raw) = frame.id() else { return false };
    let last = |identifier: &Identifier| matches!(identifier.frame_type, FrameType::Single | FrameType::Last);
    Identifier::from_raw(raw).is_some_and(|identifier| last(&identifier))
}
