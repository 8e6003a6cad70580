//! What can be changed through the bridge's own unit: ports, routes and limits, with their defaults.

use jointbus_protocol::ndam9010;
use jointbus_protocol::time::Duration;

/// Ports of the bridge, in the order of its registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Port {
    /// The host, full duplex.
    Host,
    /// First RS485 bus.
    Rs485A,
    /// Second RS485 bus.
    Rs485B,
    /// CAN bus.
    Can,
}

impl Port {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Host, Self::Rs485A, Self::Rs485B, Self::Can];

    /// Number of the port in the register map.
    #[must_use]
    pub const fn index(self) -> usize {
        match self {
            Self::Host => 0,
            Self::Rs485A => 1,
            Self::Rs485B => 2,
            Self::Can => 3,
        }
    }
}

/// Where a route leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// First RS485 bus.
    Rs485A,
    /// Second RS485 bus.
    Rs485B,
    /// CAN bus.
    Can,
    /// The board's own four outputs, as an NXI-6201.
    LocalOutputs,
    /// The board's own inputs and outputs, as an NDAM module.
    LocalIo,
    /// The bridge itself.
    Bridge,
}

impl Target {
    /// The bus with this number in a route register.
    #[must_use]
    pub const fn from_value(value: u16) -> Option<Self> {
        match value {
            1 => Some(Self::Rs485A),
            2 => Some(Self::Rs485B),
            3 => Some(Self::Can),
            4 => Some(Self::LocalOutputs),
            5 => Some(Self::LocalIo),
            6 => Some(Self::Bridge),
            _ => None,
        }
    }

    /// Its port, if it has one.
    #[must_use]
    pub const fn port(self) -> Option<Port> {
        match self {
            Self::Rs485A => Some(Port::Rs485A),
            Self::Rs485B => Some(Port::Rs485B),
            Self::Can => Some(Port::Can),
            Self::LocalOutputs | Self::LocalIo | Self::Bridge => None,
        }
    }

    /// Its number in a route register.
    #[must_use]
    pub const fn value(self) -> u16 {
        match self {
            Self::Rs485A => 1,
            Self::Rs485B => 2,
            Self::Can => 3,
            Self::LocalOutputs => 4,
            Self::LocalIo => 5,
            Self::Bridge => 6,
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
    pub bus: Target,
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
    /// How long a reply is owed, in ms; 0 stands for three times the timeout.
    pub late_response_window_ms: u16,
    /// Whether writes and commands are refused.
    pub refuse_writes: bool,
}

impl Route {
    /// An unused row.
    pub const UNUSED: Self = Self::local(0, Target::Bridge);

    /// A row for one of the board's own units.
    const fn local(unit: u8, bus: Target) -> Self {
        Self::remote(unit, unit, bus, Protocol::ModbusRtu, unit)
    }

    const fn remote(
        first_unit: u8,
        last_unit: u8,
        bus: Target,
        protocol: Protocol,
        first_address: u8,
    ) -> Self {
        let (read_timeout_ms, time_to_live_ms) = if protocol.is_nst() { (50, 100) } else { (200, 1000) };
        Self {
            first_unit,
            last_unit,
            bus,
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

    /// How long a device that let a request time out owes the reply.
    #[must_use]
    pub const fn late_response_window(&self, is_read: bool) -> Duration {
        match self.late_response_window_ms {
            0 => self.timeout(is_read).saturating_mul(3),
            millis => Duration::from_millis(millis as u64),
        }
    }

    /// Whether the row makes sense by itself.
    fn is_valid(&self) -> bool {
        if !self.is_used() {
            return true;
        }
        // 0 and 255 are broadcasts
        let units = self.first_unit >= 1 && self.first_unit <= self.last_unit && self.last_unit < u8::MAX;
        let steps = self.last_unit.saturating_sub(self.first_unit);
        let last_remote = self.first_address.checked_add(steps);
        let highest = match (self.bus, self.protocol) {
            (Target::Rs485A | Target::Rs485B, Protocol::ModbusRtu | Protocol::ModbusAscii) => {
                ndam9010::UNIT_MAX
            }
            (Target::Rs485A | Target::Rs485B, Protocol::Nst) | (Target::Can, Protocol::NstOverCan) => {
                jointbus_protocol::nst::ADDRESS_MAX
            }
            // the board's own units have no address over there
            (Target::LocalOutputs | Target::LocalIo | Target::Bridge, Protocol::ModbusRtu) => u8::MAX,
            _ => return false,
        };
        let remotes = self.first_address >= 1 && last_remote.is_some_and(|last| last <= highest);
        let times = self.read_timeout_ms > 0 && self.write_timeout_ms > 0 && self.time_to_live_ms > 0;
        units && remotes && times
    }
}

/// Parity of a serial port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parity {
    /// No parity bit.
    None,
    /// Even number of ones.
    Even,
    /// Odd number of ones.
    Odd,
}

/// Settings of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PortConfig {
    /// Baud rate in 100 bit/s; on CAN kbit/s.
    pub rate: u16,
    /// Parity; a CAN port ignores it.
    pub parity: Parity,
    /// Stop bits, 1 or 2; a CAN port ignores them.
    pub stop_bits: u8,
    /// Silence before a frame in 100 us; 0 stands for 3.5 characters.
    pub gap_100us: u16,
    /// The bridge's own node; a serial port ignores it.
    pub node: u8,
    /// Whether the port hears what it sends.
    pub echo: bool,
}

impl PortConfig {
    const fn serial(baud: u32, gap_100us: u16) -> Self {
        let rate = (baud / 100) as u16;
        Self { rate, parity: Parity::None, stop_bits: 1, gap_100us, node: 0, echo: false }
    }

    /// Baud rate in bit/s.
    #[must_use]
    pub const fn baud(&self) -> u32 {
        (self.rate as u32).wrapping_mul(100)
    }

    /// Time that so many characters take on a serial port.
    #[must_use]
    pub fn characters(&self, count: usize) -> Duration {
        Duration::from_micros(self.character_micros(count).into())
    }

    /// In 32 bits, which the processor divides by itself: a frame has at most 513 characters of 12 bits.
    #[inline(never)] // asked in many places
    fn character_micros(&self, count: usize) -> u32 {
        let bits =
            9u32.wrapping_add(self.stop_bits.into()).wrapping_add(u32::from(self.parity != Parity::None));
        let bits = bits.saturating_mul(u32::try_from(count).unwrap_or(u32::MAX));
        bits.saturating_mul(10_000).div_ceil(u32::from(self.rate.max(1)))
    }

    /// Three and a half characters: the silence between two frames.
    #[must_use]
    pub fn pause(&self) -> Duration {
        Duration::from_micros(self.character_micros(7).div_ceil(2).into())
    }

    /// Silence that the port keeps before a frame.
    #[must_use]
    pub fn gap(&self) -> Duration {
        match self.gap_100us {
            0 => self.pause(),
            steps => Duration::from_micros(u64::from(steps).wrapping_mul(100)),
        }
    }

    /// Longest time that so many frames of eight bytes take on CAN: 29-bit identifiers, all stuff bits.
    #[must_use]
    pub fn can_frames(&self, count: usize) -> Duration {
        const BITS: u32 = 160;
        let bits = BITS.saturating_mul(u32::try_from(count).unwrap_or(u32::MAX));
        Duration::from_micros(bits.saturating_mul(1000).div_ceil(u32::from(self.rate.max(1))).into())
    }
}

/// Bit rates of the CAN port in kbit/s (NST manual, table 6).
const CAN_RATES: [u32; 8] = jointbus_protocol::nst::register::CAN_RATES;

/// Number of routes.
pub const ROUTES: usize = 16;

/// Ports and routes: what is applied together, confirmed and rolled back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Topology {
    /// The ports.
    pub ports: [PortConfig; 4],
    /// The routing table.
    pub routes: [Route; ROUTES],
}

impl Default for Topology {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Topology {
    /// No ports and no routes, in zeros.
    pub(super) const ZERO: Self = {
        let port =
            PortConfig { rate: 0, parity: Parity::None, stop_bits: 0, gap_100us: 0, node: 0, echo: false };
        let route = Route {
            first_unit: 0,
            last_unit: 0,
            bus: Target::Rs485A,
            protocol: Protocol::ModbusRtu,
            first_address: 0,
            read_timeout_ms: 0,
            write_timeout_ms: 0,
            read_retries: 0,
            time_to_live_ms: 0,
            late_response_window_ms: 0,
            refuse_writes: false,
        };
        Self { ports: [port; 4], routes: [route; ROUTES] }
    };

    /// Ports and routes that nobody has changed.
    pub const DEFAULT: Self = {
        let mut routes = [Route::UNUSED; ROUTES];
        routes[0] = Route::remote(1, 15, Target::Can, Protocol::NstOverCan, 1);
        routes[1] = Route::remote(16, 30, Target::Rs485A, Protocol::Nst, 1);
        routes[2] = Route::local(31, Target::LocalOutputs);
        routes[3] = Route::remote(32, 39, Target::Rs485B, Protocol::ModbusRtu, 1);
        routes[4] = Route::local(40, Target::LocalIo);
        routes[5] = Route::local(247, Target::Bridge);
        let ports = [
            PortConfig::serial(921_600, 0),
            PortConfig::serial(115_200, 0),
            // an NDAM station delimits frames by 10 ms
            PortConfig::serial(19_200, 110),
            PortConfig { rate: 1000, node: 127, ..PortConfig::serial(0, 0) },
        ];
        Self { ports, routes }
    };

    /// Whether ports and routes fit together; one that would lock the host out does not.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let reaches_bridge =
            (1..u8::MAX).any(|unit| self.route(unit).is_some_and(|(_, route)| route.bus == Target::Bridge));
        // one codec a serial line
        let one_codec = [Target::Rs485A, Target::Rs485B].iter().all(|bus| {
            let mut codecs = self.routes.iter().filter(|row| row.is_used() && row.bus == *bus);
            codecs.next().is_none_or(|first| codecs.all(|row| row.protocol == first.protocol))
        });
        let [serial @ .., can] = &self.ports;
        let ports =
            serial.iter().all(|port| (1..=2).contains(&port.stop_bits) && (12..=20_000).contains(&port.rate))
                && CAN_RATES.contains(&u32::from(can.rate))
                && (1..=jointbus_protocol::nst::ADDRESS_MAX).contains(&can.node);
        ports && one_codec && reaches_bridge && self.routes.iter().all(Route::is_valid)
    }

    /// The route of a unit, and its number.
    #[must_use]
    pub fn route(&self, unit: u8) -> Option<(u8, &Route)> {
        (0..).zip(&self.routes).find(|(_, row)| row.serves(unit))
    }

    /// Whether a bus speaks Modbus ASCII: all of its routes do.
    #[must_use]
    pub fn speaks_ascii(&self, bus: Target) -> bool {
        self.routes.iter().any(|row| row.is_used() && row.bus == bus && row.protocol == Protocol::ModbusAscii)
    }

    /// Settings of a port.
    #[must_use]
    pub const fn port(&self, port: Port) -> &PortConfig {
        let [host, rs485_a, rs485_b, can] = &self.ports;
        match port {
            Port::Host => host,
            Port::Rs485A => rs485_a,
            Port::Rs485B => rs485_b,
            Port::Can => can,
        }
    }
}

/// Limits that act at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Transactions in a row without an answer after which a device is in quarantine; 0 = never.
    pub quarantine_after: u8,
    /// Time between two probes of a device in quarantine, in ms, 1 and up.
    pub probe_period_ms: u16,
    /// No valid request for so many ms switches the local outputs off; 0 = never.
    pub host_silence_ms: u16,
    /// Silence that ends a burst from the host, in 100 us, 1 and up.
    pub burst_silence_100us: u16,
}

impl Default for Limits {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Limits {
    /// None, in zeros.
    pub(super) const ZERO: Self =
        Self { quarantine_after: 0, probe_period_ms: 0, host_silence_ms: 0, burst_silence_100us: 0 };

    /// Limits that nobody has changed.
    pub const DEFAULT: Self =
        Self { quarantine_after: 3, probe_period_ms: 1000, host_silence_ms: 0, burst_silence_100us: 200 };

    /// Time between two probes of a device in quarantine.
    #[must_use]
    pub const fn probe_period(&self) -> Duration {
        Duration::from_millis(self.probe_period_ms as u64)
    }

    /// Silence that ends a burst from the host.
    #[must_use]
    pub const fn burst_silence(&self) -> Duration {
        Duration::from_micros((self.burst_silence_100us as u64).wrapping_mul(100))
    }
}
