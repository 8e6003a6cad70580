//! A host that asks, faults that come, and what was counted in the end.

use super::delay::Delay;
use super::fault::{Fault, Place};
use super::framing::with_crc;
use super::master::{Master, is_nst};
use super::moment::{MICROS, MILLIS, Moment, Nanos};
use super::question::{Question, Questions};
use super::random::Random;
use super::settings::Settings;
use super::station::{flip_bits, reseal};
use super::tally::Tally;
use super::world::{Notice, World};
use jointbus_mcu_bridge::board::{Protocol, Target, Topology};
use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, RS485_A, RS485_B};
use jointbus_mcu_bridge::engine::Counters;
use jointbus_mcu_bridge::io::serial::UartBuffers;
use jointbus_protocol::decode::STRAY_MAX;
use jointbus_protocol::modbus::{self, AddressRange, rtu};
use jointbus_protocol::nst::serial::encode_request;
use jointbus_protocol::{checksum, nst};

/// Silence that ends a burst, and one that certainly does.
const BURST_ENDS: Nanos = 20 * MILLIS;
const SILENCE: Nanos = 21 * MILLIS;

/// Alarm for the next request.
const NEXT: u64 = u64::MAX;

/// Whether the host waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Manner {
    /// For each answer, for so many milliseconds at most; an answer may well come later.
    Waits(u64),
    /// For nothing: requests come one to so many microseconds apart.
    Streams(u64),
    /// For nothing: a request comes each so many microseconds.
    Paces(u64),
}

/// What a run does.
#[derive(Debug, Clone)]
pub struct Plan {
    /// What is simulated.
    pub settings: Settings,
    /// RequestFraming to be asked.
    pub requests: u64,
    /// Whether the host waits.
    pub manner: Manner,
    /// Kinds of fault that come.
    pub faults: Vec<Fault>,
    /// Chance of a fault before each request, in a million.
    pub fault_rate: u64,
    /// So many requests in a million are broadcasts.
    pub broadcast_rate: u64,
}

impl Plan {
    /// The plan of a seed: everything from calm to rough, with all kinds of fault unless they are given.
    #[must_use]
    pub fn of_seed(seed: u64, requests: u64, kinds: Option<&[Fault]>) -> Self {
        let mut random = Random::new(seed ^ 0x5EED);
        let mut settings = Settings::new(seed);
        let delay = |random: &mut Random| match random.below(3) {
            0 => Delay::PROMPT,
            1 => Delay::Moody(200 * MICROS, 20_000),
            _ => Delay::Moody(random.between(100, 5000) * MICROS, 50_000),
        };
        settings.sensor_delay = delay(&mut random);
        settings.node_delay = delay(&mut random);
        if random.below(2) == 0 {
            settings.station_delay = Delay::Moody(2 * MILLIS, 20_000);
        }
        // some ports hear themselves
        for port in [RS485_A, RS485_B] {
            settings.network.ports[port.index()].echo = random.chance(300_000);
        }
        // and some stations speak Modbus ASCII
        if random.chance(250_000) {
            let rows = settings.network.routes.iter_mut();
            rows.filter(|row| row.target == Target::Bus(RS485_B))
                .for_each(|row| row.protocol = Protocol::ModbusAscii);
        }
        settings.latency = Delay::Uniform(2 * MICROS, random.pick(&[10, 30, 100]) * MICROS);
        let manner = match random.below(3) {
            0 => Manner::Waits(random.pick(&[60, 200, 10_000])),
            _ => Manner::Streams(random.pick(&[500, 3000, 20_000])),
        };
        let fault_rate = random.pick(&[3000, 20_000, 100_000]);
        let faults = kinds.unwrap_or(Fault::ALL).to_vec();
        Self { settings, requests, manner, faults, fault_rate, broadcast_rate: 20_000 }
    }

    /// The plan of a seed in which most bursts of the host are broken frames with a valid command in their data, or
    /// broadcasts behind stray bytes.
    #[must_use]
    pub fn hiding(seed: u64, requests: u64) -> Self {
        const HIDING: [Fault; 5] = [
            Fault::HostHiddenCommand,
            Fault::HostHiddenCommand,
            Fault::HostHiddenBehind,
            Fault::HostHiddenBehind,
            Fault::HostStrayBroadcast,
        ];
        Self { fault_rate: 900_000, ..Self::of_seed(seed, requests, Some(&HIDING)) }
    }

    /// Carries the plan out.
    #[must_use]
    pub fn run(self) -> Tally {
        let mut queues = [UartBuffers::new(), UartBuffers::new(), UartBuffers::new()];
        let mut run = Run::new(self, &mut queues);
        run.to_the_end();
        run.master.tally
    }
}

/// A run.
pub struct Run<'q> {
    /// What is simulated.
    pub world: World<'q>,
    /// The host.
    pub master: Master,
    /// What it asks.
    pub questions: Questions,
    network: Topology,
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
    /// A run at its beginning.
    #[must_use]
    pub fn new(plan: Plan, queues: &'q mut [UartBuffers; 3]) -> Self {
        let mut random = Random::new(plan.settings.seed ^ 0xA5C);
        let network = plan.settings.network;
        Self {
            world: World::new(plan.settings.clone(), queues),
            master: Master::new(&network),
            questions: Questions::new(&network, plan.settings.sensors, plan.settings.nodes, random.fork()),
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
            self.master.broadcast(&question, &[RS485_A, CAN], end.saturating_add(BURST_ENDS));
            return self.silent;
        }
        self.master.broadcast(&question, &[RS485_B], end);
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
            Notice::CanFrame { frame, start } => self.master.overhears_frame(&frame, start, now),
            Notice::Ordered { port, address, order } => self.master.ordered(port, address, &order, now),
            Notice::Garbled(port) => self.master.garbled(port, now),
            Notice::Alarm(_) | Notice::BridgeHears(_) => {}
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
            let (unit, question) = self.questions.next(&self.network);
            if !self.master.is_open(unit, &question) {
                return (unit, question);
            }
        }
    }

    /// One whose frame ends without silence.
    fn plain_question(&mut self) -> (u8, Question) {
        loop {
            let (unit, question) = self.next_question();
            if !question.ends_with_silence() {
                return (unit, question);
            }
        }
    }

    /// Brings a fault of the host's line about; when its last byte ends.
    pub fn host_fault(&mut self, fault: Fault) -> Moment {
        let (unit, question) = self.plain_question();
        let frame = question.frame(unit);
        let cut = 1 + self.random.index(frame.len() - 1);
        match fault {
            Fault::HostShortPause => {
                self.world.host_sends(&frame[..cut]);
                self.world.host_pauses(self.random.between(1, 15) * MILLIS);
                let at = self.world.host_sends(&frame[cut..]);
                self.master.ask(unit, question, at);
                at
            }
            Fault::HostGlued => {
                let at = self.world.host_sends(&frame);
                self.master.ask(unit, question, at);
                let (unit, question) = self.plain_question();
                self.ask(unit, question)
            }
            Fault::HostStrayBytes => {
                let bytes = self.harmless(
                    |run| {
                        let stray = 1 + run.random.index(STRAY_MAX);
                        let stray: Vec<u8> = (0..stray).map(|_| run.random.byte()).collect();
                        [&stray[..], &frame].concat()
                    },
                    &frame,
                );
                let at = self.world.host_sends(&bytes);
                // taken when the line has been silent
                self.master.ask(unit, question, at.saturating_add(BURST_ENDS));
                at
            }
            Fault::HostLongPause => {
                let bytes = self.harmless(|_| frame[cut..].to_vec(), &[]);
                self.spoilt(&frame[..cut]);
                self.world.host_pauses(SILENCE + MILLIS);
                self.spoilt(&bytes)
            }
            Fault::HostFraming => {
                let bytes = self.harmless(
                    |run| {
                        let mut bytes = frame.clone();
                        bytes[cut] ^= 1 + run.random.below(255) as u8;
                        bytes
                    },
                    &[],
                );
                self.spoilt(&bytes[..cut]);
                self.world.host_sends_unframed(bytes[cut]);
                self.world.host_sends(&bytes[cut + 1..])
            }
            // their CRC is right, and nobody takes them for all that
            Fault::HostUnknownUnit | Fault::HostUnknownFunction => {
                let bytes = self.broken(fault, &frame);
                self.spoilt(&bytes)
            }
            Fault::HostHiddenCommand | Fault::HostHiddenBehind | Fault::HostStrayBroadcast => {
                self.master.tally.hidden += 1;
                let bytes = self.harmless(|run| run.broken(fault, &frame), &[]);
                self.spoilt(&bytes)
            }
            _ => {
                let bytes = self.harmless(|run| run.broken(fault, &frame), &[]);
                self.spoilt(&bytes)
            }
        }
    }

    /// Sends bytes in which there is no request.
    fn spoilt(&mut self, bytes: &[u8]) -> Moment {
        let unit = bytes.first().copied().unwrap_or(0);
        let known = unit == 0 || unit == u8::MAX || self.network.route(unit).is_some();
        self.master.tally.unknown += u64::from(!known && !bytes.is_empty());
        self.world.host_sends(bytes)
    }

    /// Bytes in which no CRC is right by coincidence, except that of `meant` at the end and of what is hidden too deep.
    fn harmless(&mut self, mut make: impl FnMut(&mut Self) -> Vec<u8>, meant: &[u8]) -> Vec<u8> {
        let mut tries = 0;
        loop {
            tries += 1;
            let bytes = make(self);
            let coincidence = (0..=STRAY_MAX).any(|start| {
                let end_of = |end: usize| bytes.get(start..end).and_then(checksum::strip_crc).is_some();
                let is_meant = |end: usize| end == bytes.len() && bytes.get(start..) == Some(meant);
                // a broadcast behind stray bytes is right, and not to be taken
                let broadcast = start > 0 && bytes.get(start).is_some_and(|byte| [0, u8::MAX].contains(byte));
                !broadcast && (start + 4..=bytes.len()).any(|end| end_of(end) && !is_meant(end))
            });
            // some frames have a right CRC inside, whatever comes before them: their length byte says that it is none
            if !coincidence || tries > 100 {
                return bytes;
            }
        }
    }

    /// What a fault makes of a request.
    fn broken(&mut self, fault: Fault, frame: &[u8]) -> Vec<u8> {
        let mut bytes = frame.to_vec();
        let end = bytes.len() - 1;
        let mut noise = |least, most| -> Vec<u8> {
            (0..self.random.between(least, most)).map(|_| self.random.byte()).collect()
        };
        match fault {
            Fault::HostGarbage => bytes = noise(1, 300),
            Fault::HostOverlong => {
                bytes.truncate(2);
                bytes.extend(noise(260, 600));
            }
            Fault::HostCut => bytes.truncate(1 + self.random.index(end)),
            Fault::HostWrongCrc => bytes[end] ^= 1 << self.random.below(8),
            Fault::HostBits => flip_bits(&mut bytes, &mut self.random),
            Fault::HostUnknownUnit => {
                bytes[0] = 100 + self.random.below(100) as u8;
                reseal(&mut bytes);
            }
            Fault::HostUnknownFunction => {
                let unit = self.random.between(16, 20) as u8;
                let function = self.random.pick(&[0x00, 0x01, 0x04, 0x06, 0x11, 0x7F, 0x83]);
                bytes = vec![unit, function, 0, 0, 4, 0, 0];
                reseal(&mut bytes);
            }
            Fault::HostStrayBroadcast => {
                let stray = 1 + self.random.index(STRAY_MAX);
                bytes = (0..stray).map(|_| self.random.between(1, 254) as u8).collect();
                let unit = self.random.pick(&[0, u8::MAX]);
                bytes.extend(hidden_command(unit, &mut self.random));
            }
            Fault::HostHiddenCommand | Fault::HostHiddenBehind => {
                bytes = self.hiding(fault == Fault::HostHiddenBehind);
            }
            _ => {}
        }
        bytes
    }

    /// A write that is wrong, with a command in its data that is right.
    fn hiding(&mut self, behind: bool) -> Vec<u8> {
        let inner = self.random.pick(&[1, 3, 16, 18, 31, 32, 33, 40, 247]);
        let mut data: Vec<u8> = (0..self.random.below(8)).map(|_| self.random.byte()).collect();
        data.extend(hidden_command(inner, &mut self.random));
        if self.random.below(2) == 0 && !behind {
            data.extend((0..self.random.below(8)).map(|_| self.random.byte()));
        }
        if data.len() % 2 == 1 {
            data.insert(0, 0x33);
        }
        let mut buffer = [0; rtu::FRAME_MAX];
        let mut bytes = match self.random.below(2) {
            0 => {
                let request = nst::Request::Write { register: 0, data: &data };
                encode_request(17, &request, &mut buffer).unwrap_or(&[]).to_vec()
            }
            _ => {
                let range = AddressRange::new(0x60, (data.len() / 2) as u16);
                let request = modbus::Request::WriteMultipleRegisters { range, data: &data };
                rtu::encode_request(33, &request, &mut buffer).unwrap_or(&[]).to_vec()
            }
        };
        let end = bytes.len() - 1;
        if behind {
            // what follows the frame that the length byte tells is the command, up to the end
            bytes.truncate(end - 1);
            let length = if bytes[0] == 17 { 4 } else { 6 };
            bytes[length] = self.random.below(4) as u8 & !1;
        } else {
            bytes[end] ^= 0x40;
        }
        bytes
    }

    /// Every request is answered, or counted: exactly.
    fn account(&mut self) {
        let counters: Vec<_> = BOARD.ports().map(|port| self.world.engine().counters(port)).collect();
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

    /// Whether a unit speaks NST.
    #[must_use]
    pub fn is_nst(&self, unit: u8) -> bool {
        is_nst(&self.network, unit)
    }
}

/// A valid write of a number that nobody asked for.
fn hidden_command(unit: u8, random: &mut Random) -> Vec<u8> {
    let mut buffer = [0; rtu::FRAME_MAX];
    let token = 0xEE00_0000 | random.next() as u32 & 0x00FF_FFFF;
    let network = Topology::of(BOARD);
    if unit == u8::MAX || is_nst(&network, unit) {
        let request = nst::Request::Write { register: 0, data: &token.to_be_bytes() };
        encode_request(unit, &request, &mut buffer).unwrap_or(&[]).to_vec()
    } else {
        let request = modbus::Request::WriteMultipleRegisters {
            range: AddressRange::new(if unit == 247 { 0 } else { 0x60 }, 2),
            data: &token.to_be_bytes(),
        };
        rtu::encode_request(unit, &request, &mut buffer).unwrap_or(&[]).to_vec()
    }
}
