//! All that the host can set, as holding registers and as it is stored.

use crate::board::{
    Description, Limits, PORTS_MAX, Parity, PortConfig, Protocol, ROUTES, Route, Target, Topology,
};
use crate::registers::{self, Access, Field, Repeat, Row, SLOTS};
use jointbus_protocol::checksum;
use jointbus_protocol::wire::{NoSpace, Reader, Writer};

/// Unit and period in 100 us of each polling slot.
pub type SlotSettings = [(u8, u16); SLOTS];

/// All that the host can set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Ports and routes.
    pub topology: Topology,
    /// Limits.
    pub limits: Limits,
    /// Polling slots.
    pub slots: SlotSettings,
}

/// First word of the stored form; another one is another layout.
const STORED_VERSION: u16 = 2;

/// Length of the stored form: its version, the board's number, the registers and a CRC.
pub const STORED_LENGTH: usize = {
    let (mut words, mut rows) = (2, registers::ALL);
    while let [row, rest @ ..] = rows {
        words += copies(row.access, row.repeat);
        rows = rest;
    }
    2 * words + checksum::CRC_LENGTH
};

/// How many of a register are stored, on every board alike.
const fn copies(access: Access, repeat: Repeat) -> usize {
    match (access, repeat) {
        (Access::Read | Access::Command, _) => 0,
        (_, Repeat::Once) => 1,
        (_, Repeat::Ports) => PORTS_MAX,
        (_, Repeat::Routes) => ROUTES,
        (_, Repeat::Slots) => SLOTS,
        (_, Repeat::Targets) => 0,
    }
}

/// The registers that are stored, in their order.
fn stored_registers() -> impl Iterator<Item = (&'static Row, usize)> {
    registers::rows().flat_map(|row| (0..copies(row.access, row.repeat)).map(move |index| (row, index)))
}

impl Settings {
    /// None, in zeros.
    pub(super) const ZERO: Self =
        Self { topology: Topology::ZERO, limits: Limits::ZERO, slots: [(0, 0); SLOTS] };

    /// Settings of a board that nobody has changed.
    #[must_use]
    pub fn of(board: &Description) -> Self {
        Self { topology: Topology::of(board), limits: board.limits, slots: [(0, 0); SLOTS] }
    }

    /// The stored form: the registers in their order, and a CRC.
    #[must_use]
    pub fn encode(&self, board: &Description) -> [u8; STORED_LENGTH] {
        let mut stored = [0; STORED_LENGTH];
        self.encode_into(board, &mut stored);
        stored
    }

    /// The same, in place.
    pub(super) fn encode_into(&self, board: &Description, stored: &mut [u8; STORED_LENGTH]) {
        // the array is as long as what is written
        let _ = self.write_all(board, &mut Writer::new(stored));
    }

    fn write_all(&self, board: &Description, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        writer.u16_be(STORED_VERSION)?;
        writer.u16_be(board.number)?;
        for (row, index) in stored_registers() {
            writer.u16_be(self.read(row.field, index, board))?;
        }
        checksum::append_crc(writer)
    }

    /// The settings in a stored form; `None` where it is damaged, of another version or board, or would not be accepted
    /// from the host.
    #[must_use]
    pub fn decode(stored: &[u8], board: &Description) -> Option<Self> {
        let mut reader = Reader::new(checksum::strip_crc(stored).filter(|_| stored.len() == STORED_LENGTH)?);
        if (reader.u16_be().ok()?, reader.u16_be().ok()?) != (STORED_VERSION, board.number) {
            return None;
        }
        let mut settings = Self::of(board);
        settings.topology.routes = [Route::UNUSED; ROUTES];
        for (row, index) in stored_registers() {
            let value = reader.u16_be().ok()?;
            // the units of a row come first; what else stands in one that is not used is nothing
            let is_unused = row.repeat == Repeat::Routes
                && !settings.topology.routes.get(index)?.is_used()
                && row.field != Field::RouteFirstUnit
                && row.field != Field::RouteLastUnit;
            let is_absent = index >= row.repeat.count(board);
            if is_unused || is_absent {
                continue;
            }
            if !row.range.contains(value, board) {
                return None;
            }
            settings.write(row.field, index, value, board);
        }
        settings.topology.is_valid(board).then_some(settings)
    }

    /// The value of a holding register.
    pub(super) fn read(&self, field: Field, index: usize, board: &Description) -> u16 {
        let Self { topology: Topology { ports, routes }, limits, slots } = self;
        match field {
            Field::QuarantineAfter => limits.quarantine_after.into(),
            Field::ProbePeriod => limits.probe_period_ms,
            Field::HostSilence => limits.host_silence_ms,
            Field::BurstSilence => limits.burst_silence_100us,
            Field::SlotUnit => slots.get(index).map_or(0, |(unit, _)| (*unit).into()),
            Field::SlotPeriod => slots.get(index).map_or(0, |(_, period)| *period),
            _ => {
                let port = ports.get(index).and_then(|port| read_port(port, field));
                let route = || routes.get(index).and_then(|route| read_route(route, field, board));
                port.or_else(route).unwrap_or(0)
            }
        }
    }

    /// Sets a holding register to a value in its range.
    pub(super) fn write(&mut self, field: Field, index: usize, value: u16, board: &Description) {
        let Self { topology: Topology { ports, routes }, limits, slots } = self;
        // where a register is narrower, its range is as well
        let octet = value as u8;
        match field {
            Field::QuarantineAfter => limits.quarantine_after = octet,
            Field::ProbePeriod => limits.probe_period_ms = value,
            Field::HostSilence => limits.host_silence_ms = value,
            Field::BurstSilence => limits.burst_silence_100us = value,
            Field::SlotUnit | Field::SlotPeriod => {
                if let Some((unit, period)) = slots.get_mut(index) {
                    match field {
                        Field::SlotUnit => *unit = octet,
                        _ => *period = value,
                    }
                }
            }
            _ => {
                if let Some(port) = ports.get_mut(index) {
                    write_port(port, field, value);
                }
                if let Some(route) = routes.get_mut(index) {
                    write_route(route, field, value, board);
                }
            }
        }
    }
}

/// A register of a port; `None` where it is none.
fn read_port(port: &PortConfig, field: Field) -> Option<u16> {
    Some(match field {
        Field::PortRate => port.rate,
        Field::PortFormat => {
            let parity = match port.parity {
                Parity::None => 0,
                Parity::Even => 1,
                Parity::Odd => 2,
            };
            u16::from_be_bytes([port.stop_bits, parity])
        }
        Field::PortGap => port.gap_100us,
        Field::PortNode => port.node.into(),
        Field::PortFlags => port.echo.into(),
        _ => return None,
    })
}

fn write_port(port: &mut PortConfig, field: Field, value: u16) {
    let [high, low] = value.to_be_bytes();
    match field {
        Field::PortRate => port.rate = value,
        Field::PortFormat => {
            port.stop_bits = high;
            port.parity = match low {
                0 => Parity::None,
                1 => Parity::Even,
                _ => Parity::Odd,
            };
        }
        Field::PortGap => port.gap_100us = value,
        Field::PortNode => port.node = low,
        Field::PortFlags => port.echo = value != 0,
        _ => {}
    }
}

/// A register of a route; `None` where it is none.
fn read_route(route: &Route, field: Field, board: &Description) -> Option<u16> {
    Some(match field {
        Field::RouteTarget | Field::RouteProtocol | Field::RouteFirstAddress if !route.is_used() => 0,
        Field::RouteFirstUnit => route.first_unit.into(),
        Field::RouteLastUnit => route.last_unit.into(),
        Field::RouteTarget => board.target_number(route.target),
        Field::RouteProtocol => route.protocol.value(),
        Field::RouteFirstAddress => route.first_address.into(),
        Field::RouteReadTimeout => route.read_timeout_ms,
        Field::RouteWriteTimeout => route.write_timeout_ms,
        Field::RouteRetries => route.read_retries.into(),
        Field::RouteTimeToLive => route.time_to_live_ms,
        Field::RouteLateWindow => route.late_response_window_ms,
        Field::RouteFlags => route.refuse_writes.into(),
        _ => return None,
    })
}

fn write_route(route: &mut Route, field: Field, value: u16, board: &Description) {
    let octet = value as u8;
    match field {
        Field::RouteFirstUnit => route.first_unit = octet,
        Field::RouteLastUnit => route.last_unit = octet,
        Field::RouteTarget => route.target = board.target(value).unwrap_or(Target::Bridge),
        Field::RouteProtocol => {
            route.protocol = Protocol::from_value(value).unwrap_or(Protocol::ModbusRtu);
        }
        Field::RouteFirstAddress => route.first_address = octet,
        Field::RouteReadTimeout => route.read_timeout_ms = value,
        Field::RouteWriteTimeout => route.write_timeout_ms = value,
        Field::RouteRetries => route.read_retries = octet,
        Field::RouteTimeToLive => route.time_to_live_ms = value,
        Field::RouteLateWindow => route.late_response_window_ms = value,
        Field::RouteFlags => route.refuse_writes = value != 0,
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::boards::stm32f405::BOARD;

    #[test]
    fn settings_come_back_and_damage_is_noticed() {
        let mut settings = Settings::of(BOARD);
        settings.limits.host_silence_ms = 500;
        settings.slots[7] = (16, 25);
        settings.topology.ports[2].parity = Parity::Odd;
        settings.topology.routes[1].read_retries = 3;
        settings.topology.routes[15] =
            Route { first_unit: 200, last_unit: 203, ..settings.topology.routes[1] };
        let stored = settings.encode(BOARD);
        assert_eq!(Settings::decode(&stored, BOARD), Some(settings));
        for byte in 0..STORED_LENGTH {
            let mut damaged = stored;
            damaged[byte] ^= 0x10;
            assert_eq!(Settings::decode(&damaged, BOARD), None, "byte {byte}");
            assert_eq!(Settings::decode(&stored[..byte], BOARD), None);
        }
        assert_eq!(Settings::decode(&[0xFF; STORED_LENGTH], BOARD), None, "erased flash");
        let other = Description { number: 2, ..*BOARD };
        assert_eq!(Settings::decode(&stored, &other), None, "another board");
    }

    #[test]
    fn settings_that_the_host_could_not_set_are_not_restored() {
        let mut settings = Settings::of(BOARD);
        settings.topology.routes[5] = Route::UNUSED;
        assert_eq!(Settings::decode(&settings.encode(BOARD), BOARD), None, "no way to the bridge itself");
    }
}
