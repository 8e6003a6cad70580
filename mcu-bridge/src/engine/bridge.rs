//! The bridge's face.

use super::actions::Action;
use super::core::{AT_ONCE, Core};
use super::counters::{Counters, count};
use super::host::{HostDecoder, HostFraming};
use super::identity::{Health, Identity};
use super::polling::Slot;
use super::settings::{STORED_LENGTH, Settings};
use crate::board::{Board, LocalUnits, Port, PortConfig};
use jointbus_protocol::can::Frame;
use jointbus_protocol::time::{Duration, Instant};

/// The bridge of a [`Board`] with so many serial and CAN buses.
///
/// A main loop hands in what came ([`receive`](Self::receive), [`receive_frame`](Self::receive_frame)), calls
/// [`poll`](Self::poll) and does what it asks for, and hands out what is to be sent ([`output`](Self::output),
/// [`next_frame`](Self::next_frame)).
#[derive(Debug)]
pub struct Engine<B: Board, const SERIAL: usize, const CAN: usize> {
    /// Apart from all else, because its frames are worked on where they are.
    host: HostDecoder,
    core: Core<B, SERIAL, CAN>,
}

/// Memory for an [`Engine`] that has not started. It is all zeros: a static one lies in `.bss` and takes no flash, and
/// nothing of the engine is ever on the stack.
#[derive(Debug)]
pub struct Storage<B: Board, const SERIAL: usize, const CAN: usize>(Engine<B, SERIAL, CAN>);

impl<B: Board, const SERIAL: usize, const CAN: usize> Default for Storage<B, SERIAL, CAN> {
    fn default() -> Self {
        Self::new()
    }
}

impl<B: Board, const SERIAL: usize, const CAN: usize> Storage<B, SERIAL, CAN> {
    /// The memory.
    #[must_use]
    pub const fn new() -> Self {
        Self(Engine { host: HostDecoder::new(Duration::ZERO), core: Core::new() })
    }

    /// The bridge, with the board's defaults: see [`Engine::restore`].
    pub fn start(&'static mut self, identity: Identity, now: Instant) -> &'static mut Engine<B, SERIAL, CAN> {
        self.0.start(identity, now);
        &mut self.0
    }
}

impl<B: Board, const SERIAL: usize, const CAN: usize> Engine<B, SERIAL, CAN> {
    /// A bridge that starts at `now`, with the board's defaults: see [`Engine::restore`]. Where memory is scarce,
    /// [`Storage`] does the same without a copy.
    #[must_use]
    pub fn new(identity: Identity, now: Instant) -> Self {
        let Storage(mut engine) = Storage::new();
        engine.start(identity, now);
        engine
    }

    fn start(&mut self, identity: Identity, now: Instant) {
        let Core { shared, serial, can, units } = &mut self.core;
        shared.identity = identity;
        shared.settings.limits = B::DESCRIPTION.limits;
        self.host.set_silence(shared.settings.limits.burst_silence());
        for topology in [&mut shared.live, &mut shared.settings.topology, &mut shared.confirmed] {
            topology.set_default(B::DESCRIPTION);
        }
        shared.router.learn(&shared.live);
        shared.last_request = Some(now);
        shared.polling.clear();
        units.power_up();
        if units.take_change() {
            shared.actions.push(Action::Outputs);
        }
        serial.iter_mut().for_each(|bus| bus.start(now));
        let (_, ports) = shared.live.ports.split_at(SERIAL.saturating_add(1).min(shared.live.ports.len()));
        can.iter_mut().zip(ports).for_each(|(bus, port)| bus.start(port.node));
    }

    /// Starts with settings that were stored; to be called before anything else.
    pub fn restore(&mut self, settings: &Settings, now: Instant) {
        let shared = &mut self.core.shared;
        shared.idle_until = AT_ONCE;
        shared.confirmed = settings.topology;
        let former = core::mem::replace(&mut shared.settings, *settings).slots;
        shared.start_slots(&former, now);
        self.core.apply(now);
        // the ports are about to be started with them
        self.core.shared.actions.clear_configure();
    }

    /// Takes bytes that a serial port received; the last one ended at `now`. A CAN port has none.
    ///
    /// Bytes and [`transmit_complete`](Self::transmit_complete) may be handed over in any order: their times decide.
    pub fn receive(&mut self, port: Port, bytes: &[u8], now: Instant) {
        if port == Port::HOST {
            return self.receive_host(bytes, now);
        }
        if let Some((bus, mut cx)) = self.core.serial(port) {
            let waiting = bus.waiting_since();
            bus.receive(bytes, now, &mut cx);
            // a part of a response leaves all else as it was
            let same = waiting.is_some() && bus.waiting_since() == waiting;
            let due = if same { bus.deadline(cx.config) } else { AT_ONCE };
            self.core.shared.idle_until = self.core.shared.idle_until.min(due);
        }
    }

    fn receive_host(&mut self, mut bytes: &[u8], now: Instant) {
        let Self { host, core } = self;
        host.set_silence(core.shared.settings.limits.burst_silence());
        while let Some(event) = host.feed(&HostFraming(core.shared.routes()), &mut bytes, now) {
            core.shared.idle_until = AT_ONCE;
            core.take(&event, now);
            core.apply_asked(now);
        }
        // a part of a frame is nothing to do before silence ends it
        if let Some(end) = host.deadline() {
            core.shared.idle_until = core.shared.idle_until.min(end);
        }
    }

    /// Notices the silence after a burst from the host.
    fn end_host_burst(&mut self, now: Instant) {
        let Self { host, core } = self;
        host.set_silence(core.shared.settings.limits.burst_silence());
        if let Some(event) = host.poll(&HostFraming(core.shared.routes()), now) {
            core.take(&event, now);
            core.apply_asked(now);
        }
    }

    /// A port lost bytes or frames because nobody fetched them in time.
    pub fn overrun(&mut self, port: Port) {
        if let Some(counters) = self.core.shared.counters(port) {
            count(&mut counters.overruns);
        }
    }

    /// A port received something whose checksum, parity or framing was wrong.
    pub fn receive_error(&mut self, port: Port) {
        if let Some(counters) = self.core.shared.counters(port) {
            count(&mut counters.checksum_errors);
        }
    }

    /// An attempt of a CAN port to send a frame failed; the controller tries again by itself.
    pub fn transmit_error(&mut self, port: Port) {
        if let Some(counters) = self.core.shared.counters(port) {
            count(&mut counters.transmit_errors);
        }
    }

    /// What a serial port is to send next. A CAN port has none.
    #[must_use]
    pub fn output(&self, port: Port) -> &[u8] {
        match port.index().checked_sub(1) {
            None => self.core.shared.output.pending(),
            Some(index) => self.core.serial.get(index).map_or(&[], |bus| bus.pending()),
        }
    }

    /// A serial port took so many bytes of [`output`](Self::output).
    pub fn advance(&mut self, port: Port, taken: usize) {
        if taken == 0 {
            return;
        }
        self.core.shared.idle_until = AT_ONCE;
        match port.index().checked_sub(1) {
            None => self.core.shared.output.consume(taken),
            Some(index) => {
                if let Some(bus) = self.core.serial.get_mut(index) {
                    bus.consume(taken);
                }
            }
        }
    }

    /// On an RS485 port the last stop bit of all that it took left at `now`, and the driver is off.
    pub fn transmit_complete(&mut self, port: Port, now: Instant) {
        if let Some((bus, mut cx)) = self.core.serial(port) {
            bus.transmitted(now, &mut cx);
            self.core.shared.idle_until = AT_ONCE;
        }
    }

    /// Takes a frame that a CAN port received and that ended at `now`.
    ///
    /// Frames and [`frame_sent`](Self::frame_sent) may be handed over in any order: their times decide.
    pub fn receive_frame(&mut self, port: Port, frame: &Frame, now: Instant) {
        if let Some((bus, mut cx)) = self.core.can(port) {
            let waiting = bus.waiting_since();
            bus.receive(frame, now, &mut cx);
            // a part of a response leaves all else as it was
            let same = waiting.is_some() && bus.waiting_since() == waiting;
            let due = if same { bus.deadline() } else { AT_ONCE };
            self.core.shared.idle_until = self.core.shared.idle_until.min(due);
        }
    }

    /// The next frame for a CAN port, which takes it.
    pub fn next_frame(&mut self, port: Port) -> Option<Frame> {
        self.core.can(port)?.0.next_frame()
    }

    /// A frame that a CAN port took was acknowledged on the bus at `now`.
    pub fn frame_sent(&mut self, port: Port, now: Instant) {
        self.core.shared.idle_until = AT_ONCE;
        if let Some((bus, mut cx)) = self.core.can(port) {
            bus.frame_sent(now, &mut cx);
        }
    }

    /// A CAN port has no frame to send any more, after [`Action::AbortCan`].
    pub fn frames_aborted(&mut self, port: Port, now: Instant) {
        self.core.shared.idle_until = AT_ONCE;
        if let Some((bus, mut cx)) = self.core.can(port) {
            bus.aborted(now, &mut cx);
        }
    }

    /// Tells that a CAN controller is bus-off, or that it is not. It returns only when it is restarted:
    /// [`Action::RestartCan`] asks for that after 10 ms, twice as long each time in a row, at most 1 s.
    pub fn set_bus_off(&mut self, port: Port, bus_off: bool, now: Instant) {
        match self.core.shared.bus_off.get_mut(port.index()) {
            Some(known) if *known != bus_off => *known = bus_off,
            _ => return,
        }
        self.core.shared.idle_until = AT_ONCE;
        if bus_off && let Some((bus, mut cx)) = self.core.can(port) {
            bus.went_off(now, &mut cx);
        }
    }

    /// Sets what the board found out about itself; that it is bus-off is told by [`set_bus_off`](Self::set_bus_off).
    pub const fn set_health(&mut self, health: Health) {
        self.core.shared.health = health;
    }

    /// What is not well.
    #[must_use]
    pub const fn health(&self) -> Health {
        self.core.shared.health
    }

    /// The board's own units.
    #[must_use]
    pub const fn units(&self) -> &B::Units {
        &self.core.units
    }

    /// The board's own units, to tell them what is at their inputs.
    pub const fn units_mut(&mut self) -> &mut B::Units {
        &mut self.core.units
    }

    /// Settings of a port in use; `None` where the board does not have it.
    #[must_use]
    pub fn port(&self, port: Port) -> Option<&PortConfig> {
        self.core.shared.live.port(port).filter(|_| port.index() < B::DESCRIPTION.ports.len())
    }

    /// Counters of a port.
    #[must_use]
    pub fn counters(&self, port: Port) -> Counters {
        self.core.shared.counters.get(port.index()).copied().unwrap_or_default()
    }

    /// A polling slot and its newest sample; `None` past the last one.
    #[must_use]
    pub fn slot(&self, index: usize) -> Option<&Slot> {
        self.core.shared.polling.slot(index)
    }

    /// Replies to reads that came over CAN with function code 0x10, as the NST manual prints them (4.3.2.10).
    #[must_use]
    pub fn legacy_codes(&self) -> u32 {
        self.core.can.iter().fold(0, |sum, bus| sum.wrapping_add(bus.legacy_codes()))
    }

    /// Writes the settings that [`Action::Store`] asks to store: what is confirmed, and what acts at once.
    pub fn encode_settings(&self, stored: &mut [u8; STORED_LENGTH]) {
        let shared = &self.core.shared;
        Settings { topology: shared.confirmed, ..shared.settings }.encode_into(B::DESCRIPTION, stored);
    }

    /// Tells how [`Action::Store`] ended: the host gets its answer.
    pub fn saved(&mut self, stored: bool) {
        self.core.shared.saved(stored);
    }

    /// Does what is due at `now`, and tells what the firmware is to do; to be called until it tells nothing more, after
    /// anything was handed in or out, and at [`poll_at`](Self::poll_at). Where nothing is due it returns at once.
    pub fn poll(&mut self, now: Instant) -> Option<Action> {
        if now >= self.core.shared.idle_until {
            self.work(now);
        }
        self.core.shared.actions.pop()
    }

    fn work(&mut self, now: Instant) {
        self.core.roll_back(now);
        self.core.host_silence(now);
        self.core.shared.polling.tick(now);
        self.end_host_burst(now);
        for port in B::DESCRIPTION.ports() {
            if let Some((bus, mut cx)) = self.core.serial(port) {
                bus.poll(now, &mut cx);
            } else if let Some((bus, mut cx)) = self.core.can(port) {
                bus.poll(now, &mut cx);
            }
        }
        self.core.shared.idle_until = self.next_due();
    }

    /// Tells whether [`poll`](Self::poll) has nothing to do at `now`: since the last time nothing but parts of frames
    /// was handed in and nothing out, nothing is due, and no action is left. It costs less than [`poll_at`](Self::poll_at).
    #[must_use]
    pub fn is_idle(&self, now: Instant) -> bool {
        now < self.core.shared.idle_until && self.core.shared.actions.is_empty()
    }

    /// When [`poll`](Self::poll) has something to do next, if nothing is handed in or out before.
    #[must_use]
    pub fn poll_at(&self) -> Option<Instant> {
        Some(self.next_due()).filter(|due| *due < Instant::MAX)
    }

    fn next_due(&self) -> Instant {
        let Self { host, core: Core { shared, serial, can, .. } } = self;
        let last_request = shared.last_request.filter(|_| shared.settings.limits.host_silence_ms > 0);
        let silence = last_request.map(|last| last.saturating_add(shared.host_silence_limit()));
        let first = [shared.confirm_until, silence, host.deadline(), Some(shared.polling.deadline())]
            .into_iter()
            .fold(Instant::MAX, |first, due| first.min(due.unwrap_or(Instant::MAX)));
        let [_, ports @ ..] = &shared.live.ports;
        let first = serial.iter().zip(ports).fold(first, |first, (bus, port)| first.min(bus.deadline(port)));
        can.iter().fold(first, |first, bus| first.min(bus.deadline()))
    }
}
