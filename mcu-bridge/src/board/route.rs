//! Routes: where the units that the host sees are.

use super::port::Port;
use jointbus_protocol::time::Duration;

/// Number of routes.
pub const ROUTES: usize = 16;

/// Where a route leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// The bus on a port.
    Bus(Port),
    /// One of the board's own units, by its place in [`LocalUnits`](super::LocalUnits).
    Local(u8),
    /// The bridge itself.
    Bridge,
}

impl Target {
    /// Its port, if it has one.
    #[must_use]
    pub const fn port(self) -> Option<Port> {
        match self {
            Self::Bus(port) => Some(port),
            Self::Local(_) | Self::Bridge => None,
        }
    }
}

/// What is spoken on a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Protocol {
    /// Modbus RTU.
    ModbusRtu,
    /// Modbus ASCII on the bus; the host frames it as RTU.
    ModbusAscii,
    /// NST with CRC.
    Nst,
    /// NST over CAN.
    NstOverCan,
}

impl Protocol {
    /// The protocol with this number in a route register.
    #[must_use]
    pub const fn from_value(value: u16) -> Option<Self> {
        match value {
            0 => Some(Self::ModbusRtu),
            1 => Some(Self::ModbusAscii),
            2 => Some(Self::Nst),
            3 => Some(Self::NstOverCan),
            _ => None,
        }
    }

    /// Its number in a route register.
    #[must_use]
    pub const fn value(self) -> u16 {
        match self {
            Self::ModbusRtu => 0,
            Self::ModbusAscii => 1,
            Self::Nst => 2,
            Self::NstOverCan => 3,
        }
    }

    /// Whether the host frames requests on this route as NST.
    #[must_use]
    pub const fn is_nst(self) -> bool {
        matches!(self, Self::Nst | Self::NstOverCan)
    }
}

/// One row of the routing table; the first that matches wins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Route {
    /// First unit that the host sees.
    pub first_unit: u8,
    /// Last unit that the host sees; 0 with a first unit of 0 leaves the row unused.
    pub last_unit: u8,
    /// Where it leads.
    pub target: Target,
    /// What is spoken there.
    pub protocol: Protocol,
    /// Address of the first unit over there.
    pub first_address: u8,
    /// Time that a device has to answer a read, in ms, 1 and up.
    pub read_timeout_ms: u16,
    /// Time that a device has to answer anything else, in ms, 1 and up.
    pub write_timeout_ms: u16,
    /// How often a read is sent again, 0 to 9.
    pub read_retries: u8,
    /// Time after which a request is no longer sent, in ms, 1 and up.
    pub time_to_live_ms: u16,
    /// How long a late response is waited for, in ms; 0 stands for three times the timeout.
    pub late_response_window_ms: u16,
    /// Whether writes and commands are refused.
    pub refuse_writes: bool,
}

impl Route {
    /// An unused row.
    pub const UNUSED: Self = Self::local(0, Target::Bridge);

    /// A row for one of the board's own units, or for the bridge itself.
    #[must_use]
    pub const fn local(unit: u8, target: Target) -> Self {
        Self::remote(unit, unit, target, Protocol::ModbusRtu, unit)
    }

    /// A row for units on a bus, with the default times of its protocol: 50 ms for a read and 100 ms to live on NST,
    /// 200 ms and 1000 ms on Modbus, 500 ms for a write, one retry.
    #[must_use]
    pub const fn remote(
        first_unit: u8,
        last_unit: u8,
        target: Target,
        protocol: Protocol,
        first_address: u8,
    ) -> Self {
        let (read_timeout_ms, time_to_live_ms) = if protocol.is_nst() { (50, 100) } else { (200, 1000) };
        Self {
            first_unit,
            last_unit,
            target,
            protocol,
            first_address,
            read_timeout_ms,
            write_timeout_ms: 500,
            read_retries: 1,
            time_to_live_ms,
            late_response_window_ms: 0,
            refuse_writes: false,
        }
    }

    /// Whether the row is in use.
    #[must_use]
    pub const fn is_used(&self) -> bool {
        self.first_unit != 0 || self.last_unit != 0
    }

    /// Whether it leads to `unit`.
    #[must_use]
    pub const fn serves(&self, unit: u8) -> bool {
        self.is_used() && self.first_unit <= unit && unit <= self.last_unit
    }

    /// Address over there of a unit that it serves.
    #[must_use]
    pub const fn remote_of(&self, unit: u8) -> u8 {
        self.first_address.wrapping_add(unit.wrapping_sub(self.first_unit))
    }

    /// Time that a device has to answer.
    #[must_use]
    pub const fn timeout(&self, is_read: bool) -> Duration {
        let millis = if is_read { self.read_timeout_ms } else { self.write_timeout_ms };
        Duration::from_millis(millis as u64)
    }

    /// How long a late response is waited for after a timeout.
    #[must_use]
    pub const fn late_response_window(&self, is_read: bool) -> Duration {
        match self.late_response_window_ms {
            0 => self.timeout(is_read).saturating_mul(3),
            millis => Duration::from_millis(millis as u64),
        }
    }
}
