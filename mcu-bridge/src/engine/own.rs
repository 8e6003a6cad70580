//! Unit 247: the bridge's own registers. Values wider than a register come high word first.

use super::Engine;
use super::config::{Bus, Limits, Network, Parity, Port, PortConfig, Protocol, ROUTES, Route};
use super::counters::Counters;
use super::polling::{Polling, SLOTS, Slot};
use jointbus_protocol::modbus::identification::{Conformity, ObjectId};
use jointbus_protocol::modbus::server::{self, Registers, RegistersMut, Server};
use jointbus_protocol::modbus::{Diagnostic, ExceptionCode, FunctionCode, PDU_MAX, Range};
use jointbus_protocol::time::{Duration, Instant};

/// Version of the register map.
pub const MAP_VERSION: u16 = 1;

/// Time in which an applied configuration has to be confirmed.
pub const CONFIRM_WITHIN: Duration = Duration::from_millis(10_000);

/// Why the bridge started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResetCause {
    /// Power came.
    PowerOn,
    /// The reset pin.
    Pin,
    /// The firmware itself: the reboot command.
    Software,
    /// The watchdog.
    Watchdog,
    /// A panic or a fault.
    Panic,
}

impl ResetCause {
    /// Its number in the register.
    #[must_use]
    pub const fn value(self) -> u16 {
        match self {
            Self::PowerOn => 1,
            Self::Pin => 2,
            Self::Software => 3,
            Self::Watchdog => 4,
            Self::Panic => 5,
        }
    }
}

/// What is not well with the bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Health {
    /// It runs from the internal oscillator.
    pub internal_oscillator: bool,
    /// The CAN controller does not answer.
    pub no_can: bool,
    /// The CAN controller is bus-off.
    pub bus_off: bool,
    /// The stored configuration could not be read.
    pub defaulted: bool,
}

/// What the firmware tells about itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Firmware version: major, minor, patch.
    pub version: [u16; 3],
    /// Why it started.
    pub reset_cause: ResetCause,
}

/// What the host asked the firmware to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Restart, after the answer has been sent.
    Reboot,
}

/// Commands at holding register 0.
mod command {
    pub(super) const APPLY: u16 = 0xA991;
    pub(super) const CONFIRM: u16 = 0xC0F1;
    pub(super) const SAVE: u16 = 0x5A7E;
    pub(super) const DEFAULTS: u16 = 0xDEFA;
    pub(super) const REBOOT: u16 = 0xB007;
    pub(super) const CLEAR_COUNTERS: u16 = 0xC1EA;
}

/// Last input register.
const INPUT_LAST: u16 = 0x02FF;

/// What the host may write, while a write is being judged.
#[derive(Debug, Clone, Copy)]
struct Settings {
    staged: Network,
    limits: Limits,
    /// Unit and period of each polling slot.
    slots: [(u8, u16); SLOTS],
}

/// What function code 08 counts beside the host port's counters.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Diagnostics {
    /// Requests to the bridge itself.
    requests: u16,
    /// Exceptions with which it answered.
    exceptions: u16,
}

/// The bridge's registers, at one moment.
struct Own<'a> {
    engine: &'a mut Engine,
    now: Instant,
}

impl Server for Own<'_> {
    fn supports(&self, function: FunctionCode) -> bool {
        matches!(
            function,
            FunctionCode::ReadHoldingRegisters
                | FunctionCode::ReadInputRegisters
                | FunctionCode::WriteSingleRegister
                | FunctionCode::WriteMultipleRegisters
                | FunctionCode::Diagnostics
                | FunctionCode::ReportServerId
                | FunctionCode::EncapsulatedInterface
        )
    }

    fn read_holding_registers(
        &mut self,
        range: Range,
        mut out: RegistersMut<'_>,
    ) -> Result<(), ExceptionCode> {
        out.fill(range.addresses().map(|address| self.engine.holding(address)));
        Ok(())
    }

    fn read_input_registers(&mut self, range: Range, mut out: RegistersMut<'_>) -> Result<(), ExceptionCode> {
        if !range.within(0, INPUT_LAST) {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        out.fill(range.addresses().map(|address| self.engine.input(address, self.now)));
        Ok(())
    }

    fn write_registers(&mut self, range: Range, values: Registers<'_>) -> Result<(), ExceptionCode> {
        self.engine.write_own(range, values, self.now)
    }

    fn diagnostics(&mut self, what: Diagnostic, mut data: RegistersMut<'_>) -> Result<(), ExceptionCode> {
        let [host, ..] = &self.engine.counters;
        let Diagnostics { requests, exceptions } = self.engine.diagnostics;
        let count = match what {
            Diagnostic::ReturnQueryData => return Ok(()),
            _ if data.get(0) != Some(0) => return Err(ExceptionCode::IllegalDataValue),
            Diagnostic::ClearCounters => {
                self.engine.clear_counters();
                return Ok(());
            }
            Diagnostic::BusMessageCount => host.received as u16,
            Diagnostic::BusCommunicationErrorCount => host.checksum_errors as u16,
            Diagnostic::BusExceptionErrorCount => exceptions,
            Diagnostic::ServerMessageCount => requests,
            // a broadcast does not reach the bridge itself, and everything else it answers
            Diagnostic::ServerNoResponseCount => 0,
            Diagnostic::BusCharacterOverrunCount => host.overruns as u16,
            _ => return Err(ExceptionCode::IllegalFunction),
        };
        data.set(0, count);
        Ok(())
    }

    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        // its unit from the factory, running
        Ok(b"\xF7\xFFjointbus")
    }

    fn conformity(&self) -> Conformity {
        Conformity::RegularIndividual
    }

    fn identification(&self, object: ObjectId) -> Option<&[u8]> {
        match object {
            ObjectId::VendorName | ObjectId::ProductName => Some(b"Jointbus"),
            ObjectId::ProductCode => Some(b"jointbus-mcu-bridge"),
            ObjectId::MajorMinorRevision => Some(env!("CARGO_PKG_VERSION").as_bytes()),
            ObjectId::ModelName => Some(b"NST, NXI-6201 and NDAM-9010 bridge"),
            ObjectId::UserApplicationName => Some(b"bridge"),
            ObjectId::VendorUrl | ObjectId::Unknown(_) => None,
        }
    }
}

impl Engine {
    /// Answers a request to the bridge itself.
    pub(super) fn serve_own(&mut self, unit: u8, pdu: &[u8], now: Instant) {
        self.diagnostics.requests = self.diagnostics.requests.wrapping_add(1);
        let mut response = [0; PDU_MAX];
        let Ok(response) = server::respond(&mut Own { engine: self, now }, pdu, &mut response) else {
            return;
        };
        if response.first().is_some_and(|code| code & FunctionCode::EXCEPTION_FLAG != 0) {
            self.diagnostics.exceptions = self.diagnostics.exceptions.wrapping_add(1);
        }
        let [counters, ..] = &mut self.counters;
        self.output.relay(counters, unit, response);
    }

    fn clear_counters(&mut self) {
        self.counters = Default::default();
        self.diagnostics = Diagnostics::default();
    }

    fn input(&self, address: u16, now: Instant) -> u16 {
        let [major, minor, patch] = self.identity.version;
        match address {
            0x0000 => MAP_VERSION,
            0x0001 => major,
            0x0002 => minor,
            0x0003 => patch,
            0x0004..=0x0007 => word(now.as_micros(), 4, address.wrapping_sub(0x0004)),
            0x0008 => self.identity.reset_cause.value(),
            0x0009 => self.health_bits(),
            0x0020..=0x009F => self.counter(address.wrapping_sub(0x0020)),
            0x0100..=0x01FF => self.slot_register(address.wrapping_sub(0x0100), now),
            0x0200..=0x023F => self.device_state(address.wrapping_sub(0x0200)),
            _ => 0,
        }
    }

    fn health_bits(&self) -> u16 {
        let Health { internal_oscillator, no_can, bus_off, defaulted } = self.health;
        let bits = [internal_oscillator, no_can, bus_off, defaulted, self.confirm_until.is_some()];
        bits.iter().rev().fold(0, |word, bit| word << 1 | u16::from(*bit))
    }

    fn counter(&self, offset: u16) -> u16 {
        let port = self.counters.get(usize::from(offset / 0x20));
        let counter = |counters: &Counters| counters.in_order().get(usize::from(offset % 0x20 / 2)).copied();
        word(port.and_then(counter).unwrap_or(0).into(), 2, offset % 2)
    }

    fn slot_register(&self, offset: u16, now: Instant) -> u16 {
        let Some(slot) = self.polling.slot(usize::from(offset / 0x20)) else { return 0 };
        let place = offset % 0x20;
        match place {
            0 => slot.state(now).value(),
            1 => slot.unit.into(),
            2..=3 => word(slot.sequence.into(), 2, place.wrapping_sub(2)),
            4..=7 => word(slot.stamp.as_micros(), 4, place.wrapping_sub(4)),
            8..=9 => word(slot.missed.into(), 2, place.wrapping_sub(8)),
            10..=11 => word(slot.failures.into(), 2, place.wrapping_sub(10)),
            12..=23 => {
                let place = place.wrapping_sub(12);
                let axis = slot.sample.0.get(usize::from(place / 2)).copied().unwrap_or(0);
                word(u64::from(axis as u32), 2, place % 2)
            }
            _ => 0,
        }
    }

    fn device_state(&self, offset: u16) -> u16 {
        let index = usize::from(offset / 4);
        let (Some(time), Some(route)) = (self.reply_times.get(index), self.live.routes.get(index)) else {
            return 0;
        };
        let tens = |span: Duration| u16::try_from(span.as_micros() / 10).unwrap_or(u16::MAX);
        match offset % 4 {
            0 => self.quarantine.mask(route, &self.limits),
            1 => tens(time.last),
            2 => tens(time.largest),
            _ => 0,
        }
    }

    fn write_own(&mut self, range: Range, values: Registers<'_>, now: Instant) -> Result<(), ExceptionCode> {
        let slots = core::array::from_fn(|index| {
            let slot = self.polling.slot(index).copied().unwrap_or_default();
            (slot.unit, slot.period_100us)
        });
        let mut settings = Settings { staged: self.staged, limits: self.limits, slots };
        let mut command = None;
        for (address, value) in range.addresses().zip(values.iter()) {
            match address {
                0x0000 => command = Some(value),
                _ => settings.write(address, value)?,
            }
        }
        if let Some(command) = command {
            return self.command(command, now);
        }
        self.staged = settings.staged;
        self.limits = settings.limits;
        for (index, ((unit, period), (former_unit, former_period))) in
            settings.slots.into_iter().zip(slots).enumerate()
        {
            if (unit, period) != (former_unit, former_period) {
                self.polling.set(index, Slot::new(unit, period, now));
            }
        }
        self.host.set_silence(self.limits.burst_silence());
        Ok(())
    }

    /// Only a write of register 0 alone gets here: there are no others beside it.
    fn command(&mut self, command: u16, now: Instant) -> Result<(), ExceptionCode> {
        match command {
            command::APPLY => {
                if !self.staged.is_valid() {
                    return Err(ExceptionCode::IllegalDataValue);
                }
                self.confirm_until = Some(now.after(CONFIRM_WITHIN));
                self.go_live(self.staged, now);
            }
            command::CONFIRM => {
                self.confirm_until = None;
                self.confirmed = self.live;
            }
            // no board offers a store yet
            command::SAVE => return Err(ExceptionCode::ServerDeviceFailure),
            command::DEFAULTS => {
                self.staged = Network::default();
                self.limits = Limits::default();
                self.polling = Polling::default();
                self.host.set_silence(self.limits.burst_silence());
            }
            command::REBOOT => self.command = Some(Command::Reboot),
            command::CLEAR_COUNTERS => self.clear_counters(),
            _ => return Err(ExceptionCode::IllegalDataValue),
        }
        Ok(())
    }

    /// Returns to the confirmed configuration where the applied one was not confirmed in time.
    pub(super) fn roll_back(&mut self, now: Instant) {
        if self.confirm_until.is_some_and(|end| now >= end) {
            self.confirm_until = None;
            self.staged = self.confirmed;
            self.go_live(self.confirmed, now);
        }
    }
}

/// Word `index` of a value of so many words, high word first.
const fn word(value: u64, words: u16, index: u16) -> u16 {
    let place = words.wrapping_sub(1).wrapping_sub(index) as u32;
    value.wrapping_shr(place.wrapping_mul(16)) as u16
}

impl Engine {
    /// A holding register; what is not listed reads 0.
    fn holding(&self, address: u16) -> u16 {
        let (staged, limits) = (&self.staged, &self.limits);
        match address {
            0x0010..=0x002F => {
                let offset = address.wrapping_sub(0x0010);
                staged.ports.get(usize::from(offset / 8)).map_or(0, |port| port.register(offset % 8))
            }
            0x0040 => limits.quarantine_after.into(),
            0x0041 => limits.probe_period_ms,
            0x0042 => limits.host_silence_ms,
            0x0043 => limits.burst_silence_100us,
            0x0050..=0x005F => {
                let offset = address.wrapping_sub(0x0050);
                let slot = self.polling.slot(usize::from(offset / 2));
                slot.map_or(
                    0,
                    |slot| if offset.is_multiple_of(2) { slot.unit.into() } else { slot.period_100us },
                )
            }
            0x0100..=0x01FF => {
                let offset = address.wrapping_sub(0x0100);
                staged.routes.get(usize::from(offset / 0x10)).map_or(0, |row| row.register(offset % 0x10))
            }
            _ => 0,
        }
    }
}

impl Settings {
    fn write(&mut self, address: u16, value: u16) -> Result<(), ExceptionCode> {
        const PORTS: u16 = Port::ALL.len() as u16;
        const ROWS: u16 = ROUTES as u16;
        const _: () = assert!(0x0010 + 8 * PORTS == 0x0030 && 0x0100 + 0x10 * ROWS == 0x0200);
        let unlisted = ExceptionCode::IllegalDataAddress;
        match address {
            0x0010..=0x002F => {
                let offset = address.wrapping_sub(0x0010);
                let port = self.staged.ports.get_mut(usize::from(offset / 8)).ok_or(unlisted)?;
                port.set_register(offset % 8, value)
            }
            0x0040 => {
                self.limits.quarantine_after = byte(value)?;
                Ok(())
            }
            0x0041 => {
                self.limits.probe_period_ms = at_least_1(value)?;
                Ok(())
            }
            0x0042 => {
                self.limits.host_silence_ms = value;
                Ok(())
            }
            0x0043 => {
                self.limits.burst_silence_100us = at_least_1(value)?;
                Ok(())
            }
            0x0050..=0x005F => {
                let offset = address.wrapping_sub(0x0050);
                let (unit, period) = self.slots.get_mut(usize::from(offset / 2)).ok_or(unlisted)?;
                match offset % 2 {
                    0 => *unit = byte(value)?,
                    _ => *period = value,
                }
                Ok(())
            }
            0x0100..=0x01FF => {
                let offset = address.wrapping_sub(0x0100);
                let row = self.staged.routes.get_mut(usize::from(offset / 0x10)).ok_or(unlisted)?;
                row.set_register(offset % 0x10, value)
            }
            _ => Err(unlisted),
        }
    }
}

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
    fn register(&self, offset: u16) -> u16 {
        if !self.is_used() && matches!(offset, 2..=4) {
            return 0;
        }
        match offset {
            0 => self.first_unit.into(),
            1 => self.last_unit.into(),
            2 => self.bus.value(),
            3 => self.protocol.value(),
            4 => self.first_remote.into(),
            5 => self.read_timeout_ms,
            6 => self.write_timeout_ms,
            7 => self.read_retries.into(),
            8 => self.time_to_live_ms,
            9 => self.hold_off_ms,
            10 => self.refuse_writes.into(),
            _ => 0,
        }
    }

    fn set_register(&mut self, offset: u16, value: u16) -> Result<(), ExceptionCode> {
        let refused = ExceptionCode::IllegalDataValue;
        match offset {
            0 => self.first_unit = byte(value)?,
            1 => self.last_unit = byte(value)?,
            2 => self.bus = Bus::from_value(value).ok_or(refused)?,
            3 => self.protocol = Protocol::from_value(value).ok_or(refused)?,
            4 => self.first_remote = byte(value)?,
            5 => self.read_timeout_ms = at_least_1(value)?,
            6 => self.write_timeout_ms = at_least_1(value)?,
            7 => {
                self.read_retries =
                    byte(value).and_then(|count| if count < 10 { Ok(count) } else { Err(refused) })?
            }
            8 => self.time_to_live_ms = at_least_1(value)?,
            9 => self.hold_off_ms = value,
            10 => self.refuse_writes = flag(value)?,
            _ => return Err(ExceptionCode::IllegalDataAddress),
        }
        Ok(())
    }
}
