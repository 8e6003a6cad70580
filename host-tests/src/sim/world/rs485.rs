//! The RS485 lines: the bridge's frames, and what the devices hear and answer.

use super::{BRIDGE, Event, Notice, World, micros};
use crate::sim::fault::Fault;
use crate::sim::line::Tamper;
use crate::sim::moment::Moment;
use crate::sim::station::{self, timeout_of};

impl World<'_> {
    pub(super) fn start_bridge_frame(&mut self, line: usize) {
        let Some(byte) = self.uarts[line + 1].queues.transmitter().next_byte() else { return };
        self.uarts[line + 1].sending = true;
        let bus = &mut self.lines[line];
        bus.frame.clear();
        bus.frame.push(byte);
        bus.frame_start = self.now;
        let mute = std::mem::take(&mut bus.mute);
        if mute > 0 {
            bus.line.mute(BRIDGE, self.now.saturating_add(mute));
        }
        self.line_sends(line, BRIDGE, &[byte]);
    }

    pub(super) fn line_sends(&mut self, line: usize, sender: usize, bytes: &[u8]) {
        if let Some(end) = self.lines[line].line.send(sender, bytes, self.now) {
            self.agenda.enter(end, Event::LineByte { line, sender });
        }
    }

    /// Has the intruder send random bytes at that moment.
    pub(super) fn enter_noise(&mut self, line: usize, at: Moment) {
        self.agenda.enter(at, Event::NoiseStarts { line });
    }

    pub(super) fn end_line_byte(&mut self, line: usize, sender: usize) {
        // the next byte follows without a pause, so it has to be there
        let following =
            (sender == BRIDGE).then(|| self.uarts[line + 1].queues.transmitter().next_byte()).flatten();
        let bus = &mut self.lines[line];
        if let Some(byte) = following {
            bus.frame.push(byte);
            bus.line.send(BRIDGE, &[byte], self.now);
        }
        let (heard, next) = bus.line.end(sender, self.now, &mut self.random);
        let (port, echo) = (bus.port, bus.echo);
        if let Some(end) = next {
            self.agenda.enter(end, Event::LineByte { line, sender });
        }
        if !heard.genuine {
            self.notices.push_back(Notice::Garbled(port));
        }
        for _ in 0..if heard.twice { 2 } else { 1 } {
            let Some(byte) = heard.byte else { break };
            if let Some(recorder) = &mut self.recorder {
                recorder.bytes(port, sender == BRIDGE, self.now, &[byte]);
            }
            if sender != BRIDGE || echo {
                if heard.framing {
                    self.firmware.on_framing_error(port);
                }
                self.uarts[line + 1].queues.received(byte, micros(self.now));
                self.interrupt();
            }
            self.devices_hear(line, sender, byte);
        }
        if sender == BRIDGE && next.is_none() {
            self.end_bridge_frame(line);
        }
    }

    fn end_bridge_frame(&mut self, line: usize) {
        let uart = &mut self.uarts[line + 1];
        uart.sending = false;
        uart.queues.transmitter().transmitted(micros(self.now));
        let bus = &mut self.lines[line];
        let hold = std::mem::take(&mut bus.hold);
        if hold > 0 {
            bus.line.hold(BRIDGE, self.now.saturating_add(hold));
        }
        self.notices.push_back(Notice::SerialFrame { port: bus.port, start: bus.frame_start });
        self.interrupt();
    }

    fn devices_hear(&mut self, line: usize, sender: usize, byte: u8) {
        for device in 0..self.lines[line].devices.len() {
            if device + 1 != sender {
                let reply = self.lines[line].devices[device].hear(Some(byte), self.now);
                self.device_answers(line, device, reply);
            }
        }
    }

    pub(super) fn poll_device(&mut self, line: usize, device: usize) {
        let station = &mut self.lines[line].devices[device];
        station.polled = None;
        let reply = station.hear(None, self.now);
        self.device_answers(line, device, reply);
    }

    fn device_answers(&mut self, line: usize, device: usize, mut reply: Vec<u8>) {
        let bus = &mut self.lines[line];
        let station = &mut bus.devices[device];
        if station.polled.is_none()
            && self.now >= station.absent
            && let Some(deadline) = station.deadline()
        {
            let at = Moment::of(deadline).max(self.now.saturating_add(1));
            station.polled = Some(at);
            self.agenda.enter(at, Event::DevicePoll { line, device });
        }
        if let Some((address, order)) = station.new_orders() {
            self.notices.push_back(Notice::Ordered { port: bus.port, address, order });
        }
        if reply.is_empty() {
            return;
        }
        let timeout = timeout_of(bus.is_nst, reply.get(1).copied());
        let mut delay = station.delay.draw(timeout, &mut self.random);
        let mut again = None;
        // an exception is something that only Modbus has
        let fits = |fault: &Fault| *fault != Fault::ReplyException || !bus.is_nst;
        let fault = match bus.armed.front() {
            Some(fault) if fits(fault) => bus.armed.pop_front(),
            _ => None,
        };
        if let Some(fault) = fault {
            delay += station::spoil(fault, &mut reply, timeout, &mut again, &mut self.random);
            if fault == Fault::WrongBaud {
                bus.line.tamper(device + 1, 0, Tamper::Framing);
            }
            self.notices.push_back(Notice::Garbled(bus.port));
        }
        if reply.is_empty() {
            return;
        }
        // nobody could tell a reply that is later than this from the next one
        let latest = self.now.saturating_add(3 * timeout);
        let copy = again.map(|later| (self.now.saturating_add(delay + later), reply.clone()));
        for (at, reply) in [Some((self.now.saturating_add(delay), reply)), copy].into_iter().flatten() {
            if let Some(at) = station.queue(at, latest, reply) {
                self.agenda.enter(at, Event::DeviceReply { line, device });
            }
        }
    }
}
