//! What waits for a bus, in which order, and which replies its devices still owe.

use super::counters::count;
use super::host::FRAME_MAX;
use super::polling;
use super::quarantine::Admission;
use super::transaction::{Expected, Request, Span, Surroundings, Transaction};
use heapless::Vec;
use jointbus_protocol::checksum;
use jointbus_protocol::time::{Duration, Instant};

/// How many requests wait for a bus, beside the one in flight.
const QUEUE: usize = 4;

/// No further request can wait for the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct QueueFull;

/// The bytes of a request: on a serial bus the whole frame, for Modbus ASCII address and data unit, on CAN the body.
pub(super) type Content = Vec<u8, FRAME_MAX, u16>;

/// Where a [`BusQueue`] keeps the bytes of a request until it is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ContentIndex(u8);

impl ContentIndex {
    fn free(self, kept: &mut [Entry]) {
        if let Some(kept) = kept.get_mut(usize::from(self.0)) {
            kept.is_taken = false;
        }
    }
}

#[derive(Debug)]
struct Entry {
    is_taken: bool,
    content: Content,
}

impl Entry {
    const fn new() -> Self {
        Self { is_taken: false, content: Vec::new() }
    }
}

/// The requests of a bus, and the replies that its devices owe.
#[derive(Debug)]
pub(super) struct BusQueue {
    queue: Queue,
    /// One for each that waits, one for that in flight.
    kept: [Entry; QUEUE + 1],
    pub(super) owed: LateResponses,
    /// The reply that was taken last, while any are owed.
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
        // spelt out: a loop over them would build the whole engine on the stack and copy it
        let kept = [Entry::new(), Entry::new(), Entry::new(), Entry::new(), Entry::new()];
        Self { queue: Queue::new(), kept, owed: LateResponses::new(), last: None }
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
        let index = self.keep(write).ok_or(QueueFull)?;
        self.queue.0.push(Waiting { request: *request, index }).map_err(|_| QueueFull)
    }

    fn keep(&mut self, write: impl FnOnce(&mut Content)) -> Option<ContentIndex> {
        let (index, kept) = (0..).zip(&mut self.kept).find(|(_, kept)| !kept.is_taken)?;
        kept.is_taken = true;
        kept.content.clear();
        write(&mut kept.content);
        Some(ContentIndex(index))
    }

    /// The bytes of a request.
    #[inline(never)] // asked in many places
    pub(super) fn content(&self, index: ContentIndex) -> &[u8] {
        self.kept.get(usize::from(index.0)).map_or(&[], |kept| &kept.content)
    }

    /// The same, for data that is to be kept behind them.
    pub(super) fn content_mut(&mut self, index: ContentIndex) -> Option<&mut Content> {
        self.kept.get_mut(usize::from(index.0)).map(|kept| &mut kept.content)
    }

    /// A request is done.
    pub(super) fn free(&mut self, index: ContentIndex) {
        index.free(&mut self.kept);
    }

    /// The next request for the bus: the host's go before the bridge's own polling.
    pub(super) fn next(&mut self, now: Instant, cx: &mut Surroundings<'_>) -> Option<Transaction> {
        if self.owed.is_full() {
            return None;
        }
        if cx.host.output.has_room()
            && let Some(Waiting { request, index }) = self.queue.next(&self.owed, now)
        {
            cx.host.output.reserve();
            return Some(Transaction::new(request, index));
        }
        loop {
            let held = |request: &Request| self.owed.holds(request, now);
            let mut request = cx.polling.next(cx.bus, cx.routes, now, held)?;
            match cx.quarantine.admit(request.unit, false, cx.limits, now) {
                Admission::Normal => {}
                Admission::Probe => request.become_probe(cx.limits),
                Admission::Refused => {
                    // no longer due, so the next look finds another request or none
                    cx.fail(&request);
                    continue;
                }
            }
            let Some(index) = self.keep(|content| polling::read(&request, content)) else {
                // there is an index for each that waits and one more
                cx.fail(&request);
                return None;
            };
            return Some(Transaction::new(request, index));
        }
    }

    /// Drops the requests that can no longer be sent in time.
    pub(super) fn expire(&mut self, now: Instant, cx: &mut Surroundings<'_>) {
        let late = |waiting: &Waiting| now >= waiting.request.expires;
        while let Some(index) = self.queue.0.iter().position(late)
            && let Some(waiting) = self.queue.remove(index)
        {
            count(&mut cx.counters.expired);
            cx.fail(&waiting.request);
            waiting.index.free(&mut self.kept);
        }
    }

    /// When the next request or reply is given up.
    pub(super) fn deadline(&self) -> Instant {
        let expires =
            self.queue.0.iter().fold(Instant::MAX, |first, waiting| first.min(waiting.request.expires));
        self.owed.0.iter().fold(expires, |first, owed| first.min(owed.until))
    }

    /// A reply answers a request of which others are owed, or will be.
    pub(super) fn take(&mut self, remote: u8, content: &[u8], now: Instant) {
        self.last = Some(Taken { remote, crc: checksum::crc16(content), at: now });
    }

    /// An owed reply came. One to a probe may still show that its device is back. What is the same as the last one and
    /// ends no later than `copy` after it may be its copy, which nobody owes: the hold-off goes on.
    pub(super) fn settle(
        &mut self,
        index: usize,
        content: &[u8],
        copy: Duration,
        now: Instant,
        cx: &mut Surroundings<'_>,
    ) {
        let Some(remote) = self.owed.iter().nth(index).map(Expected::remote) else { return };
        let former = self.last;
        self.take(remote, content, now);
        let is_copy = former.zip(self.last).is_some_and(|(former, new)| {
            (former.remote, former.crc) == (new.remote, new.crc)
                && now.saturating_duration_since(former.at) <= copy
        });
        if !is_copy && let Some(unit) = self.owed.settle(index, now) {
            cx.quarantine.answered(unit);
        }
    }

    /// Drops everything.
    pub(super) fn clear(&mut self, cx: &mut Surroundings<'_>) {
        self.queue.0.iter().for_each(|waiting| cx.fail(&waiting.request));
        self.queue.0.clear();
        self.kept.iter_mut().for_each(|kept| kept.is_taken = false);
        self.owed = LateResponses::new();
    }
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    request: Request,
    index: ContentIndex,
}

/// RequestFraming that wait for a bus.
#[derive(Debug)]
struct Queue(Vec<Waiting, QUEUE>);

impl Queue {
    const fn new() -> Self {
        Self(Vec::new())
    }

    /// Takes out the next request: writes before reads of other units, in order for each unit, also behind one that
    /// is held because its unit owes a reply.
    fn next(&mut self, owed: &LateResponses, now: Instant) -> Option<Waiting> {
        let mut chosen = None;
        for (index, Waiting { request, .. }) in self.0.iter().enumerate() {
            let behind = self.0.iter().take(index).any(|earlier| earlier.request.unit == request.unit);
            if behind || owed.holds(request, now) {
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

    #[inline(never)] // in several places
    fn remove(&mut self, index: usize) -> Option<Waiting> {
        let waiting = self.0.get(index).copied();
        // `remove` would bring `memmove` into the image
        let mut indices = 0..;
        self.0.retain(|_| indices.next() != Some(index));
        waiting
    }
}

/// Replies of one kind that may still come.
#[derive(Debug, Clone, Copy)]
struct LateResponse {
    expected: Expected,
    replies: u8,
    until: Instant,
    /// The unit, which was probed and is out of quarantine if its reply comes longer than that before.
    unit: u8,
    probed: Option<Span>,
}

/// How many kinds of reply a bus can be owed; while that many are, it starts no transaction.
pub(super) const LATE_RESPONSES: usize = 4;

/// Replies that devices owe because they let an attempt time out. They number nothing, so until such a reply has come
/// or the hold-off has passed, it could be taken for the answer to a request like the one that it belongs to.
#[derive(Debug)]
pub(super) struct LateResponses(Vec<LateResponse, LATE_RESPONSES>);

impl LateResponses {
    const fn new() -> Self {
        Self(Vec::new())
    }

    /// So many attempts at a request timed out, the last of which was `sent` then.
    pub(super) fn add(&mut self, request: &Request, expected: Expected, replies: u8, sent: Instant) {
        if replies > 0 {
            let until = sent.saturating_add(request.late_response_window.into());
            let before = |window| until.saturating_duration_since(sent.saturating_add(window)).into();
            let probed = request.probe_window().map(before);
            // a transaction starts only while there is room, and adds at most once
            let _ = self.0.push(LateResponse { expected, replies, until, unit: request.unit, probed });
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Whether no further timeout could be remembered.
    pub(super) fn is_full(&self) -> bool {
        self.0.is_full()
    }

    /// Forgets replies that are not to be expected any more; tells whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        if before > 0 {
            self.keep_from(now);
        }
        self.0.len() < before
    }

    /// Keeps what has replies left, and is not forgotten by then.
    #[inline(never)] // in several places
    fn keep_from(&mut self, now: Instant) {
        self.0.retain(|owed| owed.replies > 0 && now < owed.until);
    }

    /// Whether a request would have to wait for one.
    pub(super) fn holds(&self, request: &Request, now: Instant) -> bool {
        request.expected.is_some_and(|asked| {
            let could_answer = |owed: &Expected| match request.is_split {
                true => owed.could_answer_part(&asked),
                false => owed.could_answer(&asked),
            };
            self.0.iter().any(|owed| now < owed.until && could_answer(&owed.expected))
        })
    }

    /// A reply came, late. A unit that was probed, and that would have been in time but for that.
    fn settle(&mut self, index: usize, now: Instant) -> Option<u8> {
        let owed = self.0.get_mut(index)?;
        owed.replies = owed.replies.saturating_sub(1);
        let left = owed.until.saturating_duration_since(now);
        let back = owed.probed.filter(|before| left > (*before).into()).map(|_| owed.unit);
        self.keep_from(Instant::default());
        back
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Expected> {
        self.0.iter().map(|owed| &owed.expected)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::config::{Limits, Topology};
    use jointbus_protocol::nst;

    fn request(unit: u8, function: nst::FunctionCode) -> Request {
        let network = Topology::default();
        let (number, route) = network.route(16).unwrap();
        let asked = nst::Request::Command { function, register: 0, length: 1 };
        let expected = Expected::Nst(nst::serial::ExpectedResponse::new(unit, &asked));
        let start = Instant::from_micros(0);
        Request::new(unit, function.code(), Some(expected), (Some(number), route), start)
    }

    fn order(queue: &mut Queue, owed: &LateResponses) -> std::vec::Vec<(u8, u8)> {
        let now = Instant::from_micros(0);
        std::iter::from_fn(|| queue.next(owed, now))
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
        assert_eq!(order(&mut queue, &LateResponses::new()), expected);
    }

    #[test]
    fn a_held_request_holds_its_unit_and_no_other() {
        let mut queue = Queue::new();
        for (unit, function) in [(1, READ), (1, ZERO), (2, READ)] {
            push(&mut queue, unit, function).unwrap();
        }
        let mut owed = LateResponses::new();
        let owing = Request { late_response_window: Duration::from_micros(10).into(), ..request(1, READ) };
        owed.add(&owing, owing.expected.unwrap(), 1, Instant::from_micros(0));
        assert_eq!(order(&mut queue, &owed), [(2, 3)]);
        assert!(!owed.expire(Instant::from_micros(9)));
        assert!(owed.expire(Instant::from_micros(10)));
        assert_eq!(order(&mut queue, &owed), [(1, 3), (1, 0x12)]);
    }

    #[test]
    fn a_probe_waits_a_part_of_the_period_and_its_reply_counts_as_long_as_any() {
        let limits = Limits::default();
        let mut probe = request(1, ZERO);
        assert_eq!((probe.timeout.into(), probe.probe_window()), (Duration::from_millis(500), None));
        probe.become_probe(&limits);
        assert_eq!((probe.timeout.into(), probe.retries), (Duration::from_millis(50), 0));
        let at = |millis: u64| Instant::from_micros(millis * 1000);
        for (came, back) in [(499, Some(1)), (500, None)] {
            let mut owed = LateResponses::new();
            owed.add(&probe, probe.expected.unwrap(), 1, at(0));
            assert_eq!(owed.settle(0, at(came)), back);
        }
        let mut shorter = request(1, READ);
        shorter.become_probe(&Limits { probe_period_ms: 100, ..limits });
        assert_eq!(
            Duration::from(shorter.timeout),
            Duration::from_millis(20),
            "a device has some time for all that"
        );
    }
}
