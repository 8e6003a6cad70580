//! The door: what a frame from the host sets going. Here it is decoded, once, and finds its route.

use super::config::{Port, Route, Target};
use super::counters::count;
use super::host::HostFormat;
use super::quarantine::Admission;
use super::queue::{Content, QueueFull};
use super::response::Framing;
use super::transaction::{Expected, Request};
use super::{Change, Core, Engine};
use jointbus_protocol::decode::{DecodeError, Event, FrameLength};
use jointbus_protocol::modbus::{self, ExceptionCode, rtu};
use jointbus_protocol::time::Instant;
use jointbus_protocol::{checksum, ndam9010, nst};

impl Engine {
    /// Takes bytes from the host.
    pub(super) fn receive_host(&mut self, mut bytes: &[u8], now: Instant) {
        let Self { host, core } = self;
        host.set_silence(core.limits.burst_silence());
        while let Some(event) = host.feed(&HostFormat(core.routes()), &mut bytes, now) {
            core.take(&event, now);
            core.make_change(now);
        }
    }

    /// Notices the silence after a burst from the host.
    #[inline(never)] // seldom, and not beside the rest of what is due
    pub(super) fn end_host_burst(&mut self, now: Instant) {
        let Self { host, core } = self;
        host.set_silence(core.limits.burst_silence());
        if let Some(event) = host.poll(&HostFormat(core.routes()), now) {
            core.take(&event, now);
            core.make_change(now);
        }
    }
}

impl Core {
    /// Makes the change that a request has asked for. Here and not where it was asked for, which is deeper in the stack.
    fn make_change(&mut self, now: Instant) {
        let change = core::mem::replace(&mut self.change, Change::None);
        self.change(change, now);
    }

    fn take(&mut self, event: &Event<'_>, now: Instant) {
        let [counters, ..] = &mut self.counters;
        match *event {
            Event::Frame(frame) => {
                count(&mut counters.received);
                self.last_request = Some(now);
                self.request(frame, now);
            }
            Event::Dropped { error, burst } => {
                let unit = burst.first().copied().unwrap_or(0);
                let known =
                    matches!(unit, modbus::BROADCAST | nst::BROADCAST) || self.router.row(unit).is_some();
                match (known, error) {
                    (false, _) => count(&mut counters.refused),
                    (true, DecodeError::Checksum) => {
                        count(&mut counters.checksum_errors);
                        count(&mut counters.dropped_bursts);
                    }
                    (true, DecodeError::Impossible | DecodeError::Incomplete) => {
                        count(&mut counters.dropped_bursts)
                    }
                }
            }
        }
    }

    /// A valid frame from the host.
    fn request(&mut self, frame: &[u8], now: Instant) {
        let Some((&unit, body)) = checksum::strip_crc(frame).and_then(<[u8]>::split_first) else { return };
        match unit {
            modbus::BROADCAST => {
                self.broadcast_modbus(unit, body, &[Target::Rs485A, Target::Rs485B, Target::LocalIo], now)
            }
            nst::BROADCAST => {
                let whole = FrameLength::Exactly(frame.len());
                if nst::serial::request_length(frame) == whole {
                    self.broadcast_nst(body, now);
                }
                if rtu::request_length(frame) == whole {
                    self.broadcast_modbus(unit, body, &[Target::LocalOutputs], now);
                }
            }
            _ => match self.routes().find(unit) {
                Some((number, route)) if route.protocol.is_nst() => {
                    self.request_nst(unit, number, *route, body, now);
                }
                Some((number, route)) => self.request_modbus(unit, number, *route, body, now),
                None => {}
            },
        }
    }

    fn request_nst(&mut self, unit: u8, number: u8, route: Route, body: &[u8], now: Instant) {
        let Ok(asked) = nst::Request::decode(body) else { return };
        let is_write = !matches!(asked.function(), nst::FunctionCode::Connect) && !asked.function().is_read();
        if route.refuse_writes && is_write {
            return self.refuse(unit, None);
        }
        let remote = route.remote_of(unit);
        let expected = Expected::Nst(nst::serial::ExpectedResponse::new(remote, &asked));
        let function = asked.function().code();
        let request = Request::new(unit, function, Some(expected), (Some(number), &route), now);
        self.admit(&route, request, body, now);
    }

    /// Hands a request to its bus, unless its unit is in quarantine or the queue is full.
    fn admit(&mut self, route: &Route, mut request: Request, body: &[u8], now: Instant) {
        let (unit, function) = (request.unit, request.function);
        let waits = match route.bus {
            Target::Rs485A => self.rs485_a.holds(&request, now),
            Target::Rs485B => self.rs485_b.holds(&request, now),
            _ => self.can.holds(&request, now),
        };
        let refusal = match self.quarantine.admit(unit, waits, &self.limits, now) {
            Admission::Refused => Some(ExceptionCode::GatewayTargetDeviceFailedToRespond),
            admission => {
                if admission == Admission::Probe {
                    request.become_probe(&self.limits);
                }
                let remote = route.remote_of(unit);
                self.send(route, &request, remote, body, now)
                    .err()
                    .map(|QueueFull| ExceptionCode::ServerDeviceBusy)
            }
        };
        if let Some(exception) = refusal {
            self.refuse(unit, (!route.protocol.is_nst()).then_some((function, exception)));
        }
    }

    fn request_modbus(&mut self, unit: u8, number: u8, route: Route, body: &[u8], now: Instant) {
        let asked = match modbus::Request::decode(body) {
            Ok(asked) => asked,
            Err(error) => {
                let [counters, ..] = &mut self.counters;
                let (function, exception) = modbus::server::exception_for(error);
                return self.output.refuse(counters, unit, function.code(), exception);
            }
        };
        let function = asked.function();
        if route.refuse_writes && !asked.is_read() {
            return self.refuse(unit, Some((function.code(), ExceptionCode::IllegalFunction)));
        }
        if matches!(route.bus, Target::LocalOutputs | Target::LocalIo | Target::Bridge) {
            if !self.output.has_room() {
                return self.refuse(unit, Some((function.code(), ExceptionCode::ServerDeviceBusy)));
            }
            return match route.bus {
                Target::Bridge => self.serve_own(unit, body, now),
                _ => self.serve_local(unit, route.bus, &asked),
            };
        }
        let remote = route.remote_of(unit);
        let expected = Expected::Modbus(rtu::ExpectedResponse::new(remote, &asked));
        let request = Request::new(unit, function.code(), Some(expected), (Some(number), &route), now);
        self.admit(&route, request, body, now);
    }

    /// Answers for the board's own outputs or inputs and outputs. Apart, so that a request for a bus goes without its
    /// buffer.
    #[inline(never)]
    fn serve_local(&mut self, unit: u8, bus: Target, asked: &modbus::Request<'_>) {
        let mut out = [0; modbus::PDU_MAX];
        let response = match bus {
            Target::LocalOutputs => self.outputs.dispatch(asked, &mut out),
            _ => ndam9010::dispatch(&mut self.io, asked, &mut out),
        };
        if let Ok(response) = response {
            let [counters, ..] = &mut self.counters;
            self.output.relay(counters, unit, response);
        }
    }

    /// A broadcast of Modbus: writes only, never answered.
    fn broadcast_modbus(&mut self, address: u8, body: &[u8], to: &[Target], now: Instant) {
        let Ok(asked) = modbus::Request::decode(body) else { return };
        if asked.is_read() {
            return self.refuse(modbus::BROADCAST, None);
        }
        for bus in to {
            let Some(row) = self.broadcast_row(*bus, false) else { continue };
            // function code, address, and value or quantity: nobody gets to see it
            let mut unseen = [0; 5];
            match bus {
                Target::LocalIo => {
                    let _ = ndam9010::dispatch(&mut self.io, &asked, &mut unseen);
                }
                Target::LocalOutputs => {
                    let _ = self.outputs.dispatch(&asked, &mut unseen);
                }
                _ => self.send_broadcast(&row, asked.function().code(), address, body, now),
            }
        }
    }

    /// A broadcast of NST: writes and commands only, never answered.
    fn broadcast_nst(&mut self, body: &[u8], now: Instant) {
        let Ok(asked) = nst::Request::decode(body) else { return };
        if asked.function().is_read() {
            return self.refuse(nst::BROADCAST, None);
        }
        for bus in [Target::Rs485A, Target::Rs485B, Target::Can] {
            if let Some(row) = self.broadcast_row(bus, true) {
                self.send_broadcast(&row, asked.function().code(), nst::BROADCAST, body, now);
            }
        }
    }

    /// The first route of a bus in that dialect, unless it refuses writes.
    fn broadcast_row(&self, bus: Target, is_nst: bool) -> Option<Route> {
        let mut rows = self.live.routes.iter();
        let row =
            rows.find(|row| row.is_used() && row.bus == bus && row.protocol.is_nst() == is_nst).copied();
        row.filter(|row| !row.refuse_writes)
    }

    fn send_broadcast(&mut self, row: &Route, function: u8, address: u8, body: &[u8], now: Instant) {
        let request = Request::new(nst::BROADCAST, function, None, (None, row), now);
        if self.send(row, &request, address, body, now).is_err() {
            self.refuse(nst::BROADCAST, None);
        }
    }

    /// Hands a request to the bus of a route; the board's own units have no queue.
    fn send(
        &mut self,
        route: &Route,
        request: &Request,
        address: u8,
        body: &[u8],
        now: Instant,
    ) -> Result<(), QueueFull> {
        let framing = Framing::of(route);
        let write = |content: &mut Content| framing.write(address, body, content);
        match route.bus {
            Target::Rs485A | Target::Rs485B => {
                let port = if route.bus == Target::Rs485A { Port::Rs485A } else { Port::Rs485B };
                let Some((bus, mut cx)) = self.serial_parts(port) else { return Err(QueueFull) };
                bus.push(request, write, now, &mut cx)
            }
            Target::Can => {
                let (can, mut cx) = self.can_parts();
                can.push(request, write, now, &mut cx)
            }
            Target::LocalOutputs | Target::LocalIo | Target::Bridge => Err(QueueFull),
        }
    }

    /// Counts a refusal and tells the host: with a Modbus exception, or with silence.
    fn refuse(&mut self, unit: u8, exception: Option<(u8, ExceptionCode)>) {
        let [counters, ..] = &mut self.counters;
        count(&mut counters.refused);
        if let Some((function, exception)) = exception {
            self.output.refuse(counters, unit, function, exception);
        }
    }
}
