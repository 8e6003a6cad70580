//! The state of the bridge behind the host's decoder, and how each bus gets at what it may touch.

use super::actions::Pending;
use super::can_bus::CanBus;
use super::context::{Context, HostSide, ReplyTime};
use super::counters::Counters;
use super::host::Output;
use super::identity::{Health, Identity, ResetCause};
use super::polling::Polling;
use super::quarantine::Quarantine;
use super::router::{Router, Routes};
use super::serial_bus::SerialBus;
use super::settings::Settings;
use crate::board::{Board, LocalUnits, PORTS_MAX, Port, ROUTES, Topology};
use jointbus_protocol::time::{Duration, Instant};

/// The time of what is due already.
pub(super) const AT_ONCE: Instant = Instant::from_micros(0);

/// A save that the host waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Saving {
    /// There is none.
    No,
    /// Asked for under this unit.
    Asked(u8),
}

/// What function code 08 counts beside the host port's counters.
#[derive(Debug, Clone, Copy)]
pub(super) struct Diagnostics {
    /// Requests to the bridge itself.
    pub(super) requests: u16,
    /// Exceptions with which it answered.
    pub(super) exceptions: u16,
}

impl Diagnostics {
    pub(super) const ZERO: Self = Self { requests: 0, exceptions: 0 };
}

/// The bridge behind the host's decoder.
#[derive(Debug)]
pub(super) struct Core<B: Board, const SERIAL: usize, const CAN: usize> {
    pub(super) shared: Shared,
    pub(super) serial: [SerialBus; SERIAL],
    pub(super) can: [CanBus; CAN],
    pub(super) units: B::Units,
}

/// What is the same for every board.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) identity: Identity,
    pub(super) health: Health,
    pub(super) live: Topology,
    /// Of the live topology.
    pub(super) router: Router,
    /// The staged topology; the limits and slots in force.
    pub(super) settings: Settings,
    pub(super) confirmed: Topology,
    pub(super) confirm_until: Option<Instant>,
    pub(super) saving: Saving,
    pub(super) actions: Pending,
    /// The staged topology is to go live, once the request for that has been answered.
    pub(super) apply: bool,
    pub(super) output: Output,
    pub(super) counters: [Counters; PORTS_MAX],
    pub(super) bus_off: [bool; PORTS_MAX],
    pub(super) reply_times: [ReplyTime; ROUTES],
    pub(super) diagnostics: Diagnostics,
    pub(super) quarantine: Quarantine,
    pub(super) polling: Polling,
    /// When the last valid request came, until host silence has switched the outputs off.
    pub(super) last_request: Option<Instant>,
    /// Nothing is due before this, as far as was known when it was looked at last, and nothing has come since.
    pub(super) idle_until: Instant,
}

impl<B: Board, const SERIAL: usize, const CAN: usize> Core<B, SERIAL, CAN> {
    /// The state before the start, in zeros.
    pub(super) const fn new() -> Self {
        const {
            let board = B::DESCRIPTION;
            assert!(board.is_sound(), "the board's description does not fit together");
            assert!(board.serial_buses() == SERIAL, "the board has another number of serial buses");
            assert!(board.can_buses() == CAN, "the board has another number of CAN buses");
            assert!(board.local.len() == B::Units::KINDS.len(), "the board has other units of its own");
        }
        Self {
            shared: Shared::ZERO,
            serial: [const { SerialBus::new() }; SERIAL],
            can: [const { CanBus::new() }; CAN],
            units: B::Units::NEW,
        }
    }

    /// A serial bus, and what it may touch.
    pub(super) fn serial(&mut self, port: Port) -> Option<(&mut SerialBus, Context<'_>)> {
        let bus = self.serial.get_mut(port.index().checked_sub(1)?)?;
        Some((bus, self.shared.context(port)?))
    }

    /// A CAN bus, and what it may touch.
    pub(super) fn can(&mut self, port: Port) -> Option<(&mut CanBus, Context<'_>)> {
        let bus = self.can.get_mut(port.index().checked_sub(SERIAL.wrapping_add(1))?)?;
        Some((bus, self.shared.context(port)?))
    }
}

impl Shared {
    const ZERO: Self = Self {
        identity: Identity { version: [0; 3], reset_cause: ResetCause::PowerOn },
        health: Health { internal_oscillator: false, no_can: false, defaulted: false },
        live: Topology::ZERO,
        router: Router::ZERO,
        settings: Settings::ZERO,
        confirmed: Topology::ZERO,
        confirm_until: None,
        saving: Saving::No,
        actions: Pending::NONE,
        apply: false,
        output: Output::new(),
        counters: [Counters::ZERO; PORTS_MAX],
        bus_off: [false; PORTS_MAX],
        reply_times: [ReplyTime::NONE; ROUTES],
        diagnostics: Diagnostics::ZERO,
        quarantine: Quarantine::new(),
        polling: Polling::new(),
        last_request: None,
        idle_until: AT_ONCE,
    };

    /// What the bus on a port may touch; the host's port is no bus.
    pub(super) fn context(&mut self, port: Port) -> Option<Context<'_>> {
        let [host, buses @ ..] = &mut self.counters;
        Some(Context {
            host: HostSide { output: &mut self.output, counters: host },
            port,
            config: self.live.ports.get(port.index())?,
            counters: buses.get_mut(port.index().checked_sub(1)?)?,
            reply_times: &mut self.reply_times,
            quarantine: &mut self.quarantine,
            limits: &self.settings.limits,
            routes: Routes { router: &self.router, topology: &self.live },
            polling: &mut self.polling,
            actions: &mut self.actions,
        })
    }

    /// Counters of a port.
    pub(super) fn counters(&mut self, port: Port) -> Option<&mut Counters> {
        self.counters.get_mut(port.index())
    }

    pub(super) const fn routes(&self) -> Routes<'_> {
        Routes { router: &self.router, topology: &self.live }
    }

    pub(super) const fn host_silence_limit(&self) -> Duration {
        Duration::from_millis(self.settings.limits.host_silence_ms as u64)
    }
}
