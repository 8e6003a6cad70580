//! What a frame from the host sets going. Here it is decoded, once, and finds its route.

use super::actions::Action;
use super::core::Core;
use super::counters::count;
use super::framing::Framing;
use super::quarantine::Admission;
use super::queue::QueueFull;
use super::request::{Expected, Request};
use super::slab::Content;
use crate::board::{Board, LocalUnits, Port, Route, Target};
use jointbus_protocol::checksum::CRC_LENGTH;
use jointbus_protocol::decode::{DecodeError, Dropped, Event, FrameEvent, FrameLength};
use jointbus_protocol::modbus::{self, ExceptionCode, rtu};
use jointbus_protocol::nst;
use jointbus_protocol::time::Instant;

impl<B: Board, const SERIAL: usize, const CAN: usize> Core<B, SERIAL, CAN> {
    /// Takes what came out of the host's bytes.
    pub(super) fn take(&mut self, event: &FrameEvent<'_>, now: Instant) {
        let [counters, ..] = &mut self.shared.counters;
        match *event {
            Event::Frame(frame) => {
                count(&mut counters.received);
                self.shared.last_request = Some(now);
                self.request(frame, now);
            }
            Event::Dropped(Dropped { error, burst }) => {
                let unit = burst.first().copied().unwrap_or(0);
                let known = matches!(unit, modbus::BROADCAST | nst::BROADCAST)
                    || self.shared.router.row(unit).is_some();
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
        // the decoder has looked at the CRC
        let Some((content, _)) = frame.split_last_chunk::<CRC_LENGTH>() else { return };
        let Some((&unit, body)) = content.split_first() else { return };
        match unit {
            modbus::BROADCAST => self.broadcast_modbus(unit, body, now),
            nst::BROADCAST => {
                let whole = FrameLength::Exactly(frame.len());
                if nst::serial::request_length(frame) == whole {
                    self.broadcast_nst(body, now);
                }
                if rtu::request_length(frame) == whole {
                    self.broadcast_modbus(unit, body, now);
                }
            }
            _ => match self.shared.routes().find(unit) {
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
        let waits = route.target.port().is_some_and(|port| match self.serial(port) {
            Some((bus, _)) => bus.holds(&request, now),
            None => self.can(port).is_some_and(|(bus, _)| bus.holds(&request, now)),
        });
        let refusal = match self.shared.quarantine.admit(unit, waits, &self.shared.settings.limits, now) {
            Admission::Refused => Some(ExceptionCode::GatewayTargetDeviceFailedToRespond),
            admission => {
                if admission == Admission::Probe {
                    request.become_probe(&self.shared.settings.limits);
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
                let [counters, ..] = &mut self.shared.counters;
                let (function, exception) = modbus::server::exception_for(error);
                return self.shared.output.refuse(counters, unit, function.code(), exception);
            }
        };
        let function = asked.function();
        if route.refuse_writes && !asked.is_read() {
            return self.refuse(unit, Some((function.code(), ExceptionCode::IllegalFunction)));
        }
        if !matches!(route.target, Target::Bus(_)) && !self.shared.output.has_room() {
            return self.refuse(unit, Some((function.code(), ExceptionCode::ServerDeviceBusy)));
        }
        match route.target {
            Target::Bridge => return self.shared.serve_bridge(B::DESCRIPTION, unit, body, now),
            Target::Local(index) => return self.serve_local(unit, index, &asked),
            Target::Bus(_) => {}
        }
        let remote = route.remote_of(unit);
        let expected = Expected::Modbus(rtu::ExpectedResponse::new(remote, &asked));
        let request = Request::new(unit, function.code(), Some(expected), (Some(number), &route), now);
        self.admit(&route, request, body, now);
    }

    /// Answers for one of the board's own units.
    fn serve_local(&mut self, unit: u8, index: u8, asked: &modbus::Request<'_>) {
        let mut out = [0; modbus::PDU_MAX];
        if let Some(response) = self.units.dispatch(index, asked, &mut out) {
            let [counters, ..] = &mut self.shared.counters;
            self.shared.output.relay(counters, unit, response);
        }
        self.look_at_outputs();
    }

    /// Tells the firmware where the board's own outputs were written.
    fn look_at_outputs(&mut self) {
        if self.units.take_change() {
            self.shared.actions.push(Action::Outputs);
        }
    }

    /// A broadcast of Modbus: writes only, never answered. Address 0 reaches every bus that speaks Modbus, and each of the
    /// board's own units is reached by its kind's address.
    fn broadcast_modbus(&mut self, address: u8, body: &[u8], now: Instant) {
        let Ok(asked) = modbus::Request::decode(body) else { return };
        if asked.is_read() {
            return self.refuse(modbus::BROADCAST, None);
        }
        if address == modbus::BROADCAST {
            for port in B::DESCRIPTION.ports() {
                if let Some(row) = self.broadcast_row(Target::Bus(port), false) {
                    self.send_broadcast(&row, asked.function().code(), address, body, now);
                }
            }
        }
        for (index, _) in (0..).zip(B::Units::KINDS).filter(|(_, kind)| kind.broadcast() == address) {
            if self.broadcast_row(Target::Local(index), false).is_some() {
                // function code, address, and value or quantity: nobody gets to see it
                let _ = self.units.dispatch(index, &asked, &mut [0; 5]);
            }
        }
        self.look_at_outputs();
    }

    /// A broadcast of NST: writes and commands only, never answered.
    fn broadcast_nst(&mut self, body: &[u8], now: Instant) {
        let Ok(asked) = nst::Request::decode(body) else { return };
        if asked.function().is_read() {
            return self.refuse(nst::BROADCAST, None);
        }
        for port in B::DESCRIPTION.ports() {
            if let Some(row) = self.broadcast_row(Target::Bus(port), true) {
                self.send_broadcast(&row, asked.function().code(), nst::BROADCAST, body, now);
            }
        }
    }

    /// The first route to a target in that dialect, unless it refuses writes.
    fn broadcast_row(&self, target: Target, is_nst: bool) -> Option<Route> {
        let mut rows = self.shared.live.routes.iter();
        let row = rows
            .find(|row| row.is_used() && row.target == target && row.protocol.is_nst() == is_nst)
            .copied();
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
        let port = route.target.port().unwrap_or(Port::HOST);
        if let Some((bus, mut cx)) = self.serial(port) {
            bus.push(request, write, now, &mut cx)
        } else if let Some((bus, mut cx)) = self.can(port) {
            bus.push(request, write, now, &mut cx)
        } else {
            Err(QueueFull)
        }
    }

    /// Counts a refusal and tells the host: with a Modbus exception, or with silence.
    fn refuse(&mut self, unit: u8, exception: Option<(u8, ExceptionCode)>) {
        let [counters, ..] = &mut self.shared.counters;
        count(&mut counters.refused);
        if let Some((function, exception)) = exception {
            self.shared.output.refuse(counters, unit, function, exception);
        }
    }
}
