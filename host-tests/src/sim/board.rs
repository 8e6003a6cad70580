//! The board around the engine: the queues between interrupts and main loop, and the main loop itself, in the order in
//! which the firmware has them.

use super::can_wire::CanWire;
use super::moment::Moment;
use jointbus_mcu_bridge::board::{Port, PortConfig};
use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, Engine, RS485_A, RS485_B};
use jointbus_mcu_bridge::engine::{self, Action, Identity, ResetCause};
use jointbus_mcu_bridge::io::serial::{IsrHalf, MainHalf, UartBuffers, extend_timestamp};
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::time::Instant;
use std::collections::VecDeque;

use super::settings::Settings;

/// The bridge's controller on the bus.
pub(super) const CONTROLLER: usize = 0;

/// Mailboxes for transmission.
const MAILBOXES: usize = 3;

/// Frames that wait between the CAN interrupt and the main loop, as the firmware has them.
const CAN_INCOMING: usize = 32;

/// What is at the board's own analog inputs.
pub(super) const INPUTS: [u16; 4] = [0x1357, 0x2468, 0x0F1E, 0x7A8B];

/// Serial ports, in the order of their queues.
pub(super) const SERIAL: [Port; 3] = [Port::HOST, RS485_A, RS485_B];

/// The main loop's side of the board.
pub(super) struct Board<'q> {
    pub(super) engine: Engine,
    queues: [MainHalf<'q>; 3],
    frames: VecDeque<(Frame, u32)>,
    /// When frames of the bridge were acknowledged, as far as the main loop has not taken notice.
    sent: Vec<u32>,
    /// The controller is to give up its frames.
    aborting: bool,
    /// Characters without their stop bit at each serial port.
    framing_errors: [u32; 3],
    transmit_errors: u32,
    receive_errors: u32,
    overrun: bool,
    node: u8,
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
    pub(super) serial: [bool; 3],
    /// Ports with new settings.
    pub(super) changed: [Option<PortConfig>; 3],
    /// The loop has to look again although no interrupt comes.
    pub(super) again: bool,
}

impl<'q> Board<'q> {
    pub(super) fn new(
        settings: &Settings,
        queues: &'q mut [UartBuffers; 3],
        now: Instant,
    ) -> (Self, [Uart<'q>; 3]) {
        let identity = Identity { version: jointbus::version(), reset_cause: ResetCause::PowerOn };
        let mut engine = Engine::new(identity, now);
        let Settings { network, limits, .. } = *settings;
        engine.restore(&engine::Settings { topology: network, limits, ..engine::Settings::of(BOARD) }, now);
        engine.units_mut().1.set_inputs(0, INPUTS);
        let [host, first, second] = queues;
        let ((host_in, host), (first_in, first), (second_in, second)) =
            (host.split(), first.split(), second.split());
        let board = Self {
            engine,
            queues: [host, first, second],
            frames: VecDeque::with_capacity(CAN_INCOMING),
            sent: Vec::new(),
            aborting: false,
            framing_errors: [0; 3],
            transmit_errors: 0,
            receive_errors: 0,
            overrun: false,
            node: settings.network.ports[CAN.index()].node,
        };
        let uart = |queues| Uart { queues, sending: false };
        (board, [uart(host_in), uart(first_in), uart(second_in)])
    }

    /// A frame of the bridge was acknowledged.
    pub(super) fn on_sent(&mut self, now: Instant) {
        self.sent.push(now.as_micros() as u32);
    }

    /// A character came to a serial port without its stop bit.
    pub(super) const fn on_framing_error(&mut self, port: usize) {
        self.framing_errors[port] += 1;
    }

    /// A frame failed, its own or another's.
    pub(super) const fn on_error(&mut self, own: bool) {
        *(if own { &mut self.transmit_errors } else { &mut self.receive_errors }) += 1;
    }

    /// A frame came; whether the acceptance filter let it pass.
    pub(super) fn on_frame(&mut self, frame: &Frame, now: Instant) -> bool {
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

    /// One turn of the main loop.
    pub(super) fn turn(&mut self, moment: Moment, wire: &mut CanWire) -> Handed {
        let now = moment.instant();
        let mut handed = Handed::default();
        for ((queues, port), errors) in
            self.queues.iter_mut().zip(SERIAL).zip(std::mem::take(&mut self.framing_errors))
        {
            (0..errors).for_each(|_| self.engine.receive_error(port));
            queues.drain_rx(&mut self.engine, port, now);
        }
        self.carry_can_in(now);
        self.engine.set_bus_off(CAN, wire.controllers[CONTROLLER].is_bus_off(), now);
        while let Some(action) = self.engine.poll(now) {
            match action {
                Action::AbortCan(_) => self.aborting = true,
                Action::RestartCan(_) => wire.restart(CONTROLLER, moment),
                Action::Configure(port) => {
                    if let Some(index) = SERIAL.iter().position(|serial| *serial == port) {
                        handed.changed[index] = self.engine.port(port).copied();
                    }
                }
                // nobody looks at the outputs, and the simulation neither saves nor reboots
                Action::Outputs | Action::Store | Action::Reboot => {}
            }
        }
        for ((queues, port), moved) in self.queues.iter_mut().zip(SERIAL).zip(&mut handed.serial) {
            *moved = queues.fill_tx(&mut self.engine, port);
        }
        self.carry_can_out(now, wire, &mut handed);
        handed.again |= self.queues.iter().any(|queues| !queues.is_idle()) || !self.frames.is_empty();
        handed
    }

    fn carry_can_in(&mut self, now: Instant) {
        // acknowledgements first: a reply comes after the request that it answers
        for micros in std::mem::take(&mut self.sent) {
            self.engine.frame_sent(CAN, extend_timestamp(now, micros));
        }
        (0..std::mem::take(&mut self.transmit_errors)).for_each(|_| self.engine.transmit_error(CAN));
        (0..std::mem::take(&mut self.receive_errors)).for_each(|_| self.engine.receive_error(CAN));
        if std::mem::take(&mut self.overrun) {
            self.engine.overrun(CAN);
        }
        while let Some((frame, micros)) = self.frames.pop_front() {
            self.engine.receive_frame(CAN, &frame, extend_timestamp(now, micros));
        }
    }

    fn carry_can_out(&mut self, now: Instant, wire: &mut CanWire, handed: &mut Handed) {
        if self.aborting {
            wire.abort(CONTROLLER);
            if wire.controllers[CONTROLLER].outbox.is_empty() && self.sent.is_empty() {
                self.aborting = false;
                self.engine.frames_aborted(CAN, now);
            }
            handed.again = true;
            return;
        }
        while wire.controllers[CONTROLLER].outbox.len() < MAILBOXES {
            let Some(frame) = self.engine.next_frame(CAN) else { break };
            wire.controllers[CONTROLLER].outbox.push_back(frame);
        }
    }
}
