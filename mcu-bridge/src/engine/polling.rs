//! Slots in which the bridge reads sensors by itself, on time.

use super::framing::Framing;
use super::request::{Expected, Origin, Request};
use super::router::Routes;
use super::slab::Content;
use crate::board::{Port, Route, Target};
use crate::registers::SLOTS;
use jointbus_protocol::nst::{self, AXES, SAMPLE_LENGTH, Sample, SignEncoding, register, serial};
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::Writer;

/// A sample is stale after three periods without a new one, but not before this.
const STALE_AT_LEAST: Duration = Duration::from_millis(20);

/// The read that a slot sends: the six axes.
const READ: nst::Request<'static> = nst::Request::read(register::DATA.first, SAMPLE_LENGTH as u8);

/// What a slot has to say of its sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SlotState {
    /// Its period is 0.
    Off,
    /// No sample has come yet.
    Empty,
    /// The sample is new enough.
    Fresh,
    /// No sample for three periods, at least 20 ms.
    Stale,
}

impl SlotState {
    /// Its number in the register.
    #[must_use]
    pub const fn value(self) -> u16 {
        match self {
            Self::Off => 0,
            Self::Empty => 1,
            Self::Fresh => 2,
            Self::Stale => 3,
        }
    }
}

/// Where a slot is in its period.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Progress {
    /// Waits for the next period.
    #[default]
    Idle,
    /// Waits for its bus.
    Due,
    /// On its bus.
    InFlight,
    /// On its bus, and the next period has begun: it reads again as soon as this read is done.
    Behind,
}

impl Progress {
    const fn is_in_flight(self) -> bool {
        matches!(self, Self::InFlight | Self::Behind)
    }

    /// What comes after the read on the bus.
    const fn done(self) -> Self {
        match self {
            Self::Behind => Self::Due,
            _ => Self::Idle,
        }
    }
}

/// A polling slot.
#[derive(Debug, Clone, Copy)]
pub struct Slot {
    /// Unit that it reads, as the host sees it.
    pub unit: u8,
    /// Period in 100 us; 0 = off.
    pub period_100us: u16,
    /// Samples so far; wraps around.
    pub sequence: u32,
    /// When the last byte or frame of the newest sample came; 0 before the first.
    pub timestamp: Instant,
    /// The newest sample.
    pub sample: Sample,
    /// Periods that ended before the slot could read, because its bus, or its last read, was not done.
    pub missed: u32,
    /// Reads without an answer.
    pub failures: u32,
    progress: Progress,
    next: Instant,
}

impl Default for Slot {
    fn default() -> Self {
        Self::OFF
    }
}

impl Slot {
    /// A slot that reads nothing.
    pub const OFF: Self = Self {
        unit: 0,
        period_100us: 0,
        sequence: 0,
        timestamp: Instant::from_micros(0),
        sample: Sample([0; AXES]),
        missed: 0,
        failures: 0,
        progress: Progress::Idle,
        next: Instant::from_micros(0),
    };

    /// A slot that starts at once.
    pub(super) fn new(unit: u8, period_100us: u16, now: Instant) -> Self {
        Self { unit, period_100us, next: now, ..Self::default() }
    }

    const fn period(&self) -> Duration {
        Duration::from_micros((self.period_100us as u64).wrapping_mul(100))
    }

    /// A sample takes time: none comes in the microsecond in which the bridge starts.
    fn has_sample(&self) -> bool {
        self.timestamp > Instant::from_micros(0)
    }

    /// What it has to say.
    #[must_use]
    pub fn state(&self, now: Instant) -> SlotState {
        match (self.period_100us, self.has_sample()) {
            (0, _) => SlotState::Off,
            (_, false) => SlotState::Empty,
            _ if now.saturating_duration_since(self.timestamp)
                >= self.period().saturating_mul(3).max(STALE_AT_LEAST) =>
            {
                SlotState::Stale
            }
            _ => SlotState::Fresh,
        }
    }

    /// Notices the periods that have begun: without drift, and what was missed is not caught up.
    fn tick(&mut self, now: Instant) {
        let period = self.period();
        if period == Duration::ZERO || now < self.next {
            return;
        }
        // in 32 bits, which the processor divides by itself; what is later than 71 minutes is counted at the next look
        let since = u32::try_from(now.saturating_duration_since(self.next).as_micros()).unwrap_or(u32::MAX);
        let late = since.checked_div(u32::from(self.period_100us).wrapping_mul(100)).map_or(0, u64::from);
        self.next = self.next.saturating_add(period.saturating_mul(late.saturating_add(1)));
        // a read that comes late, but within its period, is none that was missed
        let (progress, ended) = match self.progress {
            Progress::Idle => (Progress::Due, 0),
            Progress::InFlight => (Progress::Behind, 0),
            waiting => (waiting, 1),
        };
        self.progress = progress;
        let missed = u32::try_from(late.saturating_add(ended)).unwrap_or(u32::MAX);
        self.missed = self.missed.wrapping_add(missed);
    }
}

/// All slots.
#[derive(Debug)]
pub(super) struct Polling {
    slots: [Slot; SLOTS],
    /// When the next period begins.
    next: Instant,
    /// Slots that wait for their bus, one bit each: mostly none, and then nobody has to look.
    due: u8,
}

const _: () = assert!(SLOTS <= u8::BITS as usize);

impl Polling {
    pub(super) const fn new() -> Self {
        Self { slots: [Slot::OFF; SLOTS], next: Instant::from_micros(0), due: 0 }
    }

    pub(super) fn slot(&self, index: usize) -> Option<&Slot> {
        self.slots.get(index)
    }

    /// Sets a slot anew; a read of the former one that is under way is then nobody's.
    pub(super) fn set(&mut self, index: usize, slot: Slot) {
        if let Some(place) = self.slots.get_mut(index) {
            *place = slot;
        }
        self.look();
    }

    /// Switches all slots off.
    pub(super) fn clear(&mut self) {
        self.slots.iter_mut().for_each(|slot| *slot = Slot::OFF);
        self.look();
    }

    pub(super) fn tick(&mut self, now: Instant) {
        if now >= self.next {
            self.slots.iter_mut().for_each(|slot| slot.tick(now));
            self.look();
        }
    }

    /// Sees what is due, and when something is next.
    fn look(&mut self) {
        (self.next, self.due) = (Instant::MAX, 0);
        for (index, slot) in (0..).zip(&self.slots) {
            if slot.period_100us > 0 {
                self.next = self.next.min(slot.next);
            }
            if slot.progress == Progress::Due {
                self.due |= 1u8.wrapping_shl(index);
            }
        }
    }

    /// When the next period begins.
    pub(super) const fn deadline(&self) -> Instant {
        self.next
    }

    /// The read of the slot that is due on a bus and began its period first, if nothing holds it back.
    pub(super) fn next(
        &mut self,
        port: Port,
        routes: Routes<'_>,
        now: Instant,
        held: impl Fn(&Request) -> bool,
    ) -> Option<Request> {
        if self.due == 0 {
            return None;
        }
        let mut due: Option<(u8, Instant, Request)> = None;
        for (index, slot) in (0..).zip(&self.slots).filter(|(_, slot)| slot.progress == Progress::Due) {
            let began = slot.next;
            if due.as_ref().is_some_and(|(_, earliest, _)| *earliest <= began) {
                continue;
            }
            let route = routes
                .find(slot.unit)
                .filter(|(_, route)| route.target == Target::Bus(port) && route.protocol.is_nst())
                .map(|(number, route)| request(slot.unit, index, number, route, now));
            if let Some(request) = route.filter(|request| !held(request)) {
                due = Some((index, began, request));
            }
        }
        let (index, _, request) = due?;
        self.slots.get_mut(usize::from(index))?.progress = Progress::InFlight;
        self.look();
        Some(request)
    }

    /// A sample came; its last byte or frame at `now`.
    pub(super) fn answered(&mut self, index: usize, body: &[u8], now: Instant) {
        let Some(slot) = self.slots.get_mut(index).filter(|slot| slot.progress.is_in_flight()) else {
            return;
        };
        slot.progress = slot.progress.done();
        if let Some(data) = body.get(nst::RESPONSE_HEADER..).and_then(|data| data.first_chunk()) {
            slot.sample = Sample::decode(data, SignEncoding::TwosComplement);
            slot.timestamp = now;
            slot.sequence = slot.sequence.wrapping_add(1);
        }
        self.look();
    }

    /// A read had no answer, or was not sent.
    pub(super) fn failed(&mut self, index: usize) {
        if let Some(slot) = self.slots.get_mut(index).filter(|slot| slot.progress.is_in_flight()) {
            slot.progress = slot.progress.done();
            slot.failures = slot.failures.wrapping_add(1);
        }
        self.look();
    }
}

/// The read of a slot whose unit speaks NST.
fn request(unit: u8, index: u8, number: u8, route: &Route, now: Instant) -> Request {
    let expected = Expected::Nst(serial::ExpectedResponse::new(route.remote_of(unit), &READ));
    let function = nst::FunctionCode::Read.code();
    let request = Request::new(unit, function, Some(expected), (Some(number), route), now);
    // a repeated read would be late for this period and early for the next
    Request { origin: Origin::Slot(index), retries: 0, ..request }
}

/// Writes the bytes of a slot's read as they go onto its bus.
pub(super) fn read(request: &Request, content: &mut Content) {
    let mut buffer = [0; nst::COMMAND_LENGTH];
    let mut writer = Writer::new(&mut buffer);
    // the buffer has the length of a read
    let _ = READ.encode(&mut writer);
    let framing = if request.is_split { Framing::Body } else { Framing::WithCrc };
    framing.write(request.expected.map_or(0, |expected| expected.remote()), writer.finish(), content);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(micros: u64) -> Instant {
        Instant::from_micros(micros)
    }

    #[test]
    fn periods_do_not_drift_and_missed_ones_are_counted() {
        let mut slot = Slot::new(1, 10, at(0));
        slot.tick(at(3));
        assert_eq!((slot.progress, slot.next, slot.missed), (Progress::Due, at(1000), 0));
        slot.tick(at(999));
        slot.progress = Progress::Idle;
        slot.tick(at(1010));
        assert_eq!((slot.progress, slot.next, slot.missed), (Progress::Due, at(2000), 0));
        slot.tick(at(2000));
        assert_eq!((slot.next, slot.missed), (at(3000), 1), "it had no chance to read");
        slot.progress = Progress::Idle;
        slot.tick(at(6500));
        assert_eq!(
            (slot.progress, slot.next, slot.missed),
            (Progress::Due, at(7000), 4),
            "3 ms without a look"
        );
    }

    #[test]
    fn a_read_that_begins_late_within_its_period_is_not_missed() {
        let mut polling = Polling::new();
        polling.set(0, Slot { progress: Progress::InFlight, ..Slot::new(1, 10, at(1000)) });
        polling.tick(at(1000));
        polling.answered(0, &[], at(1300));
        assert_eq!(polling.slots[0].progress, Progress::Due, "the read of the period that has begun");
        polling.slots[0].progress = Progress::InFlight;
        polling.look();
        polling.tick(at(2000));
        polling.tick(at(3000));
        polling.failed(0);
        assert_eq!(
            (polling.slots[0].progress, polling.slots[0].missed),
            (Progress::Due, 1),
            "a whole period passed on the bus"
        );
    }

    #[test]
    fn states() {
        let mut slot = Slot::default();
        assert_eq!(slot.state(at(0)), SlotState::Off);
        slot = Slot::new(1, 10, at(0));
        assert_eq!(slot.state(at(1_000_000)), SlotState::Empty);
        slot.timestamp = at(1000);
        assert_eq!(slot.state(at(20_999)), SlotState::Fresh, "at least 20 ms");
        assert_eq!(slot.state(at(21_000)), SlotState::Stale);
        slot.period_100us = 100;
        assert_eq!(slot.state(at(30_999)), SlotState::Fresh);
        assert_eq!(slot.state(at(31_000)), SlotState::Stale);
    }
}
