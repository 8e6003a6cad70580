//! The bridge itself: bytes, frames and the time go in; bytes, frames and the next deadline come out. It reads no
//! clock and touches no port, and every call does bounded work.

mod can;
pub mod config;
mod counters;
mod dispatch;
mod host;
mod io;
mod management;
mod polling;
mod quarantine;
mod queue;
mod response;
pub mod router;
mod serial;
mod settings;
mod transaction;

use can::CanBus;
use config::{Limits, Port, PortConfig, ROUTES, Target, Topology};
use counters::count;
use host::{HostDeframer, Output};
use io::{Analog, LocalIo, LocalOutputs};
use jointbus_protocol::can::Frame;
use jointbus_protocol::ndam9010::Layout;
use jointbus_protocol::nxi6201;
use jointbus_protocol::time::{Duration, Instant};
use management::{Diagnostics, Saving};
use polling::Polling;
use quarantine::Quarantine;
use router::{Router, Routes};
use serial::SerialBus;
use transaction::{HostSide, ReplyTime, Surroundings};

pub use counters::Counters;
pub use management::{CONFIRM_WITHIN, Command, Health, Identity, MAP_VERSION, ResetCause};
pub use polling::{SLOTS, Slot, SlotState};
pub use settings::{STORED_LENGTH, Settings, SlotSettings};

/// Channels of the board as an NDAM module.
pub const LOCAL_IO: Layout =
    Layout { digital_inputs: 8, digital_outputs: 8, analog_inputs: 4, analog_outputs: 0 };

/// What becomes of ports and routes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Change {
    /// Nothing is to be changed.
    None,
    /// The staged ones go live.
    Apply,
    /// The confirmed ones go live, and are staged.
    RollBack,
    /// The defaults are staged.
    Defaults,
}

/// The bridge.
#[derive(Debug)]
pub struct Engine {
    /// Apart from all else, because its frames are worked on where they are.
    host: HostDeframer,
    core: Core,
}

/// The bridge behind its door.
#[derive(Debug)]
struct Core {
    identity: Identity,
    health: Health,
    live: Topology,
    /// Of the live network.
    router: Router,
    staged: Topology,
    confirmed: Topology,
    confirm_until: Option<Instant>,
    limits: Limits,
    command: Option<Command>,
    saving: Saving,
    /// Ports whose settings changed and whose owner has not been told.
    changed_ports: [bool; 4],
    /// To be made once its request has been answered.
    change: Change,
    output: Output,
    counters: [Counters; 4],
    reply_times: [ReplyTime; ROUTES],
    diagnostics: Diagnostics,
    quarantine: Quarantine,
    polling: Polling,
    rs485_a: SerialBus,
    rs485_b: SerialBus,
    can: CanBus,
    outputs: nxi6201::Card<LocalOutputs>,
    io: LocalIo,
    /// When the last valid request came, until host silence has switched the outputs off.
    last_request: Option<Instant>,
    /// Nothing is due before this, as far as [`Engine::poll`] knew, and nothing has come since.
    idle_until: Instant,
}

/// The moment of what is due already.
const AT_ONCE: Instant = Instant::from_micros(0);

/// Memory for an [`Engine`] that has not started. It is all zeros: a static one lies in `.bss` and takes no flash, and
/// nothing of the engine is ever on the stack.
#[derive(Debug)]
pub struct Storage(Engine);

impl Default for Storage {
    fn default() -> Self {
        Self::new()
    }
}

impl Storage {
    /// The memory.
    #[must_use]
    pub const fn new() -> Self {
        Self(Engine {
            host: HostDeframer::new(Duration::ZERO),
            core: Core {
                identity: Identity { version: [0; 3], reset_cause: ResetCause::PowerOn },
                health: Health { internal_oscillator: false, no_can: false, defaulted: false },
                live: Topology::ZERO,
                router: Router::ZERO,
                staged: Topology::ZERO,
                confirmed: Topology::ZERO,
                confirm_until: None,
                limits: Limits::ZERO,
                command: None,
                saving: Saving::No,
                changed_ports: [false; 4],
                change: Change::None,
                output: Output::new(),
                counters: [Counters::ZERO; 4],
                reply_times: [ReplyTime::NONE; ROUTES],
                diagnostics: Diagnostics::ZERO,
                quarantine: Quarantine::new(),
                polling: Polling::new(),
                rs485_a: SerialBus::new(),
                rs485_b: SerialBus::new(),
                can: CanBus::new(),
                outputs: nxi6201::Card::resume(LocalOutputs::new(), NO_OUTPUTS),
                io: LocalIo::new(),
                last_request: None,
                idle_until: AT_ONCE,
            },
        })
    }

    /// The bridge, with the default settings: see [`Engine::restore`].
    pub fn start(&'static mut self, identity: Identity, now: Instant) -> &'static mut Engine {
        self.0.start(identity, now);
        &mut self.0
    }
}

/// Registers of the board's outputs before the start, in zeros.
const NO_OUTPUTS: nxi6201::Settings = {
    let channel = nxi6201::Channel {
        range: nxi6201::OutputRange::Volts5,
        set_value: 0.0,
        output: false,
        start_enable: 0,
        start_range: nxi6201::OutputRange::Volts5,
        start_value: 0.0,
        external: nxi6201::External::Off,
    };
    nxi6201::Settings { channels: [channel; nxi6201::CHANNELS], can_bit_rate: 0, can_id: 0, keep: false }
};

impl Engine {
    /// A bridge that starts at `now`, with the default settings: see [`Engine::restore`]. Where memory is scarce,
    /// [`Storage`] does the same without a copy.
    #[must_use]
    pub fn new(identity: Identity, now: Instant) -> Self {
        let Storage(mut engine) = Storage::new();
        engine.start(identity, now);
        engine
    }

    fn start(&mut self, identity: Identity, now: Instant) {
        let Self { host, core } = self;
        host.set_silence(Limits::DEFAULT.burst_silence());
        core.identity = identity;
        core.limits = Limits::DEFAULT;
        for network in [&mut core.live, &mut core.staged, &mut core.confirmed] {
            *network = Topology::DEFAULT;
        }
        core.router.learn(&core.live);
        core.can.start(Topology::DEFAULT.port(Port::Can).node);
        let Ok(outputs) = nxi6201::Card::power_up(LocalOutputs::new(), &nxi6201::Settings::default());
        core.outputs = outputs;
        core.last_request = Some(now);
        core.polling.clear();
        core.rs485_a.start(now);
        core.rs485_b.start(now);
    }

    /// Takes bytes that a serial port received; the last one ended at `now`. The CAN port has none.
    pub fn receive(&mut self, port: Port, bytes: &[u8], now: Instant) {
        self.core.idle_until = AT_ONCE;
        match port {
            Port::Host => self.receive_host(bytes, now),
            Port::Rs485A => self.core.on_serial(port, |bus, cx| bus.receive(bytes, now, cx)),
            Port::Rs485B => self.core.on_serial(port, |bus, cx| bus.receive(bytes, now, cx)),
            Port::Can => {}
        }
    }

    /// A port lost bytes or frames because nobody fetched them in time.
    pub fn overrun(&mut self, port: Port) {
        if let Some(counters) = self.core.counters.get_mut(port.index()) {
            count(&mut counters.overruns);
        }
    }

    /// What a serial port is to send next. The CAN port has none.
    #[must_use]
    pub fn output(&self, port: Port) -> &[u8] {
        match port {
            Port::Host => self.core.output.pending(),
            Port::Rs485A => self.core.rs485_a.pending(),
            Port::Rs485B => self.core.rs485_b.pending(),
            Port::Can => &[],
        }
    }

    /// A serial port took so many bytes of [`Engine::output`].
    pub fn advance(&mut self, port: Port, taken: usize) {
        if taken == 0 {
            return;
        }
        self.core.idle_until = AT_ONCE;
        match port {
            Port::Host => self.core.output.consume(taken),
            Port::Rs485A => self.core.rs485_a.consume(taken),
            Port::Rs485B => self.core.rs485_b.consume(taken),
            Port::Can => {}
        }
    }

    /// On an RS485 port the last stop bit of all that it took has left, and the driver is off.
    pub fn transmit_complete(&mut self, port: Port, now: Instant) {
        self.core.idle_until = AT_ONCE;
        self.core.on_serial(port, |bus, cx| bus.transmitted(now, cx));
    }

    /// Takes a frame that the CAN port received and that ended at `now`.
    pub fn receive_frame(&mut self, frame: &Frame, now: Instant) {
        self.core.idle_until = AT_ONCE;
        let (can, mut cx) = self.core.can_parts();
        can.receive(frame, now, &mut cx);
    }

    /// The next frame for the CAN port, which takes it.
    pub fn next_frame(&mut self) -> Option<Frame> {
        self.core.can.next_frame()
    }

    /// A frame that the CAN port took was acknowledged on the bus.
    pub fn frame_sent(&mut self, now: Instant) {
        self.core.idle_until = AT_ONCE;
        let (can, mut cx) = self.core.can_parts();
        can.frame_sent(now, &mut cx);
    }

    /// Whether the CAN port is to give up the frames that it has not sent; it answers with [`Engine::frames_aborted`].
    #[must_use]
    pub fn wants_abort(&self) -> bool {
        self.core.can.wants_abort()
    }

    /// The CAN port has no frame to send any more.
    pub fn frames_aborted(&mut self, now: Instant) {
        self.core.idle_until = AT_ONCE;
        let (can, mut cx) = self.core.can_parts();
        can.aborted(now, &mut cx);
    }

    /// An attempt of the CAN port to send a frame failed; the controller tries again by itself.core.
    pub const fn transmit_error(&mut self) {
        let [.., can] = &mut self.core.counters;
        count(&mut can.transmit_errors);
    }

    /// A serial or CAN port received something whose checksum, parity or framing was wrong.
    pub fn receive_error(&mut self, port: Port) {
        if let Some(counters) = self.core.counters.get_mut(port.index()) {
            count(&mut counters.checksum_errors);
        }
    }

    /// Whether the CAN controller is bus-off now. It returns only when it is restarted: see [`Engine::take_can_restart`].
    pub fn set_bus_off(&mut self, bus_off: bool, now: Instant) {
        if bus_off == self.core.can.is_off() {
            return;
        }
        self.core.idle_until = AT_ONCE;
        let (can, mut cx) = self.core.can_parts();
        can.set_off(bus_off, now, &mut cx);
    }

    /// Whether the CAN controller is to be restarted after it went bus-off, once a time: after 10 ms, twice as long
    /// each time in a row, at most 1 s.
    pub fn take_can_restart(&mut self, now: Instant) -> bool {
        self.core.can.take_restart(now)
    }

    /// What the board found out about itself; that it is bus-off is told by [`Engine::set_bus_off`].
    pub const fn set_health(&mut self, health: Health) {
        self.core.health = health;
    }

    /// What is not well.
    #[must_use]
    pub const fn health(&self) -> Health {
        self.core.health
    }

    /// The state of the board's digital inputs, DI0 in bit 0, and its analog inputs, `None` where they can't be measured.
    /// What is not known is answered with exception 04 by unit 40.
    pub fn set_inputs(&mut self, digital: u16, analog: impl Into<Option<Analog>>) {
        self.core.io.inputs = Some(digital);
        self.core.io.analog = analog.into();
    }

    /// What the board's analog outputs are to be.
    #[must_use]
    pub const fn analog_outputs(&self) -> &nxi6201::Settings {
        self.core.outputs.settings()
    }

    /// Whether [`Engine::analog_outputs`] has been written since this was asked last.
    pub const fn take_output_change(&mut self) -> bool {
        self.core.outputs.hardware().take_change()
    }

    /// What the board's digital outputs are to be, DO0 in bit 0.
    #[must_use]
    pub const fn digital_outputs(&self) -> u16 {
        self.core.io.outputs
    }

    /// A command for the firmware, once; to be carried out when [`Engine::output`] of the host has been sent.
    pub const fn take_command(&mut self) -> Option<Command> {
        self.core.command.take()
    }

    /// Whether [`Engine::take_port_change`] has something for any port.
    #[must_use]
    pub fn has_port_change(&self) -> bool {
        self.core.changed_ports.contains(&true)
    }

    /// The new settings of a port, once after they have changed.
    pub fn take_port_change(&mut self, port: Port) -> Option<PortConfig> {
        let changed = self.core.changed_ports.get_mut(port.index())?;
        core::mem::take(changed).then(|| *self.core.live.port(port))
    }

    /// Settings of a port in use.
    #[must_use]
    pub const fn port(&self, port: Port) -> &PortConfig {
        self.core.live.port(port)
    }

    /// Counters of a port.
    #[must_use]
    pub fn counters(&self, port: Port) -> Counters {
        self.core.counters.get(port.index()).copied().unwrap_or_default()
    }

    /// A polling slot and its newest sample; `None` past the last one.
    #[must_use]
    pub fn slot(&self, index: usize) -> Option<&Slot> {
        self.core.polling.slot(index)
    }

    /// Replies to reads that came over CAN with function code 0x10, as the NST manual prints them (4.3.2.10).
    #[must_use]
    pub const fn legacy_codes(&self) -> u32 {
        self.core.can.legacy_codes()
    }

    /// Does what is due at `now`; where nothing has come since the last time, and nothing is due, that is at once done.
    pub fn poll(&mut self, now: Instant) {
        if now < self.core.idle_until {
            return;
        }
        self.core.roll_back(now);
        self.core.host_silence(now);
        self.core.polling.tick(now);
        self.end_host_burst(now);
        for port in [Port::Rs485A, Port::Rs485B] {
            self.core.on_serial(port, |bus, cx| bus.poll(now, cx));
        }
        let (can, mut cx) = self.core.can_parts();
        can.poll(now, &mut cx);
        self.core.idle_until = self.next_due();
    }

    /// When [`Engine::poll`] has something to do next, if nothing is received or sent before.
    #[must_use]
    pub fn poll_at(&self) -> Option<Instant> {
        Some(self.next_due()).filter(|due| *due < Instant::MAX)
    }

    #[inline(never)] // what it needs of the stack is not needed beside what is done
    fn next_due(&self) -> Instant {
        let Self { host, core } = self;
        let silence = core.last_request.filter(|_| core.limits.host_silence_ms > 0);
        core.confirm_until
            .unwrap_or(Instant::MAX)
            .min(silence.map_or(Instant::MAX, |last| last.saturating_add(core.host_silence_limit())))
            .min(host.deadline().unwrap_or(Instant::MAX))
            .min(core.polling.deadline())
            .min(core.rs485_a.deadline(core.live.port(Port::Rs485A)))
            .min(core.rs485_b.deadline(core.live.port(Port::Rs485B)))
            .min(core.can.deadline())
    }
}

impl Core {
    /// Changes ports and routes, dropping what waits or is in flight where something changed.
    fn change(&mut self, change: Change, now: Instant) {
        let Self { live, router, staged, confirmed, quarantine, changed_ports, .. } = self;
        let next = match change {
            Change::None => return,
            Change::Defaults => {
                *staged = Topology::default();
                return;
            }
            Change::Apply => &*staged,
            Change::RollBack => {
                *staged = *confirmed;
                &*confirmed
            }
        };
        let mut moved = [false; 4];
        for (old, new) in live.routes.iter().zip(&next.routes).filter(|(old, new)| !old.reads_as(new)) {
            for row in [old, new] {
                quarantine.forget(row);
                if let Some(moved) = row.bus.port().and_then(|port| moved.get_mut(port.index())) {
                    *moved = true;
                }
            }
        }
        for ((old, new), (moved, changed)) in
            live.ports.iter().zip(&next.ports).zip(moved.iter_mut().zip(changed_ports))
        {
            let is_changed = !old.reads_as(new);
            *moved |= is_changed;
            *changed |= is_changed;
        }
        *live = *next;
        router.learn(live);
        let [_, rs485_a, rs485_b, can] = moved;
        for (port, moved) in [(Port::Rs485A, rs485_a), (Port::Rs485B, rs485_b)] {
            if moved {
                self.on_serial(port, |bus, cx| bus.reset(now, cx));
            }
        }
        if can {
            let node = self.live.port(Port::Can).node;
            let (can, mut cx) = self.can_parts();
            can.reset(node, &mut cx);
        }
    }

    const fn routes(&self) -> Routes<'_> {
        Routes { router: &self.router, network: &self.live }
    }

    const fn host_silence_limit(&self) -> Duration {
        Duration::from_millis(self.limits.host_silence_ms as u64)
    }

    /// Switches the local outputs off when the host was silent for too long; only the host switches on again.
    fn host_silence(&mut self, now: Instant) {
        let limit = self.host_silence_limit();
        if limit > Duration::ZERO
            && self.last_request.is_some_and(|last| now.saturating_duration_since(last) >= limit)
        {
            self.last_request = None;
            let Ok(()) = self.outputs.outputs_off();
            self.io.outputs = 0;
        }
    }

    fn on_serial(&mut self, port: Port, run: impl FnOnce(&mut SerialBus, &mut Surroundings<'_>)) {
        if let Some((bus, mut cx)) = self.serial_parts(port) {
            run(bus, &mut cx);
        }
    }

    #[inline(never)] // asked in many places
    fn serial_parts(&mut self, port: Port) -> Option<(&mut SerialBus, Surroundings<'_>)> {
        let [host, rs485_a, rs485_b, _] = &mut self.counters;
        let (bus, counters) = match port {
            Port::Rs485A => (&mut self.rs485_a, rs485_a),
            Port::Rs485B => (&mut self.rs485_b, rs485_b),
            Port::Host | Port::Can => return None,
        };
        let cx = Surroundings {
            host: HostSide { output: &mut self.output, counters: host },
            port: self.live.port(port),
            counters,
            reply_times: &mut self.reply_times,
            quarantine: &mut self.quarantine,
            limits: &self.limits,
            routes: Routes { router: &self.router, network: &self.live },
            bus: if port == Port::Rs485A { Target::Rs485A } else { Target::Rs485B },
            polling: &mut self.polling,
        };
        Some((bus, cx))
    }

    #[inline(never)] // likewise
    fn can_parts(&mut self) -> (&mut CanBus, Surroundings<'_>) {
        let [host, _, _, counters] = &mut self.counters;
        let cx = Surroundings {
            host: HostSide { output: &mut self.output, counters: host },
            port: self.live.port(Port::Can),
            counters,
            reply_times: &mut self.reply_times,
            quarantine: &mut self.quarantine,
            limits: &self.limits,
            routes: Routes { router: &self.router, network: &self.live },
            bus: Target::Can,
            polling: &mut self.polling,
        };
        (&mut self.can, cx)
    }
}
