//! The bridge's own polling.

use super::Found;
use crate::sim::boards::SimBoard;
use crate::sim::delay::Delay;
use crate::sim::fault::Fault;
use crate::sim::moment::{MICROS, MILLIS, Moment, Nanos};
use crate::sim::plan::{Manner, Plan};
use crate::sim::run::Run;
use crate::sim::settings::Settings;
use crate::sim::world::Notice;
use jointbus::devices::motion::spelt_moment;
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::engine::Slot;
use jointbus_mcu_bridge::io::serial::UartBuffers;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::modbus::{self, AddressRange, rtu};
use jointbus_protocol::nst::SAMPLE_LENGTH;
use jointbus_protocol::nst::can::{FrameType, Identifier};
use std::collections::VecDeque;
use std::panic::resume_unwind;
use std::thread;

/// Unit of the bridge itself, its register of the first polling slot, and what is written there: unit 1, each ms.
const BRIDGE: u8 = 247;
const FIRST_SLOT: u16 = 0x50;
const VALUES: [u8; 4] = [0, POLLED, 0, 10];
const POLLED: u8 = 1;
const PERIOD: Nanos = MILLIS;

/// A stamp is so close to the end of the reply's last frame.
const STAMP: Nanos = 10 * MICROS;

/// What happens beside the polling.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Traffic {
    /// The host asks all units, the CAN bus included, with room between its requests.
    Calm,
    /// The host asks without mercy, and everything fails that can.
    Rough,
}

/// On a board whose first unit is a sensor on CAN at 1 Mbit/s, that is polled with 1000 Hz beside host traffic: each period has a sample, a counted failure,
/// or is counted as missed; where nothing fails none is missed. No sample is torn, and each is stamped with the end of
/// its reply's last frame.
#[must_use]
pub fn polling_is_on_time(board: SimBoard, seed: u64, span: Nanos, traffic: Traffic) -> Found {
    let mut queues = board.queues();
    let mut course = Course::new(plan(board, seed, traffic), &mut queues);
    let mut found = Found::default();
    if !course.begin() {
        found.violation(format!("cargo xtask soak --seed {seed}: the slot was not set"));
        return found;
    }
    let end = course.run.world.now().saturating_add(span);
    course.run.start();
    while let Some(notice) = course.run.next(end) {
        course.notice(&notice, &mut found);
    }
    course.come_to_rest(&mut found);
    let slot = course.slot();
    let tally = &course.run.master.tally;
    let quiet = slot.missed == 0 && slot.failures == 0;
    if traffic == Traffic::Calm && !quiet {
        found.violation(format!(
            "cargo xtask soak --seed {seed}: {} missed, {} failed",
            slot.missed, slot.failures
        ));
    }
    if traffic == Traffic::Rough && (quiet || slot.sequence == 0) {
        found.violation(format!("cargo xtask soak --seed {seed}: nothing failed"));
    }
    if let Some(first) = tally.violations.first() {
        found.violation(format!("cargo xtask soak --seed {seed}: {first}"));
    }
    found.count("periods", course.periods());
    found.count("samples", slot.sequence.into());
    found.count("missed", slot.missed.into());
    found.count("failed", slot.failures.into());
    found.count("stamps compared", course.compared);
    found.count("host requests", tally.asked);
    found.count("answered", tally.answered);
    found
}

/// Both at once: what is calm, and what is rough.
#[must_use]
pub fn polling_both(board: SimBoard, seed: u64, span: Nanos) -> [Found; 2] {
    thread::scope(|scope| {
        let calm = scope.spawn(|| polling_is_on_time(board, seed, span, Traffic::Calm));
        let rough = polling_is_on_time(board, seed, span, Traffic::Rough);
        [calm.join().unwrap_or_else(|panic| resume_unwind(panic)), rough]
    })
}

fn plan(board: SimBoard, seed: u64, traffic: Traffic) -> Plan {
    let mut settings = Settings::new(board, seed);
    settings.node_delay = Delay::Uniform(50 * MICROS, 200 * MICROS);
    let calm = Plan {
        settings,
        requests: u64::MAX,
        manner: Manner::Paces(5000),
        faults: Vec::new(),
        fault_rate: 0,
        broadcast_rate: 0,
    };
    match traffic {
        Traffic::Calm => calm,
        Traffic::Rough => Plan {
            manner: Manner::Streams(20_000),
            faults: Fault::ALL.to_vec(),
            fault_rate: 20_000,
            broadcast_rate: 20_000,
            ..calm
        },
    }
}

struct Course<'q> {
    run: Run<'q>,
    /// The bus of the polled sensor, and its node there.
    polled: (Port, u8),
    /// When the first period began.
    begun: Moment,
    sequence: u32,
    /// When transfers of the polled sensor ended.
    ends: VecDeque<Moment>,
    compared: u64,
}

impl<'q> Course<'q> {
    fn new(plan: Plan, queues: &'q mut [UartBuffers]) -> Self {
        let route = plan.settings.network.route(POLLED).map(|(_, route)| *route);
        let polled = route.and_then(|route| Some((route.target.port()?, route.remote_of(POLLED))));
        let mut run = Run::new(plan, queues);
        run.master.polls = true;
        // what takes one transfer, and less than half a period
        run.questions.longest = 19;
        // what the bridge itself reads
        run.questions.shortest_sample = SAMPLE_LENGTH as u8 + 1;
        let polled = polled.unwrap_or((Port::HOST, 0));
        Self { run, polled, begun: Moment::default(), sequence: 0, ends: VecDeque::new(), compared: 0 }
    }

    /// Sets the slot; whether the bridge says so.
    fn begin(&mut self) -> bool {
        let range = AddressRange::new(FIRST_SLOT, 2);
        let request = modbus::Request::WriteMultipleRegisters { range, data: &VALUES };
        let mut buffer = [0; rtu::FRAME_MAX];
        let end =
            self.run.world.host_sends(rtu::encode_request(BRIDGE, &request, &mut buffer).unwrap_or(&[]));
        let mut heard = 0;
        while let Some(notice) = self.run.world.next(end.saturating_add(PERIOD / 2)) {
            heard += u32::from(matches!(notice, Notice::HostHears(_)));
        }
        // the bridge takes the request, and begins, when its main loop has noticed the last byte
        self.begun = end;
        heard == 8
    }

    fn slot(&self) -> Slot {
        self.run.world.engine().slot(0).copied().unwrap_or_default()
    }

    /// Periods that have begun.
    fn periods(&self) -> u64 {
        self.run.world.now().saturating_duration_since(self.begun) / PERIOD + 1
    }

    fn notice(&mut self, notice: &Notice, found: &mut Found) {
        let Notice::BridgeHears { port, frame } = notice else { return };
        if *port != self.polled.0 || !ends_transfer_of(frame, self.polled.1) {
            return;
        }
        // what came with the transfer before this one
        self.look(found);
        let now = self.run.world.now();
        self.ends.push_back(now);
        while self.ends.len() > 64 {
            self.ends.pop_front();
        }
    }

    /// Looks at the newest sample.
    fn look(&mut self, found: &mut Found) {
        let slot = self.slot();
        if slot.sequence == self.sequence {
            return;
        }
        if slot.sequence != self.sequence + 1 {
            found.violation(format!("cargo xtask soak: sample {} follows {}", slot.sequence, self.sequence));
        }
        self.sequence = slot.sequence;
        self.compared += 1;
        let stamp = Moment::of(slot.timestamp);
        match spelt_moment(&slot.sample).map(Moment::of) {
            None => found.violation(format!("cargo xtask soak: sample {} is torn", slot.sequence)),
            Some(measured) if measured > stamp => {
                found.violation(format!(
                    "cargo xtask soak: sample {} is stamped before it was measured",
                    slot.sequence
                ));
            }
            Some(_) => {}
        }
        let near = |end: &&Moment| {
            stamp.saturating_duration_since(**end) <= STAMP && end.saturating_duration_since(stamp) <= STAMP
        };
        if self.ends.iter().rev().find(near).is_none() {
            found.violation(format!(
                "cargo xtask soak: the stamp of sample {} is no frame's end",
                slot.sequence
            ));
        }
    }

    /// Goes on until no read is under way, and compares: each period has its sample, its failure, or was missed.
    fn come_to_rest(&mut self, found: &mut Found) {
        let end = self.run.world.now().saturating_add(2000 * MILLIS);
        let mut told = String::new();
        while self.run.world.now() < end {
            let until = self.run.world.now().saturating_add(50 * MICROS);
            while let Some(notice) = self.run.world.next(until) {
                self.notice(&notice, found);
                self.run.notice(&notice);
            }
            self.run.master.forget(self.run.world.now());
            let slot = self.slot();
            let counted = u64::from(slot.sequence) + u64::from(slot.missed) + u64::from(slot.failures);
            // the main loop begins a period up to a tick late
            let within = self.run.world.now().saturating_duration_since(self.begun) % PERIOD;
            if within > PERIOD / 4 && counted == self.periods() {
                return;
            }
            told = format!("{slot:?} after {} periods", self.periods());
        }
        found.violation(format!(
            "cargo xtask soak: some period is neither sampled nor counted, or twice: {told}"
        ));
    }
}

/// Whether a frame is the last one of a transfer of that node.
fn ends_transfer_of(frame: &Frame, node: u8) -> bool {
    let Id::Extended(raw) = frame.id() else { return false };
    let last = |identifier: &Identifier| {
        identifier.source == node && matches!(identifier.frame_type, FrameType::Single | FrameType::Last)
    };
    Identifier::from_raw(raw).is_some_and(|identifier| last(&identifier))
}
