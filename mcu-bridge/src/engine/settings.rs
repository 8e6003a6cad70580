//! All that the host can set, as holding registers and as it is stored.

use super::config::{Limits, Parity, Port, PortConfig, Protocol, ROUTES, Route, Target, Topology};
use super::polling::SLOTS;
use jointbus_protocol::checksum;
use jointbus_protocol::modbus::ExceptionCode;
use jointbus_protocol::wire::{NoSpace, Reader, Writer};

/// Unit and period in 100 us of each polling slot.
pub type SlotSettings = [(u8, u16); SLOTS];

/// All that the host can set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Settings {
    /// Ports and routes.
    pub network: Topology,
    /// Limits.
    pub limits: Limits,
    /// Polling slots.
    pub slots: SlotSettings,
}

/// Length of the stored form.
pub const STORED_LENGTH: usize = 2 + 2 * WORDS + checksum::CRC_LENGTH;

/// First word of the stored form; another one is another layout.
const STORED_VERSION: u16 = 1;

const PORT_WORDS: u16 = 5;
const ROUTE_WORDS: u16 = 11;
const SLOT_REGISTERS: core::ops::Range<u16> = 0x0050..0x0050 + 2 * SLOTS as u16;
const WORDS: usize = Port::ALL.len() * PORT_WORDS as usize + 4 + 2 * SLOTS + ROUTES * ROUTE_WORDS as usize;

/// The listed registers of the ports, the limits and the slots.
fn plain_registers() -> impl Iterator<Item = u16> {
    (0x0010..SLOT_REGISTERS.end).filter(|address| match address {
        0x0010..=0x002F => address % 8 < PORT_WORDS,
        0x0040..=0x0043 => true,
        _ => *address >= SLOT_REGISTERS.start,
    })
}

/// The holding registers, where their values are.
#[derive(Clone, Copy)]
pub(super) struct Holding<'a> {
    pub(super) network: &'a Topology,
    pub(super) limits: &'a Limits,
    pub(super) slots: &'a SlotSettings,
}

/// The same, to be written.
pub(super) struct HoldingMut<'a> {
    pub(super) network: &'a mut Topology,
    pub(super) limits: &'a mut Limits,
    pub(super) slots: &'a mut SlotSettings,
}

impl Settings {
    /// The stored form: the registers in their order, and a CRC.
    #[must_use]
    pub fn encode(&self) -> [u8; STORED_LENGTH] {
        let mut stored = [0; STORED_LENGTH];
        Holding { network: &self.network, limits: &self.limits, slots: &self.slots }.encode(&mut stored);
        stored
    }

    /// The settings in a stored form; `None` where it is damaged, of another version, or would not be accepted from the
    /// host.
    #[must_use]
    pub fn decode(stored: &[u8]) -> Option<Self> {
        let mut reader = Reader::new(checksum::strip_crc(stored).filter(|_| stored.len() == STORED_LENGTH)?);
        if reader.u16_be().ok()? != STORED_VERSION {
            return None;
        }
        let mut settings = Self::default();
        let Self { network, limits, slots } = &mut settings;
        let mut registers = HoldingMut { network, limits, slots };
        for address in plain_registers() {
            registers.write(address, reader.u16_be().ok()?).ok()?;
        }
        for row in &mut settings.network.routes {
            let mut words = [0; ROUTE_WORDS as usize];
            for word in &mut words {
                *word = reader.u16_be().ok()?;
            }
            *row = Route::UNUSED;
            let [first, last, ..] = words;
            if (first, last) != (0, 0) {
                for (offset, word) in (0..).zip(words) {
                    row.set_register(offset, word).ok()?;
                }
            }
        }
        settings.network.is_valid().then_some(settings)
    }
}

impl Holding<'_> {
    pub(super) fn encode(&self, stored: &mut [u8; STORED_LENGTH]) {
        // the array is as long as what is written
        let _ = self.write_all(&mut Writer::new(stored));
    }

    fn write_all(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        writer.u16_be(STORED_VERSION)?;
        for address in plain_registers() {
            writer.u16_be(self.read(address))?;
        }
        for row in &self.network.routes {
            for offset in 0..ROUTE_WORDS {
                writer.u16_be(row.register(offset))?;
            }
        }
        checksum::append_crc(writer)
    }

    /// A holding register; what is not listed reads 0.
    pub(super) fn read(&self, address: u16) -> u16 {
        let Self { network, limits, slots } = self;
        match address {
            0x0010..=0x002F => {
                let offset = address.wrapping_sub(0x0010);
                network.ports.get(usize::from(offset / 8)).map_or(0, |port| port.register(offset % 8))
            }
            0x0040 => limits.quarantine_after.into(),
            0x0041 => limits.probe_period_ms,
            0x0042 => limits.host_silence_ms,
            0x0043 => limits.burst_silence_100us,
            0x0050..=0x005F => {
                let offset = address.wrapping_sub(0x0050);
                let slot = slots.get(usize::from(offset / 2));
                slot.map_or(
                    0,
                    |(unit, period)| if offset.is_multiple_of(2) { (*unit).into() } else { *period },
                )
            }
            0x0100..=0x01FF => {
                let offset = address.wrapping_sub(0x0100);
                network.routes.get(usize::from(offset / 0x10)).map_or(0, |row| row.register(offset % 0x10))
            }
            _ => 0,
        }
    }
}

impl HoldingMut<'_> {
    /// Sets a holding register; each value is judged by itself.
    pub(super) fn write(&mut self, address: u16, value: u16) -> Result<(), ExceptionCode> {
        const PORTS: u16 = Port::ALL.len() as u16;
        const ROWS: u16 = ROUTES as u16;
        const _: () = assert!(0x0010 + 8 * PORTS == 0x0030 && 0x0100 + 0x10 * ROWS == 0x0200);
        match address {
            0x0010..=0x002F => {
                let offset = address.wrapping_sub(0x0010);
                let port = self.network.ports.get_mut(usize::from(offset / 8)).ok_or(UNLISTED)?;
                port.set_register(offset % 8, value)?;
            }
            0x0040 => self.limits.quarantine_after = byte(value)?,
            0x0041 => self.limits.probe_period_ms = at_least_1(value)?,
            0x0042 => self.limits.host_silence_ms = value,
            0x0043 => self.limits.burst_silence_100us = at_least_1(value)?,
            0x0050..=0x005F => {
                let offset = address.wrapping_sub(0x0050);
                let (unit, period) = self.slots.get_mut(usize::from(offset / 2)).ok_or(UNLISTED)?;
                match offset % 2 {
                    0 => *unit = byte(value)?,
                    _ => *period = value,
                }
            }
            0x0100..=0x01FF => {
                let offset = address.wrapping_sub(0x0100);
                let row = self.network.routes.get_mut(usize::from(offset / 0x10)).ok_or(UNLISTED)?;
                row.set_register(offset % 0x10, value)?;
            }
            _ => return Err(UNLISTED),
        }
        Ok(())
    }
}

const UNLISTED: ExceptionCode = ExceptionCode::IllegalDataAddress;

#[inline(never)] // asked in many places
fn byte(value: u16) -> Result<u8, ExceptionCode> {
    u8::try_from(value).map_err(|_| ExceptionCode::IllegalDataValue)
}

fn at_least_1(value: u16) -> Result<u16, ExceptionCode> {
    if value > 0 { Ok(value) } else { Err(ExceptionCode::IllegalDataValue) }
}

fn flag(value: u16) -> Result<bool, ExceptionCode> {
    match value {
        0 => Ok(false),
        1 => Ok(true),
        _ => Err(ExceptionCode::IllegalDataValue),
    }
}

/// Registers 0x0010 + 8 p.
impl PortConfig {
    /// Whether the host reads the same of both: shorter than to compare what is behind it.
    pub(super) fn reads_as(&self, other: &Self) -> bool {
        (0..PORT_WORDS).all(|offset| self.register(offset) == other.register(offset))
    }

    fn register(&self, offset: u16) -> u16 {
        match offset {
            0 => self.rate,
            1 => {
                let parity = match self.parity {
                    Parity::None => 0,
                    Parity::Even => 1,
                    Parity::Odd => 2,
                };
                u16::from_be_bytes([self.stop_bits, parity])
            }
            2 => self.gap_100us,
            3 => self.node.into(),
            4 => self.echo.into(),
            _ => 0,
        }
    }

    fn set_register(&mut self, offset: u16, value: u16) -> Result<(), ExceptionCode> {
        match offset {
            0 => self.rate = at_least_1(value)?,
            1 => {
                let [stop_bits, parity] = value.to_be_bytes();
                let parity = match parity {
                    0 => Parity::None,
                    1 => Parity::Even,
                    2 => Parity::Odd,
                    _ => return Err(ExceptionCode::IllegalDataValue),
                };
                if !(1..=2).contains(&stop_bits) {
                    return Err(ExceptionCode::IllegalDataValue);
                }
                self.stop_bits = stop_bits;
                self.parity = parity;
            }
            2 => self.gap_100us = value,
            3 => self.node = byte(value)?,
            4 => self.echo = flag(value)?,
            _ => return Err(ExceptionCode::IllegalDataAddress),
        }
        Ok(())
    }
}

/// Registers 0x0100 + 0x10 r.
impl Route {
    /// Whether the host reads the same of both: shorter than to compare what is behind it.
    pub(super) fn reads_as(&self, other: &Self) -> bool {
        (0..ROUTE_WORDS).all(|offset| self.register(offset) == other.register(offset))
    }

    fn register(&self, offset: u16) -> u16 {
        if !self.is_used() && matches!(offset, 2..=4) {
            return 0;
        }
        match offset {
            0 => self.first_unit.into(),
            1 => self.last_unit.into(),
            2 => self.bus.value(),
            3 => self.protocol.value(),
            4 => self.first_address.into(),
            5 => self.read_timeout_ms,
            6 => self.write_timeout_ms,
            7 => self.read_retries.into(),
            8 => self.time_to_live_ms,
            9 => self.late_response_window_ms,
            10 => self.refuse_writes.into(),
            _ => 0,
        }
    }

    fn set_register(&mut self, offset: u16, value: u16) -> Result<(), ExceptionCode> {
        let refused = ExceptionCode::IllegalDataValue;
        match offset {
            0 => self.first_unit = byte(value)?,
            1 => self.last_unit = byte(value)?,
            2 => self.bus = Target::from_value(value).ok_or(refused)?,
            3 => self.protocol = Protocol::from_value(value).ok_or(refused)?,
            4 => self.first_address = byte(value)?,
            5 => self.read_timeout_ms = at_least_1(value)?,
            6 => self.write_timeout_ms = at_least_1(value)?,
            7 => {
                self.read_retries =
                    byte(value).and_then(|count| if count < 10 { Ok(count) } else { Err(refused) })?
            }
            8 => self.time_to_live_ms = at_least_1(value)?,
            9 => self.late_response_window_ms = value,
            10 => self.refuse_writes = flag(value)?,
            _ => return Err(ExceptionCode::IllegalDataAddress),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_come_back_and_damage_is_noticed() {
        let mut settings = Settings::default();
        settings.limits.host_silence_ms = 500;
        settings.slots[7] = (16, 25);
        settings.network.ports[2].parity = Parity::Odd;
        settings.network.routes[1].read_retries = 3;
        settings.network.routes[15] = Route { first_unit: 200, last_unit: 203, ..settings.network.routes[1] };
        let stored = settings.encode();
        assert_eq!(Settings::decode(&stored), Some(settings));
        for byte in 0..STORED_LENGTH {
            let mut damaged = stored;
            damaged[byte] ^= 0x10;
            assert_eq!(Settings::decode(&damaged), None, "byte {byte}");
            assert_eq!(Settings::decode(&stored[..byte]), None);
        }
        assert_eq!(Settings::decode(&[0xFF; STORED_LENGTH]), None, "erased flash");
    }

    #[test]
    fn settings_that_the_host_could_not_set_are_not_restored() {
        let mut settings = Settings::default();
        settings.network.routes[5] = Route::UNUSED;
        assert_eq!(Settings::decode(&settings.encode()), None, "no way to the bridge itself");
    }
}
