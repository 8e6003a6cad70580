//! The event loop: wires, devices and the board, in the order of time.

use super::agenda::Agenda;
use super::board::{Board, CONTROLLER, Handed, SERIAL, Uart};
use super::can_wire::{CanWire, Ended, Ending};
use super::fault::Fault;
use super::line::Line;
use super::moment::{MICROS, Moment, Nanos};
use super::random::Random;
use super::recorder::{Interface, Recorder};
use super::settings::Settings;
use super::station::{self, CanStation, SerialStation};
use crate::devices::Order;
use jointbus_mcu_bridge::engine::Engine;
use jointbus_mcu_bridge::engine::config::{Port, PortConfig};
use jointbus_mcu_bridge::io::serial::Queues;
use jointbus_protocol::can::Frame;
use jointbus_protocol::time::Duration;
use std::collections::VecDeque;

/// Period of the tick that wakes the main loop, as the firmware has it.
const TICK: Nanos = 100 * MICROS;

/// The bridge's transceiver on an RS485 line; the devices follow, and one intruder.
pub(super) const BRIDGE: usize = 0;

/// RS485 lines.
pub(super) const LINES: usize = 2;

/// Something that an observer may want to know.
#[derive(Debug, Clone, Copy)]
pub enum Notice {
    /// A byte has reached the host.
    HostHears(u8),
    /// An alarm that was set with [`World::set_alarm`].
    Alarm(u64),
    /// The bridge has sent a frame onto an RS485 line; [`World::sent_frame`] has it.
    SerialFrame {
        /// Which line.
        port: Port,
        /// When its first bit left.
        start: Moment,
    },
    /// The bridge has sent a frame on CAN, and somebody acknowledged it.
    CanFrame {
        /// The frame.
        frame: Frame,
        /// When it started.
        start: Moment,
    },
    /// A frame on CAN has reached the bridge.
    BridgeHears(Frame),
    /// A device has carried out a write or a command.
    Ordered {
        /// Its bus.
        port: Port,
        /// The address that was meant.
        address: u8,
        /// What it did.
        order: Order,
    },
    /// Bytes on an RS485 line were not heard as they were sent.
    Garbled(Port),
}

/// Entries of the agenda.
#[derive(Debug, Clone, Copy)]
enum Event {
    MainLoop,
    ToBridge,
    ToHost,
    HostGoesOn,
    LineByte { line: usize, sender: usize },
    DevicePoll { line: usize, device: usize },
    DeviceReply { line: usize, device: usize },
    NoiseStarts { line: usize },
    Can,
    NodeReply { node: usize },
    CanBack,
    Alarm(u64),
}

/// What the host still has to send.
#[derive(Debug, Clone, Copy)]
enum ToSend {
    Byte(u8),
    Pause(Nanos),
}

/// One RS485 line with everything on it.
pub(super) struct Bus {
    pub(super) line: Line,
    pub(super) devices: Vec<SerialStation>,
    /// What goes wrong with the next replies.
    pub(super) armed: VecDeque<Fault>,
    /// The bridge's frame on the wire, and when it started.
    frame: Vec<u8>,
    frame_start: Moment,
    pub(super) port: Port,
    echo: bool,
    /// How much later the bridge's driver falls than it should, next time.
    pub(super) hold: Nanos,
    /// How much later it rises, next time.
    pub(super) mute: Nanos,
    /// Random bytes on their way from the intruder.
    pub(super) noise: Vec<u8>,
}

/// A bridge with its host line, its buses and the devices there.
pub struct World<'q> {
    pub(super) now: Moment,
    agenda: Agenda<Event>,
    pub(super) random: Random,
    pub(super) settings: Settings,
    board: Board<'q>,
    uarts: [Uart<'q>; 3],
    /// The main loop's next turn.
    turn: Option<Moment>,
    notices: VecDeque<Notice>,
    to_bridge: VecDeque<ToSend>,
    host_byte: Nanos,
    to_host: Option<u8>,
    host_sending: bool,
    pub(super) lines: [Bus; LINES],
    pub(super) can: CanWire,
    can_due: Option<Moment>,
    pub(super) nodes: Vec<CanStation>,
    pub(super) can_armed: VecDeque<Fault>,
    recorder: Option<Recorder>,
}

impl<'q> World<'q> {
    /// A world at its beginning. The queues are those between the bridge's interrupts and its main loop.
    #[must_use]
    pub fn new(settings: Settings, queues: &'q mut [Queues; 3]) -> Self {
        let mut random = Random::new(settings.seed);
        let now = Moment::from_nanos(1_000_000_000);
        let (board, uarts) = Board::new(&settings, queues, now.instant());
        let bus = |port: Port, devices: Vec<SerialStation>| {
            let config = settings.network.port(port);
            // the bridge, the devices, the intruder
            let line = Line::new(devices.len() + 2, byte_time(config));
            Bus {
                line,
                devices,
                armed: VecDeque::new(),
                frame: Vec::new(),
                frame_start: now,
                port,
                echo: config.echo,
                hold: 0,
                mute: 0,
                noise: Vec::new(),
            }
        };
        let a = settings.network.port(Port::Rs485A);
        // a device that hears a foreign frame is ready again before the next one
        let silence = Duration::from_micros(a.characters(3).as_micros());
        let sensors = (1..=settings.sensors)
            .map(|address| SerialStation::sensor(address, silence, settings.sensor_delay));
        let lines = [
            bus(Port::Rs485A, sensors.collect()),
            bus(Port::Rs485B, vec![SerialStation::station(settings.station_delay)]),
        ];
        let nodes: Vec<_> =
            (1..=settings.nodes).map(|node| CanStation::sensor(node, settings.node_delay)).collect();
        // the bridge, the nodes, the intruder
        let mut can = CanWire::new(settings.network.port(Port::Can).rate.into(), nodes.len() + 2);
        can.controllers[CONTROLLER].waits_for_restart = true;
        let host_byte = byte_time(settings.network.port(Port::Host));
        let mut world = Self {
            now,
            agenda: Agenda::new(),
            random: random.fork(),
            settings,
            board,
            uarts,
            turn: None,
            notices: VecDeque::new(),
            to_bridge: VecDeque::new(),
            host_byte,
            to_host: None,
            host_sending: false,
            lines,
            can,
            can_due: None,
            nodes,
            can_armed: VecDeque::new(),
            recorder: None,
        };
        world.wake(now);
        world
    }

    /// Records all wires from now on; [`World::recording`] has the file.
    pub fn record(&mut self) {
        let rates =
            [Port::Host, Port::Rs485A, Port::Rs485B].map(|port| self.settings.network.port(port).baud());
        self.recorder = Some(Recorder::new(rates));
    }

    /// The recording so far, as a pcapng file.
    pub fn recording(&mut self) -> Option<&[u8]> {
        self.recorder.as_mut().map(Recorder::file)
    }

    /// The present moment.
    #[must_use]
    pub const fn now(&self) -> Moment {
        self.now
    }

    /// The bridge's engine.
    #[must_use]
    pub const fn engine(&self) -> &Engine {
        &self.board.engine
    }

    /// The bridge's frame that [`Notice::SerialFrame`] tells of.
    #[must_use]
    pub fn sent_frame(&self, port: Port) -> &[u8] {
        let line = self.lines.iter().find(|bus| bus.port == port);
        line.map_or(&[], |bus| &bus.frame)
    }

    /// Has the host send bytes, behind those that it has not sent yet. The answer is when the last of them ends.
    pub fn host_sends(&mut self, bytes: &[u8]) -> Moment {
        self.to_bridge.extend(bytes.iter().map(|byte| ToSend::Byte(*byte)));
        if let Some(recorder) = &mut self.recorder {
            recorder.bytes(Interface::Host, true, self.now, bytes);
        }
        self.host_goes_on();
        let spans = self.to_bridge.iter().map(|item| match item {
            ToSend::Byte(_) => self.host_byte,
            ToSend::Pause(span) => *span,
        });
        self.now.after(spans.sum())
    }

    /// Has the host pause behind what it has not sent yet.
    pub fn host_pauses(&mut self, span: Nanos) {
        self.to_bridge.push_back(ToSend::Pause(span));
        self.host_goes_on();
    }

    /// Sets an alarm, which comes back as a notice.
    pub fn set_alarm(&mut self, at: Moment, name: u64) {
        self.agenda.enter(at.max(self.now), Event::Alarm(name));
    }

    /// Runs to the next notice, at most until `end`.
    pub fn next(&mut self, end: Moment) -> Option<Notice> {
        loop {
            if let Some(notice) = self.notices.pop_front() {
                return Some(notice);
            }
            let Some((at, event)) = self.agenda.next(end) else {
                self.now = self.now.max(end);
                return None;
            };
            self.now = at;
            self.happen(event);
        }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::MainLoop => {
                if self.turn == Some(self.now) {
                    self.main_loop();
                }
            }
            Event::ToBridge => self.end_byte_to_bridge(),
            Event::HostGoesOn => {
                self.host_sending = false;
                self.host_goes_on();
            }
            Event::ToHost => self.end_byte_to_host(),
            Event::LineByte { line, sender } => self.end_line_byte(line, sender),
            Event::DevicePoll { line, device } => self.poll_device(line, device),
            Event::DeviceReply { line, device } => {
                if let Some(reply) = self.lines[line].devices[device].due(self.now) {
                    self.line_sends(line, device + 1, &reply);
                }
            }
            Event::NoiseStarts { line } => {
                let noise = std::mem::take(&mut self.lines[line].noise);
                let intruder = self.lines[line].devices.len() + 1;
                self.line_sends(line, intruder, &noise);
            }
            Event::Can => {
                if self.can_due == Some(self.now) {
                    self.can_due = None;
                    self.move_can();
                }
            }
            Event::NodeReply { node } => {
                if let Some(frames) = self.nodes[node].due(self.now) {
                    self.can.controllers[node + 1].outbox.extend(frames);
                    self.move_can();
                }
            }
            Event::CanBack => self.power_nodes(),
            Event::Alarm(name) => self.notices.push_back(Notice::Alarm(name)),
        }
    }

    // the board

    /// An interrupt: the main loop takes notice a little later.
    fn interrupt(&mut self) {
        let at = self.now.after(self.settings.latency.draw(&mut self.random));
        self.wake(at);
    }

    fn wake(&mut self, at: Moment) {
        if self.turn.is_none_or(|turn| at < turn) {
            self.turn = Some(at);
            self.agenda.enter(at, Event::MainLoop);
        }
    }

    fn main_loop(&mut self) {
        self.turn = None;
        let handed = self.board.turn(self.now, &mut self.can);
        self.carry_out(&handed);
        let tick = self.now.after(1).rounded_up(TICK);
        if handed.again {
            self.wake(tick);
        } else if let Some(deadline) = self.board.engine.deadline() {
            self.wake(Moment::of(deadline).rounded_up(TICK).max(tick));
        }
    }

    fn carry_out(&mut self, handed: &Handed) {
        for (index, changed) in handed.changed.iter().enumerate() {
            let Some(config) = changed else { continue };
            match SERIAL[index] {
                Port::Host => self.host_byte = byte_time(config),
                _ => self.lines[index - 1].line.set_byte_time(byte_time(config)),
            }
        }
        if handed.serial[0] && !self.uarts[0].sending {
            self.start_byte_to_host();
        }
        for line in 0..LINES {
            if handed.serial[line + 1] && !self.uarts[line + 1].sending {
                self.start_bridge_frame(line);
            }
        }
        self.move_can();
    }

    // the host's line

    fn host_goes_on(&mut self) {
        if self.host_sending {
            return;
        }
        match self.to_bridge.front() {
            Some(ToSend::Byte(_)) => {
                self.host_sending = true;
                self.agenda.enter(self.now.after(self.host_byte), Event::ToBridge);
            }
            Some(ToSend::Pause(span)) => {
                self.host_sending = true;
                let end = self.now.after(*span);
                self.to_bridge.pop_front();
                self.agenda.enter(end, Event::HostGoesOn);
            }
            None => {}
        }
    }

    fn end_byte_to_bridge(&mut self) {
        if let Some(ToSend::Byte(byte)) = self.to_bridge.pop_front() {
            self.uarts[0].queues.received(byte, micros(self.now));
            self.interrupt();
        }
        self.host_sending = false;
        self.host_goes_on();
    }

    fn start_byte_to_host(&mut self) {
        self.to_host = self.uarts[0].queues.next_byte();
        self.uarts[0].sending = self.to_host.is_some();
        if self.to_host.is_some() {
            self.agenda.enter(self.now.after(self.host_byte), Event::ToHost);
        }
    }

    fn end_byte_to_host(&mut self) {
        if let Some(byte) = self.to_host.take() {
            self.notices.push_back(Notice::HostHears(byte));
            if let Some(recorder) = &mut self.recorder {
                recorder.bytes(Interface::Host, false, self.now, &[byte]);
            }
        }
        self.start_byte_to_host();
        // room in the queue, or the end of a transmission
        if !self.uarts[0].sending {
            self.uarts[0].queues.transmitted();
            self.interrupt();
        }
    }

    // RS485

    fn start_bridge_frame(&mut self, line: usize) {
        let Some(byte) = self.uarts[line + 1].queues.next_byte() else { return };
        self.uarts[line + 1].sending = true;
        let bus = &mut self.lines[line];
        bus.frame.clear();
        bus.frame.push(byte);
        bus.frame_start = self.now;
        let mute = std::mem::take(&mut bus.mute);
        if mute > 0 {
            bus.line.mute(BRIDGE, self.now.after(mute));
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

    fn end_line_byte(&mut self, line: usize, sender: usize) {
        // the next byte follows without a pause, so it has to be there
        let following = (sender == BRIDGE).then(|| self.uarts[line + 1].queues.next_byte()).flatten();
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
                let interface = if line == 0 { Interface::Rs485A } else { Interface::Rs485B };
                recorder.bytes(interface, sender == BRIDGE, self.now, &[byte]);
            }
            if sender != BRIDGE || echo {
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
        uart.queues.transmitted();
        let bus = &mut self.lines[line];
        let hold = std::mem::take(&mut bus.hold);
        if hold > 0 {
            bus.line.hold(BRIDGE, self.now.after(hold));
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

    fn poll_device(&mut self, line: usize, device: usize) {
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
            let at = Moment::of(deadline).max(self.now.after(1));
            station.polled = Some(at);
            self.agenda.enter(at, Event::DevicePoll { line, device });
        }
        if let Some((address, order)) = station.new_orders() {
            self.notices.push_back(Notice::Ordered { port: bus.port, address, order });
        }
        if reply.is_empty() {
            return;
        }
        let mut delay = station.delay.draw(&mut self.random);
        let mut again = None;
        let timeout = if line == 0 { 50_000_000 } else { 200_000_000 };
        // an exception is something that only Modbus has
        let fits = |fault: &Fault| *fault != Fault::ReplyException || line == 1;
        let fault = match bus.armed.front() {
            Some(fault) if fits(fault) => bus.armed.pop_front(),
            _ => None,
        };
        if let Some(fault) = fault {
            delay += station::spoil(fault, &mut reply, timeout, &mut again, &mut self.random);
            self.notices.push_back(Notice::Garbled(bus.port));
        }
        if reply.is_empty() {
            return;
        }
        let copy = again.map(|later| (self.now.after(delay + later), reply.clone()));
        for (at, reply) in [Some((self.now.after(delay), reply)), copy].into_iter().flatten() {
            let at = station.queue(at, reply);
            self.agenda.enter(at, Event::DeviceReply { line, device });
        }
    }

    // CAN

    /// Lets the bus go on, and looks again when something ends there.
    pub(super) fn move_can(&mut self) {
        while let Some(ended) = self.can.end(self.now) {
            self.frame_ended(&ended);
        }
        let next = self.can.start(self.now).or_else(|| self.can.recovery(self.now));
        if let Some(next) = next.map(|next| next.max(self.now.after(1)))
            && self.can_due.is_none_or(|due| next < due)
        {
            self.can_due = Some(next);
            self.agenda.enter(next, Event::Can);
        }
    }

    fn frame_ended(&mut self, ended: &Ended) {
        let own = ended.sender == CONTROLLER;
        let Ending::Acknowledged { times } = ended.ending else {
            self.board.on_error(own);
            self.interrupt();
            return;
        };
        if let Some(recorder) = &mut self.recorder {
            recorder.frame(self.now, &ended.frame);
        }
        if own {
            self.board.on_sent();
            self.interrupt();
            self.notices.push_back(Notice::CanFrame { frame: ended.frame, start: ended.start });
        }
        for _ in 0..times {
            if !own && self.board.on_frame(&ended.frame, self.now.instant()) {
                self.interrupt();
                self.notices.push_back(Notice::BridgeHears(ended.frame));
            }
            for node in 0..self.nodes.len() {
                if node + 1 != ended.sender && self.can.controllers[node + 1].powered {
                    self.node_hears(node, &ended.frame);
                }
            }
        }
    }

    fn node_hears(&mut self, node: usize, frame: &Frame) {
        let station = &mut self.nodes[node];
        let mut reply = station.hear(frame, self.now);
        if let Some((address, order)) = station.new_orders() {
            self.notices.push_back(Notice::Ordered { port: Port::Can, address, order });
        }
        if reply.is_empty() {
            return;
        }
        let mut delay = station.delay.draw(&mut self.random);
        let mut again = None;
        if let Some(fault) = self.can_armed.pop_front() {
            delay += station::spoil_frames(fault, &mut reply, 50_000_000, &mut again, &mut self.random);
        }
        let copy = again.map(|later| (self.now.after(delay + later), reply.clone()));
        for (at, reply) in [Some((self.now.after(delay), reply)), copy].into_iter().flatten() {
            let at = station.queue(at, reply);
            self.agenda.enter(at, Event::NodeReply { node });
        }
    }

    /// A frame of this controller was destroyed.
    pub(super) fn failed_frame(&mut self, sender: usize) {
        self.board.on_error(sender == CONTROLLER);
        self.interrupt();
        self.can_due = None;
    }

    /// Has the bus looked at again at that moment.
    pub(super) fn can_looks_again(&mut self, at: Moment) {
        self.agenda.enter(at, Event::CanBack);
    }

    /// Takes the power of some nodes until `end`.
    pub(super) fn darken(&mut self, nodes: &[usize], end: Moment) {
        for node in nodes {
            self.nodes[*node].absent = end;
        }
        self.power_nodes();
        self.agenda.enter(end, Event::CanBack);
    }

    fn power_nodes(&mut self) {
        let mut anybody = false;
        for (node, controller) in self.nodes.iter().zip(self.can.controllers.iter_mut().skip(1)) {
            controller.powered = self.now >= node.absent;
            anybody |= controller.powered;
            if !controller.powered {
                controller.outbox.clear();
            }
        }
        // the intruder listens only where somebody else does
        if let Some(intruder) = self.can.controllers.last_mut() {
            intruder.powered = anybody;
        }
        self.move_can();
    }
}

/// The time that a character takes.
fn byte_time(config: &PortConfig) -> Nanos {
    let bits = 9
        + u64::from(config.stop_bits)
        + u64::from(config.parity != jointbus_mcu_bridge::engine::config::Parity::None);
    bits * 1_000_000_000 / u64::from(config.baud().max(1))
}

/// The low half of the microseconds since boot.
const fn micros(now: Moment) -> u32 {
    now.instant().as_micros() as u32
}
