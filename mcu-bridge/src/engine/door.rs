//! The door: what a frame from the host sets going. Here it is decoded, once, and finds its route.

use super::Engine;
use super::backlog::QueueFull;
use super::config::{Bus, Port, Protocol, Route};
use super::counters::count;
use super::host::{FRAME_MAX, HostFormat};
use super::quarantine::Admission;
use super::transaction::{Expected, Request};
use heapless::Vec;
use jointbus_protocol::deframe::{Event, Fault, FrameLength};
use jointbus_protocol::modbus::{self, ExceptionCode, rtu};
use jointbus_protocol::time::Instant;
use jointbus_protocol::wire::Writer;
use jointbus_protocol::{checksum, ndam9010, nst};

impl Engine {
    /// Takes bytes from the host.
    pub(super) fn receive_host(&mut self, mut bytes: &[u8], now: Instant) {
        while let Some(event) = self.host.feed(&HostFormat(&self.live), &mut bytes, now).map(apart) {
            self.take(event, now);
        }
    }

    /// Notices the silence after a burst from the host.
    pub(super) fn end_host_burst(&mut self, now: Instant) {
        let event = self.host.poll(&HostFormat(&self.live), now).map(apart);
        if let Some(event) = event {
            self.take(event, now);
        }
    }

    fn take(&mut self, event: Result<Vec<u8, FRAME_MAX>, (u8, Fault)>, now: Instant) {
        let [counters, ..] = &mut self.counters;
        match event {
            Ok(frame) => {
                count(&mut counters.received);
                self.last_request = Some(now);
                self.request(&frame, now);
            }
            Err((unit, fault)) => {
                let known =
                    matches!(unit, modbus::BROADCAST | nst::BROADCAST) || self.live.route(unit).is_some();
                match (known, fault) {
                    (false, _) => count(&mut counters.refused),
                    (true, Fault::Checksum) => {
                        count(&mut counters.checksum_errors);
                        count(&mut counters.dropped_bursts);
                    }
                    (true, Fault::Impossible | Fault::Incomplete) => count(&mut counters.dropped_bursts),
                }
            }
        }
    }

    /// A valid frame from the host.
    fn request(&mut self, frame: &[u8], now: Instant) {
        let Some((&unit, body)) = checksum::verify(frame).and_then(<[u8]>::split_first) else { return };
        match unit {
            modbus::BROADCAST => {
                self.broadcast_modbus(frame, body, &[Bus::Rs485A, Bus::Rs485B, Bus::LocalIo], now)
            }
            nst::BROADCAST => {
                let whole = FrameLength::Exactly(frame.len());
                if nst::serial::request_length(frame) == whole {
                    self.broadcast_nst(frame, body, now);
                }
                if rtu::request_length(frame) == whole {
                    self.broadcast_modbus(frame, body, &[Bus::LocalOutputs], now);
                }
            }
            _ => match self.live.route(unit) {
                Some((number, route)) if route.protocol.is_nst() => {
                    self.request_nst(unit, number, *route, frame, body, now);
                }
                Some((number, route)) => self.request_modbus(unit, number, *route, frame, body, now),
                None => {}
            },
        }
    }

    fn request_nst(&mut self, unit: u8, number: u8, route: Route, frame: &[u8], body: &[u8], now: Instant) {
        let Ok(asked) = nst::Request::decode(body) else { return };
        let is_write = !matches!(asked.function(), nst::FunctionCode::Connect) && !asked.function().is_read();
        if route.refuse_writes && is_write {
            return self.refuse(unit, None);
        }
        let remote = route.remote_of(unit);
        let expected = Expected::Nst(nst::serial::ExpectedReply::new(remote, &asked));
        let mut buffer = [0; FRAME_MAX];
        let content = match route.bus {
            Bus::Can => body,
            _ => readdress(frame, remote, &mut buffer),
        };
        let function = asked.function().code();
        let request = Request::new(unit, function, Some(expected), (Some(number), &route), content, now);
        if let Some(request) = request {
            self.admit(&route, request, now);
        }
    }

    /// Hands a request to its bus, unless its unit is in quarantine or the queue is full.
    fn admit(&mut self, route: &Route, mut request: Request, now: Instant) {
        let (unit, function) = (request.unit, request.function);
        let waits = match route.bus {
            Bus::Rs485A => self.rs485_a.holds(&request, now),
            Bus::Rs485B => self.rs485_b.holds(&request, now),
            _ => self.can.holds(&request, now),
        };
        let refusal = match self.quarantine.admit(unit, waits, &self.limits, now) {
            Admission::Refused => Some(ExceptionCode::GatewayTargetDeviceFailedToRespond),
            admission => {
                if admission == Admission::Probe {
                    request.become_probe(&self.limits);
                }
                self.send(route.bus, request, now).err().map(|QueueFull| ExceptionCode::ServerDeviceBusy)
            }
        };
        if let Some(exception) = refusal {
            self.refuse(unit, (!route.protocol.is_nst()).then_some((function, exception)));
        }
    }

    fn request_modbus(
        &mut self,
        unit: u8,
        number: u8,
        route: Route,
        frame: &[u8],
        body: &[u8],
        now: Instant,
    ) {
        let asked = match modbus::Request::decode(body) {
            Ok(asked) => asked,
            Err(error) => {
                let [counters, ..] = &mut self.counters;
                return self.output.respond(counters, unit, &modbus::server::malformed(error));
            }
        };
        let function = asked.function();
        if route.refuse_writes && !asked.is_read() {
            return self.refuse(unit, Some((function.code(), ExceptionCode::IllegalFunction)));
        }
        if matches!(route.bus, Bus::LocalOutputs | Bus::LocalIo | Bus::Bridge) {
            return self.serve_local(unit, route.bus, &asked, body, now);
        }
        let remote = route.remote_of(unit);
        let expected = Expected::Modbus(rtu::ExpectedResponse::new(remote, &asked));
        let mut buffer = [0; FRAME_MAX];
        let content = on_bus(&route, readdress(frame, remote, &mut buffer));
        let request =
            Request::new(unit, function.code(), Some(expected), (Some(number), &route), content, now);
        if let Some(request) = request {
            self.admit(&route, request, now);
        }
    }

    /// Answers for one of the board's own units.
    fn serve_local(&mut self, unit: u8, bus: Bus, asked: &modbus::Request<'_>, pdu: &[u8], now: Instant) {
        if !self.output.has_room() {
            return self.refuse(unit, Some((asked.function().code(), ExceptionCode::ServerDeviceBusy)));
        }
        let mut data = [0; modbus::PDU_MAX];
        let response = match bus {
            Bus::LocalOutputs => self.outputs.dispatch(asked, &mut data),
            Bus::LocalIo => ndam9010::dispatch(&mut self.io, asked, &mut data),
            _ => return self.serve_own(unit, pdu, now),
        };
        let [counters, ..] = &mut self.counters;
        self.output.respond(counters, unit, &response);
    }

    /// A broadcast of Modbus: writes only, never answered.
    fn broadcast_modbus(&mut self, frame: &[u8], body: &[u8], to: &[Bus], now: Instant) {
        let Ok(asked) = modbus::Request::decode(body) else { return };
        if asked.is_read() {
            return self.refuse(modbus::BROADCAST, None);
        }
        let routes = self.live.routes;
        for bus in to {
            let row = routes.iter().find(|row| row.is_used() && row.bus == *bus && !row.protocol.is_nst());
            let Some(row) = row.filter(|row| !row.refuse_writes) else { continue };
            let mut data = [0; modbus::PDU_MAX];
            match bus {
                Bus::LocalIo => {
                    ndam9010::dispatch(&mut self.io, &asked, &mut data);
                }
                Bus::LocalOutputs => {
                    self.outputs.dispatch(&asked, &mut data);
                }
                _ => self.send_broadcast(*bus, asked.function().code(), row, on_bus(row, frame), now),
            }
        }
    }

    /// A broadcast of NST: writes and commands only, never answered.
    fn broadcast_nst(&mut self, frame: &[u8], body: &[u8], now: Instant) {
        let Ok(asked) = nst::Request::decode(body) else { return };
        if asked.function().is_read() {
            return self.refuse(nst::BROADCAST, None);
        }
        let routes = self.live.routes;
        for bus in [Bus::Rs485A, Bus::Rs485B, Bus::Can] {
            let row = routes.iter().find(|row| row.is_used() && row.bus == bus && row.protocol.is_nst());
            let Some(row) = row.filter(|row| !row.refuse_writes) else { continue };
            let content = if bus == Bus::Can { body } else { frame };
            self.send_broadcast(bus, asked.function().code(), row, content, now);
        }
    }

    fn send_broadcast(&mut self, bus: Bus, function: u8, row: &Route, content: &[u8], now: Instant) {
        let request = Request::new(nst::BROADCAST, function, None, (None, row), content, now);
        if let Some(request) = request
            && self.send(bus, request, now).is_err()
        {
            self.refuse(nst::BROADCAST, None);
        }
    }

    /// Hands a request to its bus; the board's own units have no queue.
    fn send(&mut self, bus: Bus, request: Request, now: Instant) -> Result<(), QueueFull> {
        match bus {
            Bus::Rs485A | Bus::Rs485B => {
                let port = if bus == Bus::Rs485A { Port::Rs485A } else { Port::Rs485B };
                let Some((bus, mut around)) = self.serial_parts(port) else { return Err(QueueFull) };
                bus.push(request, now, &mut around)
            }
            Bus::Can => {
                let (can, mut around) = self.can_parts();
                can.push(request, now, &mut around)
            }
            Bus::LocalOutputs | Bus::LocalIo | Bus::Bridge => Err(QueueFull),
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

/// What came out of the host's bytes, apart from the deframer: a frame, or the unit and the fault of a burst.
fn apart(event: Event<'_>) -> Result<Vec<u8, FRAME_MAX>, (u8, Fault)> {
    match event {
        // the deframer's frames are never longer
        Event::Frame(frame) => Ok(Vec::from_slice(frame).unwrap_or_default()),
        Event::Dropped { fault, burst } => Err((burst.first().copied().unwrap_or(0), fault)),
    }
}

/// What a bus is handed of a Modbus frame: ASCII has a checksum of its own.
fn on_bus<'f>(route: &Route, frame: &'f [u8]) -> &'f [u8] {
    match route.protocol {
        Protocol::ModbusAscii => checksum::verify(frame).unwrap_or(frame),
        _ => frame,
    }
}

/// The same frame for another address.
fn readdress<'b>(frame: &[u8], address: u8, buffer: &'b mut [u8; FRAME_MAX]) -> &'b [u8] {
    let content = checksum::verify(frame).and_then(|content| content.get(1..)).unwrap_or(&[]);
    let mut writer = Writer::new(buffer);
    // it had room before
    let _ =
        writer.u8(address).and_then(|()| writer.slice(content)).and_then(|()| checksum::seal(&mut writer));
    writer.finish()
}
