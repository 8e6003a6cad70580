//! The firmware around the engine: the queues between interrupts and main loop, and the main loop itself, in the order
//! in which the reference firmware has them.

use super::can_wire::CanWire;
use super::moment::Moment;
use super::settings::Settings;
use super::world::CanNet;
use jointbus_mcu_bridge::board::{PORTS_MAX, Port, PortConfig};
use jointbus_mcu_bridge::engine::{self, Action, AnyEngine};
use jointbus_mcu_bridge::io::serial::{IsrHalf, MainHalf, UartBuffers, extend_timestamp};
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::time::Instant;
use std::collections::VecDeque;

/// The bridge's controller on a bus.
pub(super) const CONTROLLER: usize = 0;

/// Mailboxes for transmission.
const MAILBOXES: usize = 3;

/// Frames that wait between a CAN interrupt and the main loop, as the firmware has them.
const CAN_INCOMING: usize = 32;

/// The main loop's side of the board.
pub(super) struct Firmware<'q> {
    pub(super) engine: Box<dyn AnyEngine>,
    serial: Vec<SerialPort<'q>>,
    can: Vec<CanPort>,
}

/// The main loop's side of a serial port.
struct SerialPort<'q> {
    port: Port,
    queues: MainHalf<'q>,
    /// Characters without their stop bit.
    framing_errors: u32,
}

/// Between the interrupt of a CAN controller and the main loop.
struct CanPort {
    port: Port,
    node: u8,
    frames: VecDeque<(Frame, u32)>,
    /// When frames of the bridge were acknowledged, as far as the main loop has not taken notice.
    sent: Vec<u32>,
    /// The controller is to give up its frames.
    aborting: bool,
    transmit_errors: u32,
    receive_errors: u32,
    overrun: bool,
}

/// The interrupts' side of a serial port.
pub(super) struct Uart<'q> {
    pub(super) queues: IsrHalf<'q>,
    pub(super) sending: bool,
}

/// What the main loop put into the hardware's hands.
#[derive(Debug, Default)]
pub(super) struct Handed {
    /// Bytes for a serial port.
    pub(super) serial: [bool; PORTS_MAX],
    /// Serial ports with new settings.
    pub(super) changed: [Option<PortConfig>; PORTS_MAX],
    /// The loop has to look again although no interrupt comes.
    pub(super) again: bool,
}

impl<'q> Firmware<'q> {
    /// The firmware of a board, and the interrupts of its serial ports, the host's first.
    pub(super) fn new(
        settings: &Settings,
        queues: &'q mut [UartBuffers],
        now: Instant,
    ) -> (Self, Vec<Uart<'q>>) {
        let Settings { board, network, limits, .. } = *settings;
        let mut engine = board.start(now);
        let stored =
            engine::Settings { topology: network, limits, ..engine::Settings::of(board.description) };
        engine.restore(&stored, now);
        let ports = [Port::HOST].into_iter().chain(board.serial_buses());
        let (serial, uarts) = ports
            .zip(queues)
            .map(|(port, queues)| {
                let (interrupt, main) = queues.split();
                let serial = SerialPort { port, queues: main, framing_errors: 0 };
                (serial, Uart { queues: interrupt, sending: false })
            })
            .unzip();
        let can = board.can_buses().map(|port| CanPort::new(port, network.ports[port.index()].node));
        (Self { engine, serial, can: can.collect() }, uarts)
    }

    /// A frame of the bridge was acknowledged on a CAN bus.
    pub(super) fn on_sent(&mut self, can: usize, now: Instant) {
        self.can[can].sent.push(now.as_micros() as u32);
    }

    /// A character came to a serial port without its stop bit.
    pub(super) fn on_framing_error(&mut self, port: Port) {
        self.serial[port.index()].framing_errors += 1;
    }

    /// A frame failed on a CAN bus, its own or another's.
    pub(super) fn on_error(&mut self, can: usize, own: bool) {
        let can = &mut self.can[can];
        *(if own { &mut can.transmit_errors } else { &mut can.receive_errors }) += 1;
    }

    /// A frame came on a CAN bus; whether the acceptance filter let it pass.
    pub(super) fn on_frame(&mut self, can: usize, frame: &Frame, now: Instant) -> bool {
        self.can[can].on_frame(frame, now)
    }

    /// One turn of the main loop.
    pub(super) fn turn(&mut self, moment: Moment, nets: &mut [CanNet]) -> Handed {
        let Self { engine, serial, can } = self;
        let now = moment.instant();
        let mut handed = Handed::default();
        for SerialPort { port, queues, framing_errors } in &mut *serial {
            (0..std::mem::take(framing_errors)).for_each(|_| engine.receive_error(*port));
            queues.drain_rx(&mut **engine, *port, now);
        }
        for (can, net) in can.iter_mut().zip(&*nets) {
            can.carry_in(&mut **engine, now);
            engine.set_bus_off(can.port, net.wire.controllers[CONTROLLER].is_bus_off(), now);
        }
        while let Some(action) = engine.poll(now) {
            let place = |port: Port| can.iter().position(|can| can.port == port);
            match action {
                Action::AbortCan(port) => place(port).into_iter().for_each(|at| can[at].aborting = true),
                Action::RestartCan(port) => {
                    place(port).into_iter().for_each(|at| nets[at].wire.restart(CONTROLLER, moment));
                }
                Action::Configure(port) => {
                    if serial.iter().any(|serial| serial.port == port) {
                        handed.changed[port.index()] = engine.port(port).copied();
                    }
                }
                // nobody looks at the outputs, and the simulation neither saves nor reboots
                Action::Outputs | Action::Store | Action::Reboot => {}
            }
        }
        for SerialPort { port, queues, .. } in &mut *serial {
            handed.serial[port.index()] = queues.fill_tx(&mut **engine, *port);
        }
        for (can, net) in can.iter_mut().zip(nets) {
            // after an abort there may be a next frame
            handed.again |= can.aborting || !can.frames.is_empty();
            can.carry_out(&mut **engine, now, &mut net.wire);
        }
        handed.again |= serial.iter().any(|serial| !serial.queues.is_idle());
        handed
    }
}

impl CanPort {
    fn new(port: Port, node: u8) -> Self {
        Self {
            port,
            node,
            frames: VecDeque::with_capacity(CAN_INCOMING),
            sent: Vec::new(),
            aborting: false,
            transmit_errors: 0,
            receive_errors: 0,
            overrun: false,
        }
    }

    fn on_frame(&mut self, frame: &Frame, now: Instant) -> bool {
        let Id::Extended(id) = frame.id() else { return false };
        let [highest, _, destination, _] = id.to_be_bytes();
        if highest != 0 || destination != self.node || frame.is_remote() {
            return false;
        }
        if self.frames.len() < CAN_INCOMING {
            self.frames.push_back((*frame, now.as_micros() as u32));
        } else {
            self.overrun = true;
        }
        true
    }

    fn carry_in(&mut self, engine: &mut dyn AnyEngine, now: Instant) {
        // acknowledgements first: a reply comes after the request that it answers
        for micros in std::mem::take(&mut self.sent) {
            engine.frame_sent(self.port, extend_timestamp(now, micros));
        }
        (0..std::mem::take(&mut self.transmit_errors)).for_each(|_| engine.transmit_error(self.port));
        (0..std::mem::take(&mut self.receive_errors)).for_each(|_| engine.receive_error(self.port));
        if std::mem::take(&mut self.overrun) {
            engine.overrun(self.port);
        }
        while let Some((frame, micros)) = self.frames.pop_front() {
            engine.receive_frame(self.port, &frame, extend_timestamp(now, micros));
        }
    }

    fn carry_out(&mut self, engine: &mut dyn AnyEngine, now: Instant, wire: &mut CanWire) {
        if self.aborting {
            wire.abort(CONTROLLER);
            if wire.controllers[CONTROLLER].outbox.is_empty() && self.sent.is_empty() {
                self.aborting = false;
                engine.frames_aborted(self.port, now);
            }
            return;
        }
        while wire.controllers[CONTROLLER].outbox.len() < MAILBOXES {
            let Some(frame) = engine.next_frame(self.port) else { break };
            wire.controllers[CONTROLLER].outbox.push_back(frame);
        }
    }
}
