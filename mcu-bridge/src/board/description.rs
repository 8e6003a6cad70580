//! What a board says of itself.

use super::limits::Limits;
use super::local::{LocalKind, LocalUnits};
use super::port::{PORTS_MAX, Port, PortConfig, PortKind};
use super::route::{ROUTES, Route, Target};

/// Most targets of a board.
pub const TARGETS_MAX: usize = 16;

/// A port of a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PortDescription {
    /// Its name in documents and tools, such as `rs485-a`.
    pub name: &'static str,
    /// What it is.
    pub kind: PortKind,
    /// Its default settings.
    pub default: PortConfig,
}

/// What a board calls itself where the host asks for device identification (2B/0E).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identification {
    /// Object 0: the vendor.
    pub vendor: &'static str,
    /// Object 1: the product's code.
    pub product_code: &'static str,
    /// Object 4: the product's name.
    pub product_name: &'static str,
    /// Object 5: the model.
    pub model_name: &'static str,
}

impl Identification {
    /// The name of a board that has none of its own.
    pub const JOINTBUS: Self = Self {
        vendor: "Jointbus",
        product_code: "jointbus-mcu-bridge",
        product_name: "Jointbus",
        model_name: "NST, NXI-6201 and NDAM-9010 bridge",
    };
}

/// What a board says of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Description {
    /// Its number in the register map.
    pub number: u16,
    /// Its name in documents and tools.
    pub name: &'static str,
    /// Its name for the host.
    pub identification: Identification,
    /// The host's port, then the serial buses, then the CAN buses.
    pub ports: &'static [PortDescription],
    /// The board's own units in the order of their targets: [`LocalUnits::KINDS`].
    pub local: &'static [LocalKind],
    /// The default routes, at most [`ROUTES`]; one leads to [`Target::Bridge`].
    pub routes: &'static [Route],
    /// The default limits.
    pub limits: Limits,
}

/// A board: its description and the type of its own units.
///
/// ```
/// use jointbus_mcu_bridge::board::*;
/// use jointbus_mcu_bridge::engine;
///
/// /// A host port and one RS485 bus with NST sensors at addresses 1 to 15.
/// #[derive(Debug)]
/// struct Sensors;
///
/// impl Board for Sensors {
///     const DESCRIPTION: &'static Description = &Description {
///         number: 0x8000,
///         name: "sensors",
///         identification: Identification { product_name: "Joint 3", ..Identification::JOINTBUS },
///         ports: &[
///             PortDescription {
///                 name: "host",
///                 kind: PortKind::Serial { clock: UartClock::ANY },
///                 default: PortConfig::serial(921_600, 0),
///             },
///             PortDescription {
///                 name: "rs485",
///                 kind: PortKind::Serial { clock: UartClock::ANY },
///                 default: PortConfig::serial(115_200, 0),
///             },
///         ],
///         local: <() as LocalUnits>::KINDS,
///         routes: &[
///             Route::remote(1, 15, Target::Bus(Port::new(1)), Protocol::Nst, 1),
///             Route::local(247, Target::Bridge),
///         ],
///         limits: Limits::DEFAULT,
///     };
///     type Units = ();
/// }
///
/// type Engine = engine::Engine<
///     Sensors,
///     { Sensors::DESCRIPTION.serial_buses() },
///     { Sensors::DESCRIPTION.can_buses() },
/// >;
/// # let identity = engine::Identity { version: [1, 0, 0], reset_cause: engine::ResetCause::PowerOn };
/// # let _ = Engine::new(identity, jointbus_protocol::time::Instant::from_micros(0));
/// ```
pub trait Board: core::fmt::Debug + 'static {
    /// What it says of itself.
    const DESCRIPTION: &'static Description;
    /// The units that it serves by itself; `()` where it has none.
    type Units: LocalUnits;
}

impl Description {
    /// Number of serial buses; the host's port is none.
    #[must_use]
    pub const fn serial_buses(&self) -> usize {
        let mut count = 0usize;
        let mut ports = self.ports;
        while let [port, rest @ ..] = ports {
            if matches!(port.kind, PortKind::Serial { .. }) {
                count = count.wrapping_add(1);
            }
            ports = rest;
        }
        count.saturating_sub(1)
    }

    /// Number of CAN buses.
    #[must_use]
    pub const fn can_buses(&self) -> usize {
        self.ports.len().saturating_sub(1).saturating_sub(self.serial_buses())
    }

    /// All ports, the host's first.
    pub fn ports(&self) -> impl DoubleEndedIterator<Item = Port> + ExactSizeIterator + Clone + use<> {
        (0..self.ports.len().min(PORTS_MAX) as u8).map(Port::new)
    }

    /// A port of the board.
    #[must_use]
    pub fn port(&self, port: Port) -> Option<&'static PortDescription> {
        self.ports.get(port.index())
    }

    /// Number of targets: the buses, the board's own units and the bridge itself.
    #[must_use]
    pub const fn targets(&self) -> usize {
        self.ports.len().saturating_add(self.local.len())
    }

    /// The target with this number in a route register: buses first, then the board's own units, then the bridge.
    #[must_use]
    pub const fn target(&self, number: u16) -> Option<Target> {
        let (number, buses) = (number as usize, self.ports.len().saturating_sub(1));
        let local = number.saturating_sub(buses);
        if number == 0 {
            None
        } else if number <= buses {
            Some(Target::Bus(Port::new(number as u8)))
        } else if local <= self.local.len() {
            Some(Target::Local(local.saturating_sub(1) as u8))
        } else if number == self.targets() {
            Some(Target::Bridge)
        } else {
            None
        }
    }

    /// Number of a target in a route register.
    #[must_use]
    pub const fn target_number(&self, target: Target) -> u16 {
        match target {
            Target::Bus(port) => port.number() as u16,
            Target::Local(index) => (self.ports.len() as u16).saturating_add(index as u16),
            Target::Bridge => self.targets() as u16,
        }
    }

    /// Whether a target is a CAN bus.
    #[must_use]
    pub fn is_can(&self, target: Target) -> bool {
        target.port().and_then(|port| self.port(port)).is_some_and(|port| port.kind == PortKind::Can)
    }

    /// Whether it describes a board that the engine can serve; checked where the engine is compiled.
    #[must_use]
    pub const fn is_sound(&self) -> bool {
        let Some((host, mut buses)) = self.ports.split_first() else { return false };
        let mut sound = matches!(host.kind, PortKind::Serial { .. })
            && self.ports.len() <= PORTS_MAX
            && self.targets() <= TARGETS_MAX
            && self.routes.len() <= ROUTES;
        // serial buses before CAN buses
        let mut was_can = false;
        while let [bus, rest @ ..] = buses {
            let is_can = matches!(bus.kind, PortKind::Can);
            sound &= is_can || !was_can;
            was_can = is_can;
            buses = rest;
        }
        sound
    }
}
