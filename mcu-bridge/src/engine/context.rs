//! What a bus may touch beside itself.

use super::actions::Pending;
use super::counters::Counters;
use super::host::Output;
use super::polling::Polling;
use super::quarantine::Quarantine;
use super::request::{Expected, Origin, Request};
use super::router::Routes;
use crate::board::{Limits, Port, PortConfig, ROUTES};
use jointbus_protocol::modbus::ExceptionCode;
use jointbus_protocol::time::{Duration, Instant};

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
    /// No device has answered.
    pub(super) const NONE: Self = Self { last: 0, largest: 0 };
}

/// A time in 10 us, as a register has it.
fn tens(time: Duration) -> u16 {
    let tens = time.as_micros().checked_div(10).unwrap_or(0);
    u16::try_from(tens).unwrap_or(u16::MAX)
}

/// What a bus may touch beside itself.
pub(super) struct Context<'a> {
    pub(super) host: HostSide<'a>,
    pub(super) port: Port,
    pub(super) config: &'a PortConfig,
    pub(super) counters: &'a mut Counters,
    pub(super) reply_times: &'a mut [ReplyTime; ROUTES],
    pub(super) quarantine: &'a mut Quarantine,
    pub(super) limits: &'a Limits,
    pub(super) routes: Routes<'a>,
    pub(super) polling: &'a mut Polling,
    pub(super) actions: &'a mut Pending,
}

impl Context<'_> {
    /// Hands the reply to a request, which ended at `now`, to who wants it.
    pub(super) fn answer(&mut self, request: &Request, content: &[u8], sent: Instant, now: Instant) {
        match request.origin {
            Origin::Host => self.host.output.relay(self.host.counters, request.unit, content),
            Origin::Slot(index) => self.polling.answered(index.into(), content, now),
        }
        self.quarantine.answered(request.unit);
        let route = request.route.and_then(|number| self.reply_times.get_mut(usize::from(number)));
        if let Some(time) = route {
            time.last = tens(now.saturating_duration_since(sent));
            time.largest = time.largest.max(time.last);
        }
    }

    /// A request has no answer: an exception for the host, for NST silence.
    pub(super) fn fail(&mut self, request: &Request) {
        match (request.origin, &request.expected) {
            (Origin::Slot(index), _) => self.polling.failed(index.into()),
            (Origin::Host, Some(Expected::Modbus(_))) => {
                let why = ExceptionCode::GatewayTargetDeviceFailedToRespond;
                self.host.output.refuse(self.host.counters, request.unit, request.function, why);
            }
            (Origin::Host, _) => {}
        }
    }

    /// A request was sent, and nobody answered it.
    pub(super) fn give_up(&mut self, request: &Request, now: Instant) {
        self.quarantine.unanswered(request.unit, self.limits, now);
        self.fail(request);
    }
}
