//! A dead device among living ones.

use super::{Found, of_seeds};
use crate::sim::boards::SimBoard;
use crate::sim::moment::{MILLIS, Moment, Nanos, SECONDS};
use crate::sim::plan::Plan;
use crate::sim::random::Random;
use crate::sim::routes;
use crate::sim::run::Run;
use crate::sim::settings::Settings;
use crate::sim::world::Notice;
use jointbus_mcu_bridge::board::Port;
use std::ops::Range;

/// Time between two requests to the same device, by bus, so that a probe finds room beside them; and how long all live,
/// and one is dead.
const FAST: (Nanos, Nanos) = (100 * MILLIS, 200 * SECONDS);
const SLOW: (Nanos, Nanos) = (500 * MILLIS, 300 * SECONDS);

/// One of the devices on a bus is dead: the others keep 95 % of their rate, and its return is noticed within a probe
/// period. Devices and buses vary with the seed, and so does the
/// board.
#[must_use]
pub fn dead_devices(board: impl Fn(u64) -> SimBoard + Sync, seeds: Range<u64>) -> Found {
    let [found] = of_seeds(seeds, |seed| [one(board(seed), seed)]);
    found
}

fn one(board: SimBoard, seed: u64) -> Found {
    let mut random = Random::new(seed ^ 0xDEAD);
    let settings = Settings::new(board, seed);
    let buses: Vec<Port> = board.description.ports().skip(1).collect();
    let port = random.pick(&buses);
    let (cycle, span) = if routes::speaks_nst(&settings.network, port) { FAST } else { SLOW };
    let probe = Nanos::from(settings.limits.probe_period_ms) * MILLIS;
    let mut queues = board.queues();
    let mut run = Run::new(Plan { settings, ..Plan::of_seed(board, seed, 0, Some(&[])) }, &mut queues);
    run.questions.longest = 20;
    let board = board.name();
    let asked = run.questions.units().iter().copied();
    let units: Vec<u8> = asked.filter(|unit| routes::port_of(&run.network, *unit) == Some(port)).collect();
    let victim = random.index(units.len());
    let dead = units[victim];
    let mut course = Course { run, port, answers: vec![0; units.len()], units, cycle, asked: 0 };
    let start = course.run.world.now();
    // until the bus is in its stride
    course.go(start.saturating_add(cycle), None);
    let before = course.others(victim, span);
    course.set_absent(dead, Moment::from_nanos(u64::MAX));
    let during = course.others(victim, span);
    let back = course.run.world.now();
    course.set_absent(dead, Moment::default());
    course.go(back.saturating_add(10 * SECONDS), Some(dead));
    let noticed = course.run.world.now().saturating_duration_since(back);
    let mut found = Found::default();
    found.count("requests", course.asked);
    found.count("answers of the others before", before);
    found.count("while one was dead", during);
    found.count("returns", 1);
    if during * 100 < before * 95 {
        found.violation(format!("cargo xtask soak --seed {seed} --seeds 1, {board}, {port:?}: the others gave {during} answers, before {before}"));
    }
    if noticed > probe + 2 * cycle {
        let late = noticed / MILLIS;
        found.violation(format!(
            "cargo xtask soak --seed {seed} --seeds 1, {board}, {port:?}: the return was noticed after {late} ms"
        ));
    }
    if let Some(first) = course.run.master.tally.violations.first() {
        found.violation(format!("cargo xtask soak --seed {seed} --seeds 1, {board}, {port:?}: {first}"));
    }
    found
}

struct Course<'q> {
    run: Run<'q>,
    port: Port,
    units: Vec<u8>,
    cycle: Nanos,
    answers: Vec<u64>,
    asked: u64,
}

impl Course<'_> {
    /// Asks all devices once a cycle; until `end`, or until `stop` answers.
    fn go(&mut self, end: Moment, stop: Option<u8>) {
        while self.run.world.now() < end {
            for unit in self.units.clone() {
                let question = self.run.questions.for_unit(unit);
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
        self.answers.fill(0);
        self.go(self.run.world.now().saturating_add(span), None);
        let others = self.answers.iter().enumerate().filter(|(index, _)| *index != victim);
        others.map(|(_, count)| count).sum()
    }

    fn set_absent(&mut self, unit: u8, until: Moment) {
        let address = self.run.network.route(unit).map_or(1, |(_, route)| route.remote_of(unit));
        self.run.world.set_absent(self.port, usize::from(address) - 1, until);
    }
}
