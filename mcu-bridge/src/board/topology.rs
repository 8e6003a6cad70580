//! Ports and routes together, and whether they fit a board.

use super::description::Description;
use super::port::{PORTS_MAX, Parity, Port, PortConfig, PortKind};
use super::route::{Protocol, ROUTES, Route, Target};
use jointbus_protocol::{ndam9010, nst};

/// Bit rates of a CAN port in kbit/s (NST manual, table 6).
const CAN_RATES: [u32; 8] = nst::register::CAN_RATES;

/// Baud rates of a serial port in 100 bit/s.
const BAUD_RATES: core::ops::RangeInclusive<u16> = 12..=20_000;

/// Ports and routes: what is applied together, confirmed and rolled back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Topology {
    /// The ports; those that the board does not have are all zeros.
    pub ports: [PortConfig; PORTS_MAX],
    /// The routing table.
    pub routes: [Route; ROUTES],
}

impl Topology {
    /// No ports and no routes, in zeros.
    pub(crate) const ZERO: Self = {
        let port =
            PortConfig { rate: 0, parity: Parity::None, stop_bits: 0, gap_100us: 0, node: 0, echo: false };
        let route = Route {
            first_unit: 0,
            last_unit: 0,
            target: Target::Bus(Port::HOST),
            protocol: Protocol::ModbusRtu,
            first_address: 0,
            read_timeout_ms: 0,
            write_timeout_ms: 0,
            read_retries: 0,
            time_to_live_ms: 0,
            late_response_window_ms: 0,
            refuse_writes: false,
        };
        Self { ports: [port; PORTS_MAX], routes: [route; ROUTES] }
    };

    /// Ports and routes of a board that nobody has changed.
    #[must_use]
    pub fn of(board: &Description) -> Self {
        let mut topology = Self::ZERO;
        topology.set_default(board);
        topology
    }

    /// The same, in place.
    pub(crate) fn set_default(&mut self, board: &Description) {
        self.ports.iter_mut().zip(board.ports).for_each(|(port, own)| *port = own.default);
        self.routes.fill(Route::UNUSED);
        self.routes.iter_mut().zip(board.routes).for_each(|(row, own)| *row = *own);
    }

    /// Whether ports and routes fit together and the board; those that would lock the host out don't.
    #[must_use]
    pub fn is_valid(&self, board: &Description) -> bool {
        let reaches_bridge = (1..u8::MAX)
            .any(|unit| self.route(unit).is_some_and(|(_, route)| route.target == Target::Bridge));
        // one codec a bus
        let one_codec = board.ports().all(|port| {
            let mut rows = self.routes.iter().filter(|row| row.is_used() && row.target == Target::Bus(port));
            rows.next().is_none_or(|first| rows.all(|row| row.protocol == first.protocol))
        });
        let ports = self.ports.iter().zip(board.ports).all(|(port, own)| port.is_valid(own.kind));
        ports && one_codec && reaches_bridge && self.routes.iter().all(|row| row.is_valid(board))
    }

    /// The route of a unit, and its number.
    #[must_use]
    pub fn route(&self, unit: u8) -> Option<(u8, &Route)> {
        (0..).zip(&self.routes).find(|(_, row)| row.serves(unit))
    }

    /// Whether a bus speaks Modbus ASCII: all of its routes do.
    #[must_use]
    pub fn speaks_ascii(&self, port: Port) -> bool {
        let mut rows = self.routes.iter();
        rows.any(|row| {
            row.is_used() && row.target == Target::Bus(port) && row.protocol == Protocol::ModbusAscii
        })
    }

    /// Settings of a port; `None` past the last one of any board.
    #[must_use]
    pub fn port(&self, port: Port) -> Option<&PortConfig> {
        self.ports.get(port.index())
    }
}

impl PortConfig {
    /// Whether a port of that kind can have these settings.
    fn is_valid(&self, kind: PortKind) -> bool {
        match kind {
            PortKind::Serial { clock } => {
                (1..=2).contains(&self.stop_bits)
                    && BAUD_RATES.contains(&self.rate)
                    && clock.makes(self.baud())
            }
            PortKind::Can => {
                CAN_RATES.contains(&self.rate.into()) && (1..=nst::ADDRESS_MAX).contains(&self.node)
            }
        }
    }
}

impl Route {
    /// Whether the row makes sense by itself on a board.
    fn is_valid(&self, board: &Description) -> bool {
        if !self.is_used() {
            return true;
        }
        // 0 and 255 are broadcasts
        let units = self.first_unit >= 1 && self.first_unit <= self.last_unit && self.last_unit < u8::MAX;
        let steps = self.last_unit.saturating_sub(self.first_unit);
        let last_remote = self.first_address.checked_add(steps);
        let kind = self.target.port().and_then(|port| board.port(port)).map(|port| port.kind);
        let highest = match (kind, self.protocol) {
            (Some(PortKind::Serial { .. }), Protocol::ModbusRtu | Protocol::ModbusAscii) => {
                ndam9010::UNIT_MAX
            }
            (Some(PortKind::Serial { .. }), Protocol::Nst) | (Some(PortKind::Can), Protocol::NstOverCan) => {
                nst::ADDRESS_MAX
            }
            // the board's own units have no address over there
            (None, Protocol::ModbusRtu) => u8::MAX,
            _ => return false,
        };
        let remotes = self.first_address >= 1 && last_remote.is_some_and(|last| last <= highest);
        let times = self.read_timeout_ms > 0 && self.write_timeout_ms > 0 && self.time_to_live_ms > 0;
        units && remotes && times
    }
}
