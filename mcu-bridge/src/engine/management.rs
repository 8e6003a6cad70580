//! Unit 247: the bridge's own registers. Values wider than a register come high word first.

use super::config::Limits;
use super::counters::Counters;
use super::polling::Slot;
use super::settings::{Holding, HoldingMut, STORED_LENGTH, Settings, SlotSettings};
use super::{AT_ONCE, Change, Core, Engine};
use jointbus_protocol::modbus::identification::{ConformityLevel, ObjectId};
use jointbus_protocol::modbus::server::{self, RegisterWriter, Registers, Server};
use jointbus_protocol::modbus::{AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode, PDU_MAX};
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

/// A save that the host waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Saving {
    /// There is none.
    No,
    /// Asked for under this unit.
    Asked(u8),
    /// What is to be stored has been handed out.
    Taken(u8),
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

/// What function code 08 counts beside the host port's counters.
#[derive(Debug, Clone, Copy)]
pub(super) struct Diagnostics {
    /// RequestFraming to the bridge itself.
    requests: u16,
    /// Exceptions with which it answered.
    exceptions: u16,
}

impl Diagnostics {
    pub(super) const ZERO: Self = Self { requests: 0, exceptions: 0 };
}

/// The bridge's registers, at one moment.
struct Management<'a> {
    core: &'a mut Core,
    now: Instant,
}

impl Server for Management<'_> {
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
        range: AddressRange,
        out: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        let slots = self.core.slots();
        let registers = self.core.holding(&slots);
        for address in range.addresses() {
            out.push(registers.read(address));
        }
        Ok(())
    }

    fn read_input_registers(
        &mut self,
        range: AddressRange,
        out: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        if !range.within(0, INPUT_LAST) {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        for address in range.addresses() {
            out.push(self.core.input(address, self.now));
        }
        Ok(())
    }

    fn write_registers(&mut self, range: AddressRange, values: Registers<'_>) -> Result<(), ExceptionCode> {
        self.core.write_own(range, values, self.now)
    }

    fn diagnostics(
        &mut self,
        what: DiagnosticSubfunction,
        data: Registers<'_>,
    ) -> Result<Option<u16>, ExceptionCode> {
        let [host, ..] = &self.core.counters;
        let Diagnostics { requests, exceptions } = self.core.diagnostics;
        let count = match what {
            DiagnosticSubfunction::ReturnQueryData => return Ok(None),
            _ if data.get(0) != Some(0) => return Err(ExceptionCode::IllegalDataValue),
            DiagnosticSubfunction::ClearCounters => {
                self.core.clear_counters();
                return Ok(None);
            }
            DiagnosticSubfunction::BusMessageCount => host.received as u16,
            DiagnosticSubfunction::BusCommunicationErrorCount => host.checksum_errors as u16,
            DiagnosticSubfunction::BusExceptionErrorCount => exceptions,
            DiagnosticSubfunction::ServerMessageCount => requests,
            // a broadcast does not reach the bridge itself, and everything else it answers
            DiagnosticSubfunction::ServerNoResponseCount => 0,
            DiagnosticSubfunction::BusCharacterOverrunCount => host.overruns as u16,
            _ => return Err(ExceptionCode::IllegalFunction),
        };
        Ok(Some(count))
    }

    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        // its unit from the factory, running
        Ok(b"\xF7\xFFjointbus")
    }

    fn conformity(&self) -> ConformityLevel {
        ConformityLevel::RegularIndividual
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

impl Core {
    /// Answers a request to the bridge itself.
    #[inline(never)] // its buffer is not for the other local units
    pub(super) fn serve_own(&mut self, unit: u8, pdu: &[u8], now: Instant) {
        self.diagnostics.requests = self.diagnostics.requests.wrapping_add(1);
        let was_saving = self.saving != Saving::No;
        let mut response = [0; PDU_MAX];
        let Ok(response) = server::respond(&mut Management { core: self, now }, pdu, &mut response) else {
            return;
        };
        if response.first().is_some_and(|code| code & FunctionCode::EXCEPTION_FLAG != 0) {
            self.diagnostics.exceptions = self.diagnostics.exceptions.wrapping_add(1);
        }
        if let Saving::Asked(asked) = &mut self.saving
            && !was_saving
        {
            *asked = unit;
            return;
        }
        let [counters, ..] = &mut self.counters;
        self.output.relay(counters, unit, response);
    }

    fn clear_counters(&mut self) {
        self.counters = [Counters::ZERO; 4];
        self.diagnostics = Diagnostics::ZERO;
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
        let Health { internal_oscillator, no_can, defaulted } = self.health;
        let bits = [internal_oscillator, no_can, self.can.is_off(), defaulted, self.confirm_until.is_some()];
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
        match offset % 4 {
            0 => self.quarantine.mask(route, &self.limits),
            1 => time.last,
            2 => time.largest,
            _ => 0,
        }
    }

    fn write_own(
        &mut self,
        range: AddressRange,
        values: Registers<'_>,
        now: Instant,
    ) -> Result<(), ExceptionCode> {
        let former = self.slots();
        // into copies, so that a write is all or nothing
        let (mut network, mut limits, mut slots) = (self.staged, self.limits, former);
        let mut registers = HoldingMut { network: &mut network, limits: &mut limits, slots: &mut slots };
        let mut command = None;
        for (address, value) in range.addresses().zip(values.iter()) {
            match address {
                0x0000 => command = Some(value),
                _ => registers.write(address, value)?,
            }
        }
        if let Some(command) = command {
            return self.command(command, now);
        }
        (self.staged, self.limits) = (network, limits);
        self.set_slots(&former, &slots, now);
        Ok(())
    }

    /// The registers as the host sees them: the network staged.
    fn holding<'s>(&'s self, slots: &'s SlotSettings) -> Holding<'s> {
        Holding { network: &self.staged, limits: &self.limits, slots }
    }

    #[inline(never)] // asked in many places
    fn slots(&self) -> SlotSettings {
        core::array::from_fn(|index| {
            self.polling.slot(index).map_or((0, 0), |slot| (slot.unit, slot.period_100us))
        })
    }

    /// Starts the slots that change anew.
    fn set_slots(&mut self, former: &SlotSettings, new: &SlotSettings, now: Instant) {
        for (index, (former, (unit, period))) in former.iter().zip(new).enumerate() {
            if *former != (*unit, *period) {
                self.polling.set(index, Slot::new(*unit, *period, now));
            }
        }
    }

    /// Only a write of register 0 alone gets here: there are no others beside it.
    fn command(&mut self, command: u16, now: Instant) -> Result<(), ExceptionCode> {
        match command {
            command::APPLY => {
                if !self.staged.is_valid() {
                    return Err(ExceptionCode::IllegalDataValue);
                }
                self.confirm_until = Some(now.saturating_add(CONFIRM_WITHIN));
                self.change = Change::Apply;
            }
            command::CONFIRM => {
                self.confirm_until = None;
                self.confirmed = self.live;
            }
            // answered when it is done
            command::SAVE if self.saving != Saving::No => return Err(ExceptionCode::ServerDeviceBusy),
            command::SAVE => self.saving = Saving::Asked(0),
            command::DEFAULTS => {
                self.change = Change::Defaults;
                self.limits = Limits::default();
                self.polling.clear();
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
            self.change(Change::RollBack, now);
        }
    }
}

impl Engine {
    /// Starts with settings that were stored; to be called before anything else.
    #[inline(never)] // what it needs of the stack is not needed beside the engine's first state
    pub fn restore(&mut self, settings: &Settings, now: Instant) {
        let Self { core, .. } = self;
        core.idle_until = AT_ONCE;
        core.confirmed = settings.network;
        core.limits = settings.limits;
        core.set_slots(&SlotSettings::default(), &settings.slots, now);
        core.change(Change::RollBack, now);
    }

    /// Whether the host asked for a save that [`Engine::take_save`] has not handed out.
    #[must_use]
    pub const fn wants_save(&self) -> bool {
        matches!(self.core.saving, Saving::Asked(_))
    }

    /// Writes what is to be stored, once after the host asked for it; tells whether it did. [`Engine::saved`] ends the
    /// command.
    #[inline(never)] // what it needs of the stack is not needed while the store works
    pub fn take_save(&mut self, stored: &mut [u8; STORED_LENGTH]) -> bool {
        let Self { core, .. } = self;
        let Saving::Asked(unit) = core.saving else { return false };
        core.saving = Saving::Taken(unit);
        Holding { network: &core.confirmed, ..core.holding(&core.slots()) }.encode(stored);
        true
    }

    /// Whether what was to be stored is stored: the host gets its answer.
    #[inline(never)] // rare
    pub fn saved(&mut self, stored: bool) {
        let Self { core, .. } = self;
        let Saving::Taken(unit) = core.saving else { return };
        core.saving = Saving::No;
        let function = FunctionCode::WriteSingleRegister.code();
        let [counters, ..] = &mut core.counters;
        if stored {
            let [high, low] = command::SAVE.to_be_bytes();
            core.output.relay(counters, unit, &[function, 0, 0, high, low]);
        } else {
            core.output.refuse(counters, unit, function, ExceptionCode::ServerDeviceFailure);
        }
    }
}

/// Word `index` of a value of so many words, high word first.
const fn word(value: u64, words: u16, index: u16) -> u16 {
    let place = words.wrapping_sub(1).wrapping_sub(index) as u32;
    value.wrapping_shr(place.wrapping_mul(16)) as u16
}
