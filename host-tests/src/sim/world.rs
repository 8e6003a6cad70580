//! The event loop: wires, devices and the board, in the order of time.

mod can;
mod host_line;
mod inject;
mod rs485;

use super::agenda::Agenda;
use super::can_wire::CanWire;
use super::fault::Fault;
use super::firmware::{CONTROLLER, Firmware, Handed, Uart};
use super::line::Line;
use super::moment::{MICROS, Moment, Nanos};
use super::random::Random;
use super::recorder::Recorder;
use super::routes;
use super::settings::Settings;
use super::station::{CanStation, SerialStation};
use jointbus::devices::Order;
use jointbus_mcu_bridge::board::{Parity, Port, PortConfig, Protocol};
use jointbus_mcu_bridge::engine::AnyEngine;
use jointbus_mcu_bridge::io::serial::UartBuffers;
use jointbus_protocol::can::Frame;
use jointbus_protocol::time::Duration;
use std::collections::VecDeque;

/// Period of the tick that wakes the main loop, as the firmware has it.
const TICK: Nanos = 100 * MICROS;

/// The bridge's transceiver on an RS485 line; the devices follow, and one intruder.
const BRIDGE: usize = 0;

/// Bit errors in a row that take a fresh controller to bus-off.
pub(super) const TO_BUS_OFF: usize = 32;

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
        /// Which bus.
        port: Port,
        /// The frame.
        frame: Frame,
        /// When it started.
        start: Moment,
    },
    /// A frame on CAN has reached the bridge.
    BridgeHears {
        /// Which bus.
        port: Port,
        /// The frame.
        frame: Frame,
    },
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
    Can { can: usize },
    NodeReply { can: usize, node: usize },
    CanBack { can: usize },
    Alarm(u64),
}

/// What the host still has to send.
#[derive(Debug, Clone, Copy)]
enum ToSend {
    Byte(u8),
    /// A byte whose stop bit is missing.
    Unframed(u8),
    Pause(Nanos),
}

/// One RS485 line with everything on it.
pub(super) struct Bus {
    pub(super) line: Line,
    /// Sensors, or one station.
    pub(super) devices: Vec<SerialStation>,
    pub(super) is_nst: bool,
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

/// One CAN bus with everything on it.
pub(super) struct CanNet {
    pub(super) wire: CanWire,
    pub(super) nodes: Vec<CanStation>,
    /// What goes wrong with the next replies.
    pub(super) armed: VecDeque<Fault>,
    pub(super) port: Port,
    due: Option<Moment>,
    /// When the bus is no longer held dominant.
    released: Option<Moment>,
}

/// A bridge with its host line, its buses and the devices there.
pub struct World<'q> {
    pub(super) now: Moment,
    agenda: Agenda<Event>,
    pub(super) random: Random,
    pub(super) settings: Settings,
    firmware: Firmware<'q>,
    /// The host's port, then the lines'.
    uarts: Vec<Uart<'q>>,
    /// The main loop's next turn.
    turn: Option<Moment>,
    notices: VecDeque<Notice>,
    to_bridge: VecDeque<ToSend>,
    host_byte: Nanos,
    to_host: Option<u8>,
    host_sending: bool,
    pub(super) lines: Vec<Bus>,
    pub(super) nets: Vec<CanNet>,
    recorder: Option<Recorder>,
}

impl<'q> World<'q> {
    /// A world at its beginning. The queues are those between the bridge's interrupts and its main loop:
    /// [`SimBoard::queues`](super::SimBoard::queues).
    #[must_use]
    pub fn new(settings: Settings, queues: &'q mut [UartBuffers]) -> Self {
        let mut random = Random::new(settings.seed);
        let now = Moment::from_nanos(1_000_000_000);
        let (firmware, uarts) = Firmware::new(&settings, queues, now.instant());
        let lines: Vec<_> =
            settings.board.serial_buses().map(|port| Bus::new(&settings, port, now)).collect();
        let nets: Vec<_> = settings.board.can_buses().map(|port| CanNet::new(&settings, port)).collect();
        let host_byte = byte_time(&settings.network.ports[Port::HOST.index()]);
        let mut world = Self {
            now,
            agenda: Agenda::new(),
            random: random.fork(),
            settings,
            firmware,
            uarts,
            turn: None,
            notices: VecDeque::new(),
            to_bridge: VecDeque::new(),
            host_byte,
            to_host: None,
            host_sending: false,
            lines,
            nets,
            recorder: None,
        };
        world.wake(now);
        world
    }

    /// Records all wires from now on; [`World::recording`] has the file.
    pub fn record(&mut self) {
        let Settings { board, network, .. } = &self.settings;
        self.recorder = Some(Recorder::new(board.description, network));
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

    /// What is simulated.
    #[must_use]
    pub const fn settings(&self) -> &Settings {
        &self.settings
    }

    /// What is on the serial bus of a port.
    pub(super) fn bus(&self, port: Port) -> Option<&Bus> {
        self.lines.iter().find(|bus| bus.port == port)
    }

    /// The bridge's engine.
    #[must_use]
    pub fn engine(&self) -> &dyn AnyEngine {
        &*self.firmware.engine
    }

    /// The bridge's frame that [`Notice::SerialFrame`] tells of.
    #[must_use]
    pub fn sent_frame(&self, port: Port) -> &[u8] {
        self.bus(port).map_or(&[], |bus| &bus.frame)
    }

    /// Has the host send bytes, behind those that it has not sent yet. The answer is when the last of them ends.
    pub fn host_sends(&mut self, bytes: &[u8]) -> Moment {
        self.to_bridge.extend(bytes.iter().map(|byte| ToSend::Byte(*byte)));
        if let Some(recorder) = &mut self.recorder {
            recorder.bytes(Port::HOST, true, self.now, bytes);
        }
        self.host_goes_on();
        let spans = self.to_bridge.iter().map(|item| match item {
            ToSend::Byte(_) | ToSend::Unframed(_) => self.host_byte,
            ToSend::Pause(span) => *span,
        });
        self.now.saturating_add(spans.sum())
    }

    /// Has the host send a byte without its stop bit, behind what it has not sent yet.
    pub fn host_sends_unframed(&mut self, byte: u8) {
        self.to_bridge.push_back(ToSend::Unframed(byte));
        self.host_goes_on();
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
            Event::Can { can } => {
                if self.nets[can].due == Some(self.now) {
                    self.nets[can].due = None;
                    self.move_can(can);
                }
            }
            Event::NodeReply { can, node } => {
                let net = &mut self.nets[can];
                if let Some(frames) = net.nodes[node].due(self.now) {
                    net.wire.controllers[node + 1].outbox.extend(frames);
                    self.move_can(can);
                }
            }
            Event::CanBack { can } => self.power_nodes(can),
            Event::Alarm(name) => self.notices.push_back(Notice::Alarm(name)),
        }
    }

    // the board

    /// An interrupt: the main loop takes notice a little later.
    fn interrupt(&mut self) {
        let at = self.now.saturating_add(self.settings.latency.draw(0, &mut self.random));
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
        let handed = self.firmware.turn(self.now, &mut self.nets);
        self.fill_tx(&handed);
        let tick = self.now.saturating_add(1).rounded_up(TICK);
        if handed.again {
            self.wake(tick);
        } else if let Some(deadline) = self.firmware.engine.poll_at() {
            self.wake(Moment::of(deadline).rounded_up(TICK).max(tick));
        }
    }

    fn fill_tx(&mut self, handed: &Handed) {
        for (index, changed) in handed.changed.iter().enumerate() {
            let Some(config) = changed else { continue };
            match index.checked_sub(1) {
                None => self.host_byte = byte_time(config),
                Some(line) => self.lines[line].line.set_byte_time(byte_time(config)),
            }
        }
        if handed.serial[0] && !self.uarts[0].sending {
            self.start_byte_to_host();
        }
        for line in 0..self.lines.len() {
            if handed.serial[line + 1] && !self.uarts[line + 1].sending {
                self.start_bridge_frame(line);
            }
        }
        (0..self.nets.len()).for_each(|can| self.move_can(can));
    }
}

impl Bus {
    fn new(settings: &Settings, port: Port, now: Moment) -> Self {
        let config = settings.network.ports[port.index()];
        let protocol = routes::protocol(&settings.network, port);
        let is_nst = protocol.is_some_and(Protocol::is_nst);
        let devices: Vec<_> = if is_nst {
            // a device that hears a foreign frame is ready again before the next one
            let silence = Duration::from_micros(config.characters(3).as_micros());
            let sensors = 1..=settings.sensors;
            sensors
                .map(|address| SerialStation::sensor(port, address, silence, settings.sensor_delay))
                .collect()
        } else {
            let is_ascii = protocol == Some(Protocol::ModbusAscii);
            vec![SerialStation::station(settings.station_delay, is_ascii)]
        };
        // the bridge, the devices, the intruder
        let mut line = Line::new(devices.len() + 2, byte_time(&config));
        line.set_noisy(devices.len() + 1);
        Self {
            line,
            devices,
            is_nst,
            armed: VecDeque::new(),
            frame: Vec::new(),
            frame_start: now,
            port,
            echo: config.echo,
            hold: 0,
            mute: 0,
            noise: Vec::new(),
        }
    }
}

impl CanNet {
    fn new(settings: &Settings, port: Port) -> Self {
        let nodes: Vec<_> =
            (1..=settings.nodes).map(|node| CanStation::sensor(port, node, settings.node_delay)).collect();
        // the bridge, the nodes, the intruder
        let mut wire = CanWire::new(settings.network.ports[port.index()].rate.into(), nodes.len() + 2);
        wire.controllers[CONTROLLER].waits_for_restart = true;
        Self { wire, nodes, armed: VecDeque::new(), port, due: None, released: None }
    }
}

/// The time that a character takes.
fn byte_time(config: &PortConfig) -> Nanos {
    let bits = 9 + u64::from(config.stop_bits) + u64::from(config.parity != Parity::None);
    bits * 1_000_000_000 / u64::from(config.baud().max(1))
}

/// The low half of the microseconds since boot.
const fn micros(now: Moment) -> u32 {
    now.instant().as_micros() as u32
}
