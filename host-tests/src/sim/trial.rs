//! One fault alone, in traffic that is otherwise clean: what it does to the counters, and to the service.

use super::boards::SimBoard;
use super::effects::{Counter, Service};
use super::fault::{Fault, Place};
use super::moment::{MICROS, MILLIS, Moment, Nanos};
use super::plan::{Manner, Plan};
use super::question::Question;
use super::random::Random;
use super::run::Run;
use super::settings::Settings;
use super::world::Notice;
use jointbus_mcu_bridge::board::{Port, Route};
use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, RS485_A, RS485_B};
use jointbus_mcu_bridge::engine::Counters;
use jointbus_mcu_bridge::io::serial::UartBuffers;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::nst::can::{FrameType, Identifier};
use std::collections::HashMap;

/// Units that something answers for.
const UNITS: [u8; 18] = [1, 2, 3, 4, 5, 16, 17, 18, 19, 20, 31, 32, 33, 34, 35, 36, 40, 247];

/// The bridge itself.
const BRIDGE: u8 = 247;

/// Silence of the host that ends whatever it has sent.
const SILENCE: Nanos = 21 * MILLIS;

/// Request and reply on the slowest line with the gap before them, and the time to take notice.
const WIRE: Nanos = 100 * MILLIS;

/// Longest time that an injected fault waits for its frame.
const PATIENCE: Nanos = 30_000 * MILLIS;

/// The main loop takes notice of a moment so much later at most.
const NOTICED: Nanos = MILLIS / 4;

/// Alarm for a look at the bridge's health.
const LOOK: u64 = 7;

/// What came of a trial.
#[derive(Debug, Clone, Default)]
pub struct Trial {
    /// Counters of all ports at the end; before the fault they told of traffic alone.
    pub counters: [Counters; 4],
    /// Requests.
    pub transactions: u64,
    /// Requests without an answer.
    pub failed: u64,
    /// What must not happen to the service.
    pub service: Vec<String>,
    /// What is wrong with the counters.
    pub raised: Vec<String>,
}

/// A trial under way.
struct Course<'q> {
    run: Run<'q>,
    fault: Fault,
    service: Service,
    bus: Port,
    echo: bool,
    random: Random,
    over: Moment,
    /// The one transaction that may fail has failed.
    spent: bool,
    /// Forms of reply that a unit owes, and until when.
    owed: HashMap<(u8, [u8; 2]), Moment>,
    /// Transactions in a row that failed, and when the last of them ended that was sent.
    in_a_row: HashMap<u8, (u32, Moment)>,
    /// Frames that the bridge sent and heard, by port.
    sent: [u32; 4],
    heard: u32,
    found: Trial,
}

impl Trial {
    /// Injects a fault into the traffic of a seed, on the reference board.
    #[must_use]
    pub fn of(fault: Fault, seed: u64) -> Self {
        let mut queues = SimBoard::STM32F405.queues();
        let mut course = Course::new(fault, seed, &mut queues);
        course.warm_up();
        course.bring_about();
        course.look_after();
        course.close();
        course.found
    }
}

impl<'q> Course<'q> {
    fn new(fault: Fault, seed: u64, queues: &'q mut [UartBuffers]) -> Self {
        let mut random = Random::new(seed ^ 0x0FA7);
        let mut settings = Settings::new(SimBoard::STM32F405, seed);
        let bus = match fault.place() {
            Place::Host => Port::HOST,
            Place::Can => CAN,
            Place::Serial if fault == Fault::ReplyException => RS485_B,
            Place::Serial => random.pick(&[RS485_A, RS485_B]),
        };
        let echo = fault.place() == Place::Serial && random.chance(300_000);
        settings.network.ports[bus.index()].echo = echo;
        let plan = Plan {
            settings,
            requests: 0,
            manner: Manner::Waits(0),
            faults: Vec::new(),
            fault_rate: 0,
            broadcast_rate: 0,
        };
        let mut run = Run::new(plan, queues);
        // what needs one transfer on CAN
        run.questions.longest = 120;
        Self {
            run,
            fault,
            service: fault.service(),
            bus,
            echo,
            random,
            over: Moment::default(),
            spent: false,
            owed: HashMap::new(),
            in_a_row: HashMap::new(),
            sent: [0; 4],
            heard: 0,
            found: Trial::default(),
        }
    }

    /// Each unit answers, and nothing but traffic is counted.
    fn warm_up(&mut self) {
        for unit in UNITS {
            let failed = self.found.failed;
            self.transaction(unit);
            if self.found.failed > failed {
                self.found.raised.push(format!("unit {unit} does not answer before the fault"));
            }
        }
        let engine = self.run.world.engine();
        for port in BOARD.ports() {
            let counters = engine.counters(port);
            let raised = Counter::ALL.into_iter().find(|counter| counter.of(&counters) > 0);
            if let Some(counter) = raised {
                self.found.raised.push(format!("{port:?} counts {} before the fault", counter.name()));
            }
        }
    }

    /// Injects the fault, and asks until it has come about.
    fn bring_about(&mut self) {
        if self.fault.place() == Place::Host {
            let end = self.run.host_fault(self.fault);
            self.until(end.saturating_add(SILENCE));
            // what is good in it is answered
            let limit = self.run.world.now().saturating_add(1000 * MILLIS);
            while self.run.master.open > 0 && self.run.world.now() < limit {
                self.until(self.run.world.now().saturating_add(MILLIS));
            }
            self.over = self.run.world.now();
            return;
        }
        self.over = self.run.world.inject_at(self.fault, self.bus);
        let mut units = self.units_of_bus();
        // sometimes a few units alone, so that they come to be quarantined
        if self.random.chance(500_000) && !self.run.world.is_armed() {
            let most = self.random.between(1, 3) as usize;
            units.truncate(most);
        }
        let limit = self.run.world.now().saturating_add(PATIENCE);
        loop {
            let armed = self.run.world.is_armed();
            if !armed && self.run.world.now() >= self.over {
                break;
            }
            if self.run.world.now() >= limit {
                self.found.raised.push("the fault did not come about".to_owned());
                break;
            }
            let unit = self.random.pick(&units);
            let begun = self.run.world.now();
            if armed {
                // the fault comes about some time in this transaction
                self.over = self.over.max(begun.saturating_add(1));
            }
            self.transaction(unit);
        }
    }

    fn units_of_bus(&mut self) -> Vec<u8> {
        let mut units: Vec<u8> =
            UNITS.into_iter().filter(|unit| self.port_of(*unit) == Some(self.bus)).collect();
        for index in (1..units.len()).rev() {
            units.swap(index, self.random.index(index + 1));
        }
        units
    }

    fn route(&self, unit: u8) -> Route {
        self.run.world.settings().network.route(unit).map_or(Route::UNUSED, |(_, route)| *route)
    }

    fn port_of(&self, unit: u8) -> Option<Port> {
        self.route(unit).target.port()
    }

    /// Asks everybody until every bound has passed, and then once more.
    fn look_after(&mut self) {
        let span = match self.service {
            Service::Kept => 0,
            // the hold-off of a write
            Service::One | Service::Late => 1700 * MILLIS,
            // and a probe after it
            Service::Span => 3000 * MILLIS,
        };
        let end = self.run.world.now().saturating_add(span);
        loop {
            let last = self.run.world.now() >= end;
            for unit in UNITS {
                self.transaction(unit);
            }
            if last {
                break;
            }
        }
    }

    /// Lets time pass until `end`, taking notice.
    fn until(&mut self, end: Moment) {
        while let Some(notice) = self.run.world.next(end) {
            self.notice(&notice);
        }
    }

    fn notice(&mut self, notice: &Notice) -> Option<u8> {
        match notice {
            Notice::SerialFrame { port, .. } => self.sent[port.index()] += 1,
            Notice::CanFrame { .. } => self.sent[CAN.index()] += 1,
            Notice::BridgeHears { .. } => self.heard += 1,
            Notice::Alarm(_) if !self.run.master.is_open(BRIDGE, &Question::Health) => {
                self.run.ask(BRIDGE, Question::Health);
            }
            _ => {}
        }
        self.run.notice(notice)
    }

    /// One question to a unit; whether it may fail is judged by what came before.
    fn transaction(&mut self, unit: u8) {
        let pause = self.random.below(300) * MICROS;
        self.until(self.run.world.now().saturating_add(pause));
        let (route, port) = (self.route(unit), self.port_of(unit));
        let question = loop {
            let question = self.run.questions.for_unit(unit);
            if !self.run.master.is_open(unit, &question) {
                break question;
            }
        };
        let before = self.run.master.tally.clone();
        let asked = self.run.world.now();
        let taken = self.run.ask(unit, question);
        let attempts = if question.is_read() { u64::from(route.read_retries) + 1 } else { 1 };
        let timeout = route.timeout(question.is_read()).as_micros() * MICROS;
        let live = Nanos::from(route.time_to_live_ms) * MILLIS;
        let limit = taken.saturating_add(live + attempts * (timeout + WIRE));
        if self.fault.place() == Place::Can && port == Some(CAN) {
            (1..8).for_each(|look| self.run.world.set_alarm(taken.saturating_add(look * 3 * MILLIS), LOOK));
        }
        let (mut sent, mut last_sent) = (0, taken);
        self.found.transactions += 1;
        let mut heard = None;
        while heard != Some(unit) {
            let Some(notice) = self.run.world.next(limit) else { break };
            match notice {
                Notice::SerialFrame { port: on, .. } if Some(on) == port => {
                    (sent, last_sent) = (sent + 1, self.run.world.now());
                }
                Notice::CanFrame { frame, .. } if port == Some(CAN) => {
                    sent += u32::from(begins(&frame));
                    last_sent = self.run.world.now();
                }
                _ => {}
            }
            heard = self.notice(&notice);
        }
        let failed = self.run.master.tally.refused > before.refused || heard != Some(unit);
        let unanswered = sent.saturating_sub(u32::from(!failed));
        let form = form_of(&question.frame(unit), route.protocol.is_nst());
        if failed {
            self.found.failed += 1;
            self.judge(unit, form, asked, &question);
        }
        if unanswered > 0 {
            let late_response_window = route.late_response_window(question.is_read()).as_micros() * MICROS;
            self.owed.insert((unit, form), last_sent.saturating_add(late_response_window + NOTICED));
        }
        let (row, last) = self.in_a_row.entry(unit).or_default();
        *row = if failed { *row + 1 } else { 0 };
        if sent > 0 {
            *last = self.run.world.now();
        }
    }

    /// A transaction failed: whether it may.
    fn judge(&mut self, unit: u8, form: [u8; 2], asked: Moment, question: &Question) {
        let now = self.run.world.now();
        let probe = Nanos::from(self.run.world.settings().limits.probe_period_ms) * MILLIS;
        let mine = self.port_of(unit) == Some(self.bus);
        // a probe that would have to wait for what is owed is none
        let owed_until = self.owed.get(&(unit, form)).copied().unwrap_or_default();
        let owed = asked < owed_until;
        let quarantined = self.in_a_row.get(&unit).is_some_and(|(row, last)| {
            *row >= 3 && asked < last.saturating_add(probe + NOTICED).max(owed_until)
        });
        let during = asked < self.over;
        // a device does one thing after the other; all modules of a station are one device
        let late = self
            .owed
            .iter()
            .any(|((other, _), until)| asked < *until && (*other == unit || self.bus == RS485_B));
        let excused = mine
            && match self.service {
                Service::Kept => false,
                Service::One => owed || !std::mem::replace(&mut self.spent, true),
                Service::Late => late || quarantined || !std::mem::replace(&mut self.spent, true),
                Service::Span => during || owed || quarantined || !std::mem::replace(&mut self.spent, true),
            };
        if !excused {
            let after = asked.saturating_duration_since(self.over) / MICROS;
            self.found.service.push(format!(
                "{:.6} s: {question:?} to unit {unit}, {after} us after the fault, is not answered",
                now.as_nanos() as f64 / 1e9
            ));
        }
    }

    /// Lets everything come to rest, and compares the counters of traffic.
    fn close(&mut self) {
        self.until(self.run.world.now().saturating_add(1700 * MILLIS));
        let health = std::mem::take(&mut self.run.master.health);
        self.run.ask_and_wait(BRIDGE, Question::Health);
        let [must, may] = self.fault.health();
        if health & must != must || health & !may != 0 || self.run.master.health != 0 {
            let end = self.run.master.health;
            self.found.raised.push(format!("health bits {health:#x} meanwhile, {end:#x} in the end"));
        }
        let engine = self.run.world.engine();
        self.found.counters = [Port::HOST, RS485_A, RS485_B, CAN].map(|port| engine.counters(port));
        self.found.raised.extend(self.fault.misjudged(self.bus, self.echo, &self.found.counters));
        let [host, a, b, can] = &self.found.counters;
        let tally = &self.run.master.tally;
        let answers = tally.answered + tally.refused;
        let traffic = [
            ("requests", host.received, tally.asked),
            ("answers", host.sent, answers),
            ("frames on the first line", a.sent, self.sent[1].into()),
            ("frames on the second line", b.sent, self.sent[2].into()),
            ("frames on CAN", can.sent, self.sent[3].into()),
            ("frames heard on CAN", can.received + can.overruns, self.heard.into()),
        ];
        for (what, counted, was) in traffic {
            if u64::from(counted) != was {
                self.found.raised.push(format!("{what}: {counted} counted of {was}"));
            }
        }
        self.found.raised.extend(tally.violations.iter().cloned());
    }
}

/// What a reply to a request is told by: function code and, for NST, length.
fn form_of(frame: &[u8], nst: bool) -> [u8; 2] {
    [frame.get(1).copied().unwrap_or(0), frame.get(4).copied().filter(|_| nst).unwrap_or(0)]
}

/// Whether a frame on CAN begins a transfer.
fn begins(frame: &Frame) -> bool {
    let Id::Extended(raw) = frame.id() else { return false };
    Identifier::from_raw(raw)
        .is_some_and(|identifier| matches!(identifier.frame_type, FrameType::Single | FrameType::First))
}
