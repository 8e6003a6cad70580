//! A host that asks, faults that come, and what was counted in the end.

mod host_faults;

use super::fault::Place;
use super::framing::with_crc;
use super::master::Master;
use super::moment::{MICROS, MILLIS, Moment, Nanos};
use super::plan::{Manner, Plan};
use super::question::Question;
use super::questions::Questions;
use super::random::Random;
use super::world::{Notice, World};
use jointbus_mcu_bridge::board::Topology;
use jointbus_mcu_bridge::engine::Counters;
use jointbus_mcu_bridge::io::serial::UartBuffers;
use jointbus_protocol::nst;

/// Silence that ends a burst, and one that certainly does.
const BURST_ENDS: Nanos = 20 * MILLIS;
const SILENCE: Nanos = 21 * MILLIS;

/// Alarm for the next request.
const NEXT: u64 = u64::MAX;

/// A run.
pub struct Run<'q> {
    /// What is simulated.
    pub world: World<'q>,
    /// The host.
    pub master: Master,
    /// What it asks.
    pub questions: Questions,
    pub(super) network: Topology,
    random: Random,
    plan: Plan,
    asked: u64,
    /// The unit whose answer a host who waits is waiting for, and when he goes on without it.
    waiting_for: Option<u8>,
    impatient: Moment,
    /// Until then the host is silent, for that ends a frame.
    silent: Moment,
}

impl<'q> Run<'q> {
    /// A run at its beginning; [`SimBoard::queues`](super::SimBoard::queues) makes the queues.
    #[must_use]
    pub fn new(plan: Plan, queues: &'q mut [UartBuffers]) -> Self {
        let mut random = Random::new(plan.settings.seed ^ 0xA5C);
        let network = plan.settings.network;
        Self {
            world: World::new(plan.settings.clone(), queues),
            master: Master::new(&plan.settings),
            questions: Questions::new(&plan.settings, random.fork()),
            network,
            random,
            plan,
            asked: 0,
            waiting_for: None,
            impatient: Moment::default(),
            silent: Moment::default(),
        }
    }

    /// Asks all of it, lets everything come to rest, and settles the account.
    pub fn to_the_end(&mut self) {
        self.start();
        while self.asked < self.plan.requests || self.master.open > 0 {
            self.next(self.world.now().saturating_add(100 * MILLIS));
        }
        self.settle(2000 * MILLIS);
        self.account();
    }

    /// Has the host begin to ask.
    pub fn start(&mut self) {
        self.world.set_alarm(self.world.now(), NEXT);
    }

    /// Runs to the next notice, of which the host has taken notice then, at most until `end`.
    pub fn next(&mut self, end: Moment) -> Option<Notice> {
        loop {
            // one who waits loses patience at a certain moment
            let patience = self.waiting_for.and_then(|unit| self.master.patience(unit));
            let until = patience.map_or(end, |at| end.min(at.saturating_add(1)).min(self.impatient));
            match self.world.next(until) {
                Some(Notice::Alarm(NEXT)) => self.waiting_for = self.next_request(),
                Some(notice) => {
                    let answered = self.notice(&notice);
                    if answered.is_some() && self.waiting_for == answered {
                        self.waiting_for = None;
                        let pause = self.random.below(300 * MICROS);
                        self.world.set_alarm(self.world.now().saturating_add(pause).max(self.silent), NEXT);
                    }
                    return Some(notice);
                }
                None => {
                    let now = self.world.now();
                    self.master.forget(now);
                    if let Some(unit) = self.waiting_for
                        && (self.master.patience(unit).is_none() || now >= self.impatient)
                    {
                        self.waiting_for = None;
                        self.world.set_alarm(now.max(self.silent), NEXT);
                    }
                    if now >= end {
                        return None;
                    }
                }
            }
        }
    }

    /// Lets time pass, in which nothing is asked.
    pub fn settle(&mut self, span: Nanos) {
        let end = self.world.now().saturating_add(span);
        while let Some(notice) = self.world.next(end) {
            self.notice(&notice);
        }
        self.master.forget(self.world.now());
    }

    /// Asks a question. The answer is when the host may send again.
    pub fn ask(&mut self, unit: u8, question: Question) -> Moment {
        let end = self.world.host_sends(&question.frame(unit));
        if question.ends_with_silence() {
            self.world.host_pauses(SILENCE);
            self.master.ask(unit, question, end.saturating_add(BURST_ENDS));
            self.silent = end.saturating_add(SILENCE);
            return self.silent;
        }
        self.master.ask(unit, question, end);
        end
    }

    /// Asks a question, and waits for the answer; whether one came.
    pub fn ask_and_wait(&mut self, unit: u8, question: Question) -> bool {
        let answered = self.master.tally.answered;
        self.ask(unit, question);
        while let Some(over) = self.master.patience(unit) {
            match self.world.next(over.saturating_add(1)) {
                Some(notice) => {
                    self.notice(&notice);
                }
                None => self.master.forget(self.world.now()),
            }
        }
        self.master.tally.answered > answered
    }

    /// Sends a write to all of one kind.
    fn broadcast(&mut self) -> Moment {
        let (unit, question) = self.questions.broadcast();
        let end = self.world.host_sends(&question.frame(unit));
        if unit == nst::BROADCAST {
            self.world.host_pauses(SILENCE);
            self.silent = end.saturating_add(SILENCE);
            self.master.broadcast(&question, end.saturating_add(BURST_ENDS));
            return self.silent;
        }
        self.master.broadcast(&question, end);
        end
    }

    /// Takes notice of what the wires show; the unit whose answer came with it.
    pub fn notice(&mut self, notice: &Notice) -> Option<u8> {
        let now = self.world.now();
        match *notice {
            Notice::HostHears(byte) => return self.master.hear(byte, &self.world),
            Notice::SerialFrame { port, start } => {
                let frame = self.world.sent_frame(port);
                let frame = if frame.first() == Some(&b':') { with_crc(frame) } else { frame.to_vec() };
                self.master.overhears(port, &frame, start, now);
            }
            Notice::CanFrame { port, frame, start } => {
                self.master.overhears_frame(port, &frame, start, now);
            }
            Notice::Ordered { port, address, order } => self.master.ordered(port, address, &order, now),
            Notice::Garbled(port) => self.master.garbled(port, now),
            Notice::Alarm(_) | Notice::BridgeHears { .. } => {}
        }
        None
    }

    /// Sends the next request, or a fault of the host's line in place of it. The answer is the unit that a host who
    /// waits is waiting for.
    fn next_request(&mut self) -> Option<u8> {
        if self.asked >= self.plan.requests {
            return None;
        }
        self.asked += 1;
        let faulty = !self.plan.faults.is_empty() && self.random.chance(self.plan.fault_rate);
        let fault = faulty.then(|| self.random.pick(&self.plan.faults));
        if let Some(fault) = fault.filter(|fault| fault.place() == Place::Host) {
            let end = self.host_fault(fault);
            self.world.set_alarm(end.saturating_add(SILENCE + self.random.below(MILLIS)), NEXT);
            return None;
        }
        if let Some(fault) = fault {
            self.world.inject(fault);
        }
        if self.random.chance(self.plan.broadcast_rate) {
            let at = self.broadcast();
            self.world.set_alarm(at.saturating_add(self.random.below(300 * MICROS)), NEXT);
            return None;
        }
        let (unit, question) = self.next_question();
        let at = self.ask(unit, question);
        match self.plan.manner {
            Manner::Waits(patience) => {
                self.impatient = at.saturating_add(patience * MILLIS);
                return Some(unit);
            }
            Manner::Paces(pause) => self.world.set_alarm(at.saturating_add(pause * MICROS), NEXT),
            Manner::Streams(longest) => {
                let pause = self.random.between(1, longest) * MICROS;
                self.world.set_alarm(at.saturating_add(pause), NEXT);
            }
        }
        None
    }

    /// A question that is not open yet.
    fn next_question(&mut self) -> (u8, Question) {
        loop {
            let (unit, question) = self.questions.pick();
            if !self.master.is_open(unit, &question) {
                return (unit, question);
            }
        }
    }

    /// Every request is answered, or counted: exactly.
    fn account(&mut self) {
        let ports = self.plan.settings.board.description.ports();
        let counters: Vec<_> = ports.map(|port| self.world.engine().counters(port)).collect();
        let sum = |what: fn(&Counters) -> u32| {
            counters.iter().map(|counters| u64::from(what(counters))).sum::<u64>()
        };
        let (expired, timeouts) = (sum(|it| it.expired), sum(|it| it.timeouts));
        let (retries, refused) = (sum(|it| it.retries), sum(|it| it.refused));
        let counted = expired + timeouts + refused - retries;
        let tally = &mut self.master.tally;
        // what was relayed by coincidence is an answer to the bridge
        let unanswered = tally.silent + tally.refused + tally.unknown + tally.copies[0]
            - tally.copies[1]
            - tally.coincidences;
        let now = self.world.now();
        if tally.asked != tally.answered + tally.silent + tally.refused || counted != unanswered {
            let told = tally.clone();
            let ports: Vec<_> =
                counters.iter().map(|counters| format!("{:?}", counters.in_order())).collect();
            tally.violation(now, || {
                format!(
                    "the account is not even: asked {}, answered {}, refused {}, silent {}, unknown units {}; \
                     the bridge counted {refused} refused, {expired} expired, {timeouts} timeouts, {retries} retries: {}",
                    told.asked, told.answered, told.refused, told.silent, told.unknown, ports.join("; "),
                )
            });
        }
    }
}
