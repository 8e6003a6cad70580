//! A dead device among living ones.

use super::{Found, of_seeds};
use crate::sim::moment::{MILLIS, Moment, Nanos, SECONDS};
use crate::sim::plan::Plan;
use crate::sim::random::Random;
use crate::sim::run::Run;
use crate::sim::settings::Settings;
use crate::sim::world::Notice;
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{CAN, RS485_A, RS485_B};
use jointbus_mcu_bridge::io::serial::UartBuffers;
use std::ops::Range;

/// Devices on a bus, of which one dies.
const DEVICES: usize = 5;

/// Time between two requests to the same device, by bus, so that a probe finds room beside them; and how long all live,
/// and one is dead.
const FAST: (Nanos, Nanos) = (100 * MILLIS, 200 * SECONDS);
const SLOW: (Nanos, Nanos) = (500 * MILLIS, 300 * SECONDS);

/// One of five devices on a bus is dead: the others keep 95 % of their rate, and its return is noticed within a probe
/// period. Devices and buses vary with the seed.
#[must_use]
pub fn dead_devices(seeds: Range<u64>) -> Found {
    let [found] = of_seeds(seeds, |seed| [one(seed)]);
    found
}

fn one(seed: u64) -> Found {
    let mut random = Random::new(seed ^ 0xDEAD);
    let settings = Settings::new(seed);
    let (port, units, (cycle, span)) = match random.below(3) {
        0 => (RS485_A, [16, 17, 18, 19, 20], FAST),
        1 => (RS485_B, [32, 33, 34, 35, 36], SLOW),
        _ => (CAN, [1, 2, 3, 4, 5], FAST),
    };
    let victim = random.index(DEVICES);
    let probe = Nanos::from(settings.limits.probe_period_ms) * MILLIS;
    let mut queues = [UartBuffers::new(), UartBuffers::new(), UartBuffers::new()];
    let mut run = Run::new(Plan { settings, ..Plan::of_seed(seed, 0, Some(&[])) }, &mut queues);
    run.questions.longest = 20;
    let mut course = Course { run, port, units, cycle, answers: [0; DEVICES], asked: 0 };
    let start = course.run.world.now();
    // until the bus is in its stride
    course.go(start.saturating_add(cycle), None);
    let before = course.others(victim, span);
    course.set_absent(victim, Moment::from_nanos(u64::MAX));
    let during = course.others(victim, span);
    let back = course.run.world.now();
    course.set_absent(victim, Moment::default());
    course.go(back.saturating_add(10 * SECONDS), Some(units[victim]));
    let noticed = course.run.world.now().saturating_duration_since(back);
    let mut found = Found::default();
    found.count("requests", course.asked);
    found.count("answers of the others before", before);
    found.count("while one was dead", during);
    found.count("returns", 1);
    if during * 100 < before * 95 {
        found.violation(format!("cargo xtask soak --seed {seed} --seeds 1, {port:?}: the others gave {during} answers, before {before}"));
    }
    if noticed > probe + 2 * cycle {
        let late = noticed / MILLIS;
        found.violation(format!(
            "cargo xtask soak --seed {seed} --seeds 1, {port:?}: the return was noticed after {late} ms"
        ));
    }
    if let Some(first) = course.run.master.tally.violations.first() {
        found.violation(format!("cargo xtask soak --seed {seed} --seeds 1, {port:?}: {first}"));
    }
    found
}

struct Course<'q> {
    run: Run<'q>,
    port: Port,
    units: [u8; DEVICES],
    cycle: Nanos,
    answers: [u64; DEVICES],
    asked: u64,
}

impl Course<'_> {
    /// Asks all devices once a cycle; until `end`, or until `stop` answers.
    fn go(&mut self, end: Moment, stop: Option<u8>) {
        let network = self.run.world.settings().network;
        while self.run.world.now() < end {
            for unit in self.units {
                let question = self.run.questions.for_unit(&network, unit);
                if !self.run.master.is_open(unit, &question) {
                    self.run.ask(unit, question);
                    self.asked += 1;
                }
            }
            let until = self.run.world.now().saturating_add(self.cycle);
            while let Some(notice) = self.run.world.next(until) {
                let answered = self.run.master.tally.answered;
                let unit = self.run.notice(&notice);
                if !matches!(notice, Notice::HostHears(_)) || self.run.master.tally.answered == answered {
                    continue;
                }
                let index = self.units.iter().position(|device| Some(*device) == unit);
                if let Some(count) = index.and_then(|index| self.answers.get_mut(index)) {
                    *count += 1;
                }
                if unit.is_some() && unit == stop {
                    return;
                }
            }
            self.run.master.forget(self.run.world.now());
        }
    }

    /// Answers of all but one in a span.
    fn others(&mut self, victim: usize, span: Nanos) -> u64 {
        self.answers = [0; DEVICES];
        self.go(self.run.world.now().saturating_add(span), None);
        let others = self.answers.iter().enumerate().filter(|(index, _)| *index != victim);
        others.map(|(_, count)| count).sum()
    }

    fn set_absent(&mut self, victim: usize, until: Moment) {
        self.run.world.set_absent(self.port, victim, until);
    }
}
