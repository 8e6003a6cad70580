//! A request on its way over a bus: what it waits for, in which order, and who still owes a reply.

use super::config::{Bus, Limits, Network, PortConfig, ROUTES, Route};
use super::counters::{Counters, count};
use super::host::{FRAME_MAX, Output};
use super::polling::Polling;
use super::quarantine::{Admission, Quarantine};
use heapless::Vec;
use jointbus_protocol::deframe::Expectation;
use jointbus_protocol::modbus::{ExceptionCode, rtu};
use jointbus_protocol::nst::{self, can};
use jointbus_protocol::time::{Duration, Instant};

/// The reply that fits a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Expected {
    Modbus(rtu::ExpectedResponse),
    Nst(nst::serial::ExpectedReply),
}

impl Expected {
    pub(super) const fn remote(&self) -> u8 {
        match self {
            Self::Modbus(expected) => expected.unit(),
            Self::Nst(expected) => expected.address(),
        }
    }

    pub(super) const fn is_read(&self) -> bool {
        match self {
            Self::Modbus(expected) => expected.is_read(),
            Self::Nst(expected) => expected.function().is_read(),
        }
    }

    /// Whether a reply that `self` is owed could be taken for the reply to `request`: an exception fits every Modbus
    /// request of its function code.
    fn could_answer(&self, request: &Self) -> bool {
        match (self, request) {
            (Self::Modbus(owed), Self::Modbus(asked)) => {
                owed.unit() == asked.unit() && owed.function() == asked.function()
            }
            (Self::Nst(owed), Self::Nst(asked)) => owed == asked,
            _ => false,
        }
    }

    /// Whether it could be taken for the reply to a part of a request that CAN splits.
    fn could_answer_part(&self, request: &Self) -> bool {
        let (Self::Nst(owed), Self::Nst(asked)) = (self, request) else { return false };
        let longest = if asked.function().is_read() { can::READ_MAX } else { can::WRITE_MAX };
        let (owed_length, length) = (usize::from(owed.length()), usize::from(asked.length()));
        owed.address() == asked.address()
            && owed.function() == asked.function()
            && (owed_length == longest.min(length) || length.checked_rem(longest) == Some(owed_length))
    }

    pub(super) fn lengths(&self) -> [usize; 2] {
        match self {
            Self::Modbus(expected) => expected.lengths(),
            Self::Nst(expected) => {
                let [length] = expected.lengths();
                [length, 0]
            }
        }
    }

    pub(super) fn accepts(&self, frame: &[u8]) -> bool {
        match self {
            Self::Modbus(expected) => expected.accepts(frame),
            Self::Nst(expected) => expected.accepts(frame),
        }
    }

    /// Whether only silence ends the reply.
    pub(super) fn is_open(&self) -> bool {
        matches!(self, Self::Modbus(expected) if expected.is_open())
    }
}

/// Who wants the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    Host,
    /// A polling slot.
    Slot(usize),
}

/// A request for a bus.
#[derive(Debug, Clone)]
pub(super) struct Request {
    /// Who wants the answer.
    pub(super) origin: Origin,
    /// Unit that the host sees.
    pub(super) unit: u8,
    /// Number of its route; a broadcast has none.
    pub(super) route: Option<u8>,
    /// What answers it; nothing answers a broadcast.
    pub(super) expected: Option<Expected>,
    /// Function code.
    pub(super) function: u8,
    /// Time for the answer, without the time on the wire.
    pub(super) timeout: Duration,
    /// How long a reply is owed after a timeout.
    pub(super) hold_off: Duration,
    /// How often it may be sent again.
    pub(super) retries: u8,
    /// Whether what is too long goes in parts.
    pub(super) is_split: bool,
    /// When it is no longer to be sent.
    pub(super) expires: Instant,
    /// On a serial bus the whole frame, on CAN the body.
    pub(super) content: Vec<u8, FRAME_MAX>,
}

impl Request {
    pub(super) fn new(
        unit: u8,
        function: u8,
        expected: Option<Expected>,
        (route_number, route): (Option<u8>, &Route),
        content: &[u8],
        now: Instant,
    ) -> Option<Self> {
        let is_read = expected.is_some_and(|expected| expected.is_read());
        Some(Self {
            origin: Origin::Host,
            unit,
            route: route_number,
            expected,
            function,
            timeout: route.timeout(is_read),
            hold_off: route.hold_off(is_read),
            retries: if is_read { route.read_retries } else { 0 },
            is_split: route.bus == Bus::Can,
            expires: now.after(Duration::from_millis(route.time_to_live_ms.into())),
            content: Vec::from_slice(content).ok()?,
        })
    }

    fn is_read(&self) -> bool {
        self.expected.is_some_and(|expected| expected.is_read())
    }

    /// Tells the host that there is no answer: an exception, for NST silence.
    fn fail(&self, host: &mut HostSide<'_>, why: ExceptionCode) {
        if let Some(Expected::Modbus(_)) = self.expected {
            host.output.refuse(host.counters, self.unit, self.function, why);
        }
    }
}

/// Where replies go.
pub(super) struct HostSide<'a> {
    pub(super) output: &'a mut Output,
    pub(super) counters: &'a mut Counters,
}

/// How long the devices of a route took to answer.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ReplyTime {
    pub(super) last: Duration,
    pub(super) largest: Duration,
}

/// What a bus may touch beside itself.
pub(super) struct Surroundings<'a> {
    pub(super) host: HostSide<'a>,
    pub(super) port: &'a PortConfig,
    pub(super) counters: &'a mut Counters,
    pub(super) reply_times: &'a mut [ReplyTime; ROUTES],
    pub(super) quarantine: &'a mut Quarantine,
    pub(super) limits: &'a Limits,
    pub(super) network: &'a Network,
    pub(super) bus: Bus,
    pub(super) polling: &'a mut Polling,
}

impl Surroundings<'_> {
    /// The next request for the bus: the host's go before the bridge's own polling.
    pub(super) fn next(&mut self, queue: &mut Queue, owed: &OwedReplies, now: Instant) -> Option<Request> {
        if owed.is_full() {
            return None;
        }
        if self.host.output.has_room()
            && let Some(request) = queue.next(owed, now)
        {
            self.host.output.reserve();
            return Some(request);
        }
        loop {
            let request =
                self.polling.next(self.bus, self.network, now, |request| owed.holds(request, now))?;
            match self.quarantine.admit(request.unit, false, self.limits, now) {
                Admission::Normal | Admission::Probe => return Some(request),
                // no longer due, so the next look finds another slot or none
                Admission::Refused => self.fail(&request),
            }
        }
    }

    /// A transaction has ended.
    pub(super) fn release(&mut self, request: &Request) {
        if request.origin == Origin::Host {
            self.host.output.release();
        }
    }

    /// Hands the reply to a request, which ended at `now`, to who wants it.
    pub(super) fn answer(&mut self, request: &Request, content: &[u8], sent: Instant, now: Instant) {
        match request.origin {
            Origin::Host => self.host.output.relay(self.host.counters, request.unit, content),
            Origin::Slot(index) => self.polling.answered(index, content, now),
        }
        self.quarantine.answered(request.unit);
        let route = request.route.and_then(|number| self.reply_times.get_mut(usize::from(number)));
        if let Some(time) = route {
            time.last = now.since(sent);
            time.largest = time.largest.max(time.last);
        }
    }

    /// A request has no answer.
    pub(super) fn fail(&mut self, request: &Request) {
        match request.origin {
            Origin::Host => {
                request.fail(&mut self.host, ExceptionCode::GatewayTargetDeviceFailedToRespond);
            }
            Origin::Slot(index) => self.polling.failed(index),
        }
    }

    /// A request was sent, and nobody answered it.
    pub(super) fn give_up(&mut self, request: &Request, now: Instant) {
        self.quarantine.unanswered(request.unit, self.limits, now);
        self.fail(request);
    }
}

/// Requests that wait for a bus.
#[derive(Debug)]
pub(super) struct Queue(Vec<Request, QUEUE>);

/// No further request can wait for the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct QueueFull;

/// How many requests wait for a bus, beside the one in flight.
const QUEUE: usize = 4;

impl Queue {
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// Takes a request.
    pub(super) fn push(&mut self, request: Request) -> Result<(), QueueFull> {
        self.0.push(request).map_err(|_| QueueFull)
    }

    /// Takes out the next request: writes before reads of other units, in order for each unit, also behind one that
    /// is held because its unit owes a reply.
    pub(super) fn next(&mut self, owed: &OwedReplies, now: Instant) -> Option<Request> {
        let mut chosen = None;
        for (index, request) in self.0.iter().enumerate() {
            let behind = self.0.iter().take(index).any(|earlier| earlier.unit == request.unit);
            if behind || owed.holds(request, now) {
                continue;
            }
            if !request.is_read() {
                chosen = Some(index);
                break;
            }
            chosen = chosen.or(Some(index));
        }
        // the index was found in the same queue a moment ago
        chosen.filter(|index| *index < self.0.len()).map(|index| self.0.remove(index))
    }

    /// Drops what can no longer be sent in time.
    pub(super) fn expire(&mut self, now: Instant, counters: &mut Counters, host: &mut HostSide<'_>) {
        self.0.retain(|request| {
            let late = now >= request.expires;
            if late {
                count(&mut counters.expired);
                request.fail(host, ExceptionCode::GatewayTargetDeviceFailedToRespond);
            }
            !late
        });
    }

    /// Drops everything.
    pub(super) fn clear(&mut self, host: &mut HostSide<'_>) {
        for request in &self.0 {
            request.fail(host, ExceptionCode::GatewayTargetDeviceFailedToRespond);
        }
        self.0.clear();
    }

    /// When the first request expires.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.0.iter().map(|request| request.expires).min()
    }
}

/// Replies of one kind that may still come.
#[derive(Debug, Clone, Copy)]
struct Owed {
    expected: Expected,
    replies: u8,
    until: Instant,
}

/// How many kinds of reply a bus can be owed; while that many are, it starts no transaction.
pub(super) const OWED: usize = 4;

/// Replies that devices owe because they let an attempt time out. They number nothing, so until such a reply has come
/// or the hold-off has passed, it could be taken for the answer to a request like the one that it belongs to.
#[derive(Debug)]
pub(super) struct OwedReplies(Vec<Owed, OWED>);

impl OwedReplies {
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// So many attempts timed out, the last of which is forgiven at `until`.
    pub(super) fn add(&mut self, expected: Expected, replies: u8, until: Instant) {
        if replies > 0 {
            // a transaction starts only while there is room, and adds at most once
            let _ = self.0.push(Owed { expected, replies, until });
        }
    }

    /// Whether no further timeout could be remembered.
    pub(super) fn is_full(&self) -> bool {
        self.0.is_full()
    }

    /// Forgets replies that are not to be expected any more; tells whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        self.0.retain(|owed| now < owed.until);
        self.0.len() < before
    }

    /// When the next one is forgotten.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.0.iter().map(|owed| owed.until).min()
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

    /// A reply came, late.
    pub(super) fn settle(&mut self, index: usize) {
        if let Some(owed) = self.0.get_mut(index) {
            owed.replies = owed.replies.saturating_sub(1);
        }
        self.0.retain(|owed| owed.replies > 0);
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Expected> {
        self.0.iter().map(|owed| &owed.expected)
    }
}

/// Kinds of frame that a bus looks for: the reply in flight and those owed, each with an exception.
pub(super) const KINDS: usize = 2 * (OWED + 1);

/// What a serial bus looks for in the bytes it receives.
pub(super) struct Wanted<'a> {
    pub(super) in_flight: Option<&'a Expected>,
    pub(super) owed: &'a OwedReplies,
}

impl Wanted<'_> {
    fn all(&self) -> impl Iterator<Item = Option<&Expected>> {
        core::iter::once(self.in_flight).chain(self.owed.iter().map(Some))
    }

    /// The owed reply that a kind stands for; `None` for the reply in flight.
    pub(super) const fn owed_index(kind: usize) -> Option<usize> {
        (kind / 2).checked_sub(1)
    }
}

impl Expectation<KINDS> for Wanted<'_> {
    fn lengths(&self) -> [usize; KINDS] {
        let mut lengths = [0; KINDS];
        let all = self.all().map(|expected| expected.map_or([0; 2], Expected::lengths));
        lengths.as_chunks_mut::<2>().0.iter_mut().zip(all).for_each(|(place, two)| *place = two);
        lengths
    }

    fn accepts(&self, kind: usize, frame: &[u8]) -> bool {
        self.all().nth(kind / 2).flatten().is_some_and(|expected| expected.accepts(frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::config::Network;

    fn request(unit: u8, function: nst::FunctionCode) -> Request {
        let network = Network::default();
        let (number, route) = network.route(16).unwrap();
        let asked = nst::Request::Command { function, register: 0, length: 1 };
        let expected = Expected::Nst(nst::serial::ExpectedReply::new(unit, &asked));
        let start = Instant::from_micros(0);
        Request::new(unit, function.code(), Some(expected), (Some(number), route), &[unit], start).unwrap()
    }

    fn order(queue: &mut Queue, owed: &OwedReplies) -> std::vec::Vec<(u8, u8)> {
        let now = Instant::from_micros(0);
        std::iter::from_fn(|| queue.next(owed, now)).map(|request| (request.unit, request.function)).collect()
    }

    const READ: nst::FunctionCode = nst::FunctionCode::Read;
    const ZERO: nst::FunctionCode = nst::FunctionCode::SetZero;

    #[test]
    fn writes_go_first_and_units_keep_their_order() {
        let mut queue = Queue::new();
        for (unit, function) in [(1, READ), (1, ZERO), (2, READ), (3, ZERO)] {
            queue.push(request(unit, function)).unwrap();
        }
        assert!(queue.push(request(4, READ)).is_err(), "four can wait");
        let expected = [(3, 0x12), (1, 3), (1, 0x12), (2, 3)];
        assert_eq!(order(&mut queue, &OwedReplies::new()), expected);
    }

    #[test]
    fn a_held_request_holds_its_unit_and_no_other() {
        let mut queue = Queue::new();
        for (unit, function) in [(1, READ), (1, ZERO), (2, READ)] {
            queue.push(request(unit, function)).unwrap();
        }
        let mut owed = OwedReplies::new();
        owed.add(request(1, READ).expected.unwrap(), 1, Instant::from_micros(10));
        assert_eq!(order(&mut queue, &owed), [(2, 3)]);
        assert!(!owed.expire(Instant::from_micros(9)));
        assert!(owed.expire(Instant::from_micros(10)));
        assert_eq!(order(&mut queue, &owed), [(1, 3), (1, 0x12)]);
    }
}
