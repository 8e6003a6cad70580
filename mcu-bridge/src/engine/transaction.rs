//! A request on its way over a bus: what answers it, how often it is tried, and what a bus may touch for it.

use super::config::{Limits, PortConfig, ROUTES, Route, Target};
use super::counters::{Counters, count};
use super::host::Output;
use super::polling::Polling;
use super::quarantine::Quarantine;
use super::queue::{BusQueue, ContentIndex};
use super::router::Routes;
use jointbus_protocol::decode::Match;
use jointbus_protocol::modbus::{ExceptionCode, rtu};
use jointbus_protocol::nst::{self, can};
use jointbus_protocol::time::{Duration, Instant};

/// The reply that fits a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Expected {
    Modbus(rtu::ExpectedResponse),
    Nst(nst::serial::ExpectedResponse),
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
    pub(super) fn could_answer(&self, request: &Self) -> bool {
        match (self, request) {
            (Self::Modbus(owed), Self::Modbus(asked)) => {
                owed.unit() == asked.unit() && owed.function() == asked.function()
            }
            (Self::Nst(owed), Self::Nst(asked)) => owed == asked,
            _ => false,
        }
    }

    /// Whether it could be taken for the reply to a part of a request that CAN splits.
    pub(super) fn could_answer_part(&self, request: &Self) -> bool {
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

    /// Whether a Modbus data unit that came from `unit` is the reply.
    pub(super) fn accepts_pdu(&self, unit: u8, pdu: &[u8]) -> bool {
        matches!(self, Self::Modbus(expected) if expected.unit() == unit && expected.accepts_pdu(pdu))
    }

    /// Whether only silence ends the reply.
    pub(super) fn is_open(&self) -> bool {
        matches!(self, Self::Modbus(expected) if expected.is_open())
    }
}

/// A span of the configuration: it fits half of a [`Duration`], and there are many.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub(super) struct Span(u32);

impl From<Duration> for Span {
    /// At most 71 minutes.
    fn from(span: Duration) -> Self {
        Self(u32::try_from(span.as_micros()).unwrap_or(u32::MAX))
    }
}

impl Span {
    /// In 10 us, as a register has it.
    fn tens(self) -> u16 {
        u16::try_from(self.0 / 10).unwrap_or(u16::MAX)
    }
}

impl From<Span> for Duration {
    fn from(span: Span) -> Self {
        Self::from_micros(span.0.into())
    }
}

/// Who wants the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    Host,
    /// A polling slot.
    Slot(u8),
}

/// A request for a bus, without its bytes: these stay where the [`BusQueue`] keeps them.
#[derive(Debug, Clone, Copy)]
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
    /// Time that the bus waits for the answer, without the time on the wire.
    pub(super) timeout: Span,
    /// Time that the device has for it: more, where a probe is not to hold up the bus.
    pub(super) allowed: Span,
    /// How long a reply is owed after a timeout.
    pub(super) late_response_window: Span,
    /// How often it may be sent again.
    pub(super) retries: u8,
    /// Whether what is too long goes in parts.
    pub(super) is_split: bool,
    /// When it is no longer to be sent.
    pub(super) expires: Instant,
}

impl Request {
    pub(super) fn new(
        unit: u8,
        function: u8,
        expected: Option<Expected>,
        (route_number, route): (Option<u8>, &Route),
        now: Instant,
    ) -> Self {
        let is_read = expected.is_some_and(|expected| expected.is_read());
        Self {
            origin: Origin::Host,
            unit,
            route: route_number,
            expected,
            function,
            timeout: route.timeout(is_read).into(),
            allowed: route.timeout(is_read).into(),
            late_response_window: route.late_response_window(is_read).into(),
            retries: if is_read { route.read_retries } else { 0 },
            is_split: route.bus == Target::Can,
            expires: now.saturating_add(Duration::from_millis(route.time_to_live_ms.into())),
        }
    }

    /// Makes it the probe of a device in quarantine: without retry, and its bus waits a twentieth of the probe period at
    /// most, so that the other devices keep their rate.
    pub(super) fn become_probe(&mut self, limits: &Limits) {
        const AT_LEAST: Duration = Duration::from_millis(20);
        // a twentieth of a millisecond is 50 us
        let share = Duration::from_micros(u64::from(limits.probe_period_ms).wrapping_mul(50));
        self.timeout = self.timeout.min(share.max(AT_LEAST).into());
        self.retries = 0;
    }

    /// Time in which the answer counts, where the bus waits for less of it.
    pub(super) fn probe_window(&self) -> Option<Duration> {
        (self.timeout < self.allowed).then_some(self.allowed.into())
    }

    pub(super) fn is_read(&self) -> bool {
        self.expected.is_some_and(|expected| expected.is_read())
    }

    /// Tells the host that there is no answer: an exception, for NST silence.
    fn fail(&self, host: &mut HostSide<'_>, why: ExceptionCode) {
        if let Some(Expected::Modbus(_)) = self.expected {
            host.output.refuse(host.counters, self.unit, self.function, why);
        }
    }
}

/// A request in flight, and its attempts.
#[derive(Debug)]
pub(super) struct Transaction {
    pub(super) request: Request,
    /// Where its bytes are.
    pub(super) index: ContentIndex,
    /// Attempts that may still follow.
    retries_left: u8,
    /// Attempts that timed out.
    pub(super) unanswered: u8,
    /// When the newest attempt had left.
    pub(super) sent: Option<Instant>,
}

impl Transaction {
    pub(super) const fn new(request: Request, index: ContentIndex) -> Self {
        Self { retries_left: request.retries, unanswered: 0, sent: None, request, index }
    }

    /// Another part of the request begins, with as many retries.
    pub(super) const fn restart(&mut self) {
        self.retries_left = self.request.retries;
    }

    /// An attempt timed out; whether there is another one.
    pub(super) fn time_out(&mut self, now: Instant, cx: &mut Surroundings<'_>) -> bool {
        count(&mut cx.counters.timeouts);
        self.unanswered = self.unanswered.saturating_add(1);
        if self.retries_left > 0 && now < self.request.expires {
            self.retries_left = self.retries_left.saturating_sub(1);
            return true;
        }
        cx.give_up(&self.request, now);
        false
    }

    /// It has ended; what its device left unanswered is owed.
    pub(super) fn end(self, expected: Option<Expected>, queue: &mut BusQueue, cx: &mut Surroundings<'_>) {
        if self.request.origin == Origin::Host {
            cx.host.output.release();
        }
        queue.free(self.index);
        if let (Some(expected), Some(sent)) = (expected, self.sent) {
            queue.owed.add(&self.request, expected, self.unanswered, sent);
        }
    }
}

/// The one place of a bus for what is in flight: an `Option` that is all zeros while it is empty (see
/// [`ContentIndex`](super::ContentIndex)), which one with a niche is not.
#[derive(Debug)]
#[repr(u8)]
pub(super) enum Lane<T> {
    Free,
    Taken(T),
}

impl<T> Lane<T> {
    pub(super) const fn as_ref(&self) -> Option<&T> {
        match self {
            Self::Free => None,
            Self::Taken(flight) => Some(flight),
        }
    }

    pub(super) const fn as_mut(&mut self) -> Option<&mut T> {
        match self {
            Self::Free => None,
            Self::Taken(flight) => Some(flight),
        }
    }

    pub(super) const fn is_none(&self) -> bool {
        matches!(self, Self::Free)
    }

    pub(super) fn take(&mut self) -> Option<T> {
        match core::mem::replace(self, Self::Free) {
            Self::Free => None,
            Self::Taken(flight) => Some(flight),
        }
    }
}

/// Where replies go.
pub(super) struct HostSide<'a> {
    pub(super) output: &'a mut Output,
    pub(super) counters: &'a mut Counters,
}

/// How long the devices of a route took to answer, in 10 us; longer than 655 ms reads as that.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ReplyTime {
    pub(super) last: u16,
    pub(super) largest: u16,
}

impl ReplyTime {
    /// None has answered.
    pub(super) const NONE: Self = Self { last: 0, largest: 0 };
}

/// What a bus may touch beside itself.
pub(super) struct Surroundings<'a> {
    pub(super) host: HostSide<'a>,
    pub(super) port: &'a PortConfig,
    pub(super) counters: &'a mut Counters,
    pub(super) reply_times: &'a mut [ReplyTime; ROUTES],
    pub(super) quarantine: &'a mut Quarantine,
    pub(super) limits: &'a Limits,
    pub(super) routes: Routes<'a>,
    pub(super) bus: Target,
    pub(super) polling: &'a mut Polling,
}

impl Surroundings<'_> {
    /// Hands the reply to a request, which ended at `now`, to who wants it.
    pub(super) fn answer(&mut self, request: &Request, content: &[u8], sent: Instant, now: Instant) {
        match request.origin {
            Origin::Host => self.host.output.relay(self.host.counters, request.unit, content),
            Origin::Slot(index) => self.polling.answered(index.into(), content, now),
        }
        self.quarantine.answered(request.unit);
        let route = request.route.and_then(|number| self.reply_times.get_mut(usize::from(number)));
        if let Some(time) = route {
            time.last = Span::from(now.saturating_duration_since(sent)).tens();
            time.largest = time.largest.max(time.last);
        }
    }

    /// A request has no answer.
    pub(super) fn fail(&mut self, request: &Request) {
        match request.origin {
            Origin::Host => {
                request.fail(&mut self.host, ExceptionCode::GatewayTargetDeviceFailedToRespond);
            }
            Origin::Slot(index) => self.polling.failed(index.into()),
        }
    }

    /// A request was sent, and nobody answered it.
    pub(super) fn give_up(&mut self, request: &Request, now: Instant) {
        self.quarantine.unanswered(request.unit, self.limits, now);
        self.fail(request);
    }
}
