//! A request for a bus, and what answers it.

use crate::board::{Limits, Protocol, Route};
use jointbus_protocol::decode::Match;
use jointbus_protocol::modbus::rtu;
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

    /// Tells whether a late response that fits `self` could be taken for the response to `request`: an exception fits
    /// every Modbus request of its function code.
    pub(super) fn could_answer(&self, request: &Self) -> bool {
        match (self, request) {
            (Self::Modbus(late), Self::Modbus(asked)) => {
                late.unit() == asked.unit() && late.function() == asked.function()
            }
            (Self::Nst(late), Self::Nst(asked)) => late == asked,
            _ => false,
        }
    }

    /// Tells whether it could be taken for the response to a part of a request that CAN splits.
    pub(super) fn could_answer_part(&self, request: &Self) -> bool {
        let (Self::Nst(late), Self::Nst(asked)) = (self, request) else { return false };
        let longest = if asked.function().is_read() { can::READ_MAX } else { can::WRITE_MAX };
        let (late_length, length) = (usize::from(late.length()), usize::from(asked.length()));
        late.address() == asked.address()
            && late.function() == asked.function()
            && (late_length == longest.min(length) || length.checked_rem(longest) == Some(late_length))
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

/// Who wants the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    Host,
    /// A polling slot.
    Slot(u8),
}

/// A request for a bus, without its bytes, which stay in a [`Slab`](super::slab::Slab).
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
    pub(super) timeout: Duration,
    /// Time that the device has for it: more, where a probe is not to hold up the bus.
    pub(super) allowed: Duration,
    /// How long a late response is waited for after a timeout.
    pub(super) late_response_window: Duration,
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
            timeout: route.timeout(is_read),
            allowed: route.timeout(is_read),
            late_response_window: route.late_response_window(is_read),
            retries: if is_read { route.read_retries } else { 0 },
            is_split: route.protocol == Protocol::NstOverCan,
            expires: now.saturating_add(Duration::from_millis(route.time_to_live_ms.into())),
        }
    }

    /// Makes it the probe of a device in quarantine: without retry, and its bus waits a twentieth of the probe period at
    /// most, so that the other devices keep their rate.
    pub(super) fn become_probe(&mut self, limits: &Limits) {
        const AT_LEAST: Duration = Duration::from_millis(20);
        // a twentieth of a millisecond is 50 us
        let share = Duration::from_micros(u64::from(limits.probe_period_ms).wrapping_mul(50));
        self.timeout = self.timeout.min(share.max(AT_LEAST));
        self.retries = 0;
    }

    /// Time in which the answer counts, where the bus waits for less of it.
    pub(super) fn probe_window(&self) -> Option<Duration> {
        (self.timeout < self.allowed).then_some(self.allowed)
    }

    pub(super) fn is_read(&self) -> bool {
        self.expected.is_some_and(|expected| expected.is_read())
    }
}
