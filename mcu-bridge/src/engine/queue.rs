//! What waits for a bus, and in which order.

use super::context::Context;
use super::counters::count;
use super::pending_late::PendingLate;
use super::polling;
use super::quarantine::Admission;
use super::request::{Expected, Request};
use super::slab::{Content, ContentIndex, Slab};
use heapless::Vec;
use jointbus_protocol::checksum;
use jointbus_protocol::time::{Duration, Instant};

/// How many requests wait for a bus, beside the one in flight.
const QUEUE: usize = 4;

/// No further request can wait for the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct QueueFull;

/// The requests of a bus, and the late responses that its devices may still send.
#[derive(Debug)]
pub(super) struct BusQueue {
    queue: Queue,
    /// One for each that waits, one for that in flight.
    slab: Slab<{ QUEUE + 1 }>,
    pub(super) late: PendingLate,
    /// The reply that was taken last, while late ones are waited for.
    last: Option<Taken>,
}

/// What tells a reply from another one, and when it ended.
#[derive(Debug, Clone, Copy)]
struct Taken {
    remote: u8,
    crc: u16,
    at: Instant,
}

impl BusQueue {
    pub(super) const fn new() -> Self {
        Self { queue: Queue::new(), slab: Slab::new(), late: PendingLate::new(), last: None }
    }

    /// Takes a request from the host, whose bytes `write` writes.
    pub(super) fn push(
        &mut self,
        request: &Request,
        write: impl FnOnce(&mut Content),
    ) -> Result<(), QueueFull> {
        if self.queue.0.is_full() {
            return Err(QueueFull);
        }
        let index = self.slab.insert(write).ok_or(QueueFull)?;
        self.queue.0.push(Waiting { request: *request, index }).map_err(|_| QueueFull)
    }

    /// The bytes of a request.
    pub(super) fn content(&self, index: ContentIndex) -> &[u8] {
        self.slab.get(index)
    }

    /// The same, for data that is to be kept behind them.
    pub(super) fn content_mut(&mut self, index: ContentIndex) -> Option<&mut Content> {
        self.slab.get_mut(index)
    }

    /// A request is done.
    pub(super) fn free(&mut self, index: ContentIndex) {
        self.slab.remove(index);
    }

    /// The next request for the bus: the host's go before the bridge's own polling.
    pub(super) fn next(&mut self, now: Instant, cx: &mut Context<'_>) -> Option<(Request, ContentIndex)> {
        if self.late.is_full() {
            return None;
        }
        if cx.host.output.has_room()
            && let Some(Waiting { request, index }) = self.queue.next(&self.late, now)
        {
            cx.host.output.reserve();
            return Some((request, index));
        }
        loop {
            let held = |request: &Request| self.late.holds(request, now);
            let mut request = cx.polling.next(cx.port, cx.routes, now, held)?;
            match cx.quarantine.admit(request.unit, false, cx.limits, now) {
                Admission::Normal => {}
                Admission::Probe => request.become_probe(cx.limits),
                Admission::Refused => {
                    // no longer due, so the next look finds another request or none
                    cx.fail(&request);
                    continue;
                }
            }
            let Some(index) = self.slab.insert(|content| polling::read(&request, content)) else {
                // there is an index for each that waits and one more
                cx.fail(&request);
                return None;
            };
            return Some((request, index));
        }
    }

    /// Drops the requests that can no longer be sent in time.
    pub(super) fn expire(&mut self, now: Instant, cx: &mut Context<'_>) {
        let late = |waiting: &Waiting| now >= waiting.request.expires;
        while let Some(index) = self.queue.0.iter().position(late)
            && let Some(waiting) = self.queue.remove(index)
        {
            count(&mut cx.counters.expired);
            cx.fail(&waiting.request);
            self.slab.remove(waiting.index);
        }
    }

    /// When the next request or reply is given up.
    pub(super) fn deadline(&self) -> Instant {
        let expires =
            self.queue.0.iter().fold(Instant::MAX, |first, waiting| first.min(waiting.request.expires));
        expires.min(self.late.deadline())
    }

    /// Remembers a response while late ones to the same device are waited for, or will be.
    pub(super) fn take(&mut self, remote: u8, content: &[u8], now: Instant) {
        self.last = Some(Taken { remote, crc: checksum::crc16(content), at: now });
    }

    /// Takes a late response. One to a probe may still show that its device is back. What is the same as the last
    /// response and ends no later than `copy` after it may be its copy, to no attempt: the wait goes on.
    pub(super) fn settle(
        &mut self,
        index: usize,
        content: &[u8],
        copy: Duration,
        now: Instant,
        cx: &mut Context<'_>,
    ) {
        let Some(remote) = self.late.iter().nth(index).map(Expected::remote) else { return };
        let former = self.last;
        self.take(remote, content, now);
        let is_copy = former.zip(self.last).is_some_and(|(former, new)| {
            (former.remote, former.crc) == (new.remote, new.crc)
                && now.saturating_duration_since(former.at) <= copy
        });
        if !is_copy && let Some(unit) = self.late.settle(index, now) {
            cx.quarantine.answered(unit);
        }
    }

    /// Drops everything.
    pub(super) fn clear(&mut self, cx: &mut Context<'_>) {
        self.queue.0.iter().for_each(|waiting| cx.fail(&waiting.request));
        self.queue.0.clear();
        self.slab.clear();
        self.late = PendingLate::new();
    }
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    request: Request,
    index: ContentIndex,
}

/// Requests that wait for a bus.
#[derive(Debug)]
struct Queue(Vec<Waiting, QUEUE>);

impl Queue {
    const fn new() -> Self {
        Self(Vec::new())
    }

    /// Takes out the next request: writes before reads of other units, in order for each unit, also behind one that
    /// is held because of a late response.
    fn next(&mut self, late: &PendingLate, now: Instant) -> Option<Waiting> {
        let mut chosen = None;
        for (index, Waiting { request, .. }) in self.0.iter().enumerate() {
            let behind = self.0.iter().take(index).any(|earlier| earlier.request.unit == request.unit);
            if behind || late.holds(request, now) {
                continue;
            }
            if !request.is_read() {
                chosen = Some(index);
                break;
            }
            chosen = chosen.or(Some(index));
        }
        self.remove(chosen?)
    }

    fn remove(&mut self, index: usize) -> Option<Waiting> {
        (index < self.0.len()).then(|| self.0.remove(index))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::{Limits, Topology};
    use crate::boards::stm32f405::BOARD;
    use crate::engine::request::Expected;
    use jointbus_protocol::nst;

    fn request(unit: u8, function: nst::FunctionCode) -> Request {
        let network = Topology::of(BOARD);
        let (number, route) = network.route(16).unwrap();
        let asked = nst::Request::Command { function, register: 0, length: 1 };
        let expected = Expected::Nst(nst::serial::ExpectedResponse::new(unit, &asked));
        let start = Instant::from_micros(0);
        Request::new(unit, function.code(), Some(expected), (Some(number), route), start)
    }

    fn order(queue: &mut Queue, late: &PendingLate) -> std::vec::Vec<(u8, u8)> {
        let now = Instant::from_micros(0);
        std::iter::from_fn(|| queue.next(late, now))
            .map(|it| (it.request.unit, it.request.function))
            .collect()
    }

    fn push(queue: &mut Queue, unit: u8, function: nst::FunctionCode) -> Result<(), Waiting> {
        queue.0.push(Waiting { request: request(unit, function), index: ContentIndex(0) })
    }

    const READ: nst::FunctionCode = nst::FunctionCode::Read;
    const ZERO: nst::FunctionCode = nst::FunctionCode::SetZero;

    #[test]
    fn writes_go_first_and_units_keep_their_order() {
        let mut queue = Queue::new();
        for (unit, function) in [(1, READ), (1, ZERO), (2, READ), (3, ZERO)] {
            push(&mut queue, unit, function).unwrap();
        }
        assert!(push(&mut queue, 4, READ).is_err(), "four can wait");
        let expected = [(3, 0x12), (1, 3), (1, 0x12), (2, 3)];
        assert_eq!(order(&mut queue, &PendingLate::new()), expected);
    }

    #[test]
    fn a_held_request_holds_its_unit_and_no_other() {
        let mut queue = Queue::new();
        for (unit, function) in [(1, READ), (1, ZERO), (2, READ)] {
            push(&mut queue, unit, function).unwrap();
        }
        let mut late = PendingLate::new();
        let waiting = Request { late_response_window: Duration::from_micros(10), ..request(1, READ) };
        late.add(&waiting, waiting.expected.unwrap(), 1, Instant::from_micros(0));
        assert_eq!(order(&mut queue, &late), [(2, 3)]);
        assert!(!late.expire(Instant::from_micros(9)));
        assert!(late.expire(Instant::from_micros(10)));
        assert_eq!(order(&mut queue, &late), [(1, 3), (1, 0x12)]);
    }

    #[test]
    fn a_probe_waits_a_part_of_the_period_and_its_reply_counts_as_long_as_any() {
        let limits = Limits::default();
        let mut probe = request(1, ZERO);
        assert_eq!((probe.timeout, probe.probe_window()), (Duration::from_millis(500), None));
        probe.become_probe(&limits);
        assert_eq!((probe.timeout, probe.retries), (Duration::from_millis(50), 0));
        let at = |millis: u64| Instant::from_micros(millis * 1000);
        for (came, back) in [(499, Some(1)), (500, None)] {
            let mut late = PendingLate::new();
            late.add(&probe, probe.expected.unwrap(), 1, at(0));
            assert_eq!(late.settle(0, at(came)), back);
        }
        let mut shorter = request(1, READ);
        shorter.become_probe(&Limits { probe_period_ms: 100, ..limits });
        assert_eq!(shorter.timeout, Duration::from_millis(20), "a device has some time for all that");
    }
}
