//! Unit 247: the bridge's own registers, dispatched by their table.

use super::actions::Action;
use super::core::{Diagnostics, Saving, Shared};
use super::counters::Counters;
use super::identity::Health;
use super::polling::Slot;
use super::settings::SlotSettings;
use crate::board::{Description, Identification, LocalKind, PORTS_MAX, PortKind, ROUTES, Target};
use crate::registers::{self, Access, Field, SLOTS, Space, command};
use jointbus_protocol::modbus::identification::{ConformityLevel, ObjectId};
use jointbus_protocol::modbus::server::{self, RegisterWriter, Registers, Server};
use jointbus_protocol::modbus::{AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode, PDU_MAX};
use jointbus_protocol::time::{Duration, Instant};

/// Time in which an applied configuration has to be confirmed.
pub const CONFIRM_WITHIN: Duration = Duration::from_millis(10_000);

/// The bridge's registers, at one moment.
struct Management<'a> {
    shared: &'a mut Shared,
    board: &'a Description,
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
        for address in range.addresses() {
            let found = registers::find(Space::Holding, address, self.board);
            let value =
                found.map_or(0, |(row, index, _)| self.shared.settings.read(row.field, index, self.board));
            out.push(value);
        }
        Ok(())
    }

    fn read_input_registers(
        &mut self,
        range: AddressRange,
        out: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        if !range.within(0, registers::INPUT_LAST) {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        for address in range.addresses() {
            let found = registers::find(Space::Input, address, self.board);
            out.push(found.map_or(0, |(row, index, word)| {
                word_of(self.input(row.field, index, word), row.words, word)
            }));
        }
        Ok(())
    }

    fn write_registers(&mut self, range: AddressRange, values: Registers<'_>) -> Result<(), ExceptionCode> {
        self.write(range, values)
    }

    fn diagnostics(
        &mut self,
        subfunction: DiagnosticSubfunction,
        data: Registers<'_>,
    ) -> Result<Option<u16>, ExceptionCode> {
        let [host, ..] = &self.shared.counters;
        let Diagnostics { requests, exceptions } = self.shared.diagnostics;
        let count = match subfunction {
            DiagnosticSubfunction::ReturnQueryData => return Ok(None),
            _ if data.get(0) != Some(0) => return Err(ExceptionCode::IllegalDataValue),
            DiagnosticSubfunction::ClearCounters => {
                self.shared.clear_counters();
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
        let Identification { vendor, product_code, product_name, model_name } = self.board.identification;
        let text = match object {
            ObjectId::VendorName => vendor,
            ObjectId::ProductCode => product_code,
            ObjectId::MajorMinorRevision => env!("CARGO_PKG_VERSION"),
            ObjectId::ProductName => product_name,
            ObjectId::ModelName => model_name,
            ObjectId::UserApplicationName => "bridge",
            ObjectId::VendorUrl | ObjectId::Unknown(_) => return None,
        };
        Some(text.as_bytes())
    }
}

impl Management<'_> {
    /// The value of an input register. A wide one that repeats within itself is told by its word.
    fn input(&self, field: Field, index: usize, word: u16) -> u64 {
        let shared = &*self.shared;
        let [major, minor, patch] = shared.identity.version;
        match field {
            Field::MapVersion => registers::MAP.into(),
            Field::FirmwareMajor => major.into(),
            Field::FirmwareMinor => minor.into(),
            Field::FirmwarePatch => patch.into(),
            Field::Uptime => self.now.as_micros(),
            Field::ResetCause => shared.identity.reset_cause.value().into(),
            Field::Health => shared.health_bits().into(),
            Field::PortCount => self.board.ports.len() as u64,
            Field::TargetCount => self.board.targets() as u64,
            Field::RouteCount => ROUTES as u64,
            Field::SlotCount => SLOTS as u64,
            Field::BoardNumber => self.board.number.into(),
            Field::TargetKind => target_kind(self.board, index).into(),
            Field::Quarantined => {
                let route = shared.live.routes.get(index);
                route.map_or(0, |route| shared.quarantine.mask(route, &shared.settings.limits).into())
            }
            Field::ResponseTime => shared.reply_times.get(index).map_or(0, |time| time.last.into()),
            Field::ResponseTimeMax => shared.reply_times.get(index).map_or(0, |time| time.largest.into()),
            _ => {
                let slot =
                    || shared.polling.slot(index).map_or(0, |slot| slot_value(slot, field, word, self.now));
                shared.counters.get(index).and_then(|port| counter(port, field)).map_or_else(slot, u64::from)
            }
        }
    }

    fn write(&mut self, range: AddressRange, values: Registers<'_>) -> Result<(), ExceptionCode> {
        // into a copy, so that a write is all or nothing
        let mut settings = self.shared.settings;
        let mut command = None;
        for (address, value) in range.addresses().zip(values.iter()) {
            let (row, index, _) = registers::find(Space::Holding, address, self.board)
                .ok_or(ExceptionCode::IllegalDataAddress)?;
            if !row.range.contains(value, self.board) {
                return Err(ExceptionCode::IllegalDataValue);
            }
            match row.access {
                Access::Command => command = Some(value),
                _ => settings.write(row.field, index, value, self.board),
            }
        }
        match command {
            Some(command) => self.command(command),
            None => {
                let former = core::mem::replace(&mut self.shared.settings, settings).slots;
                self.shared.start_slots(&former, self.now);
                Ok(())
            }
        }
    }

    /// Only a write of the command register alone gets here: there are no others beside it.
    fn command(&mut self, command: u16) -> Result<(), ExceptionCode> {
        let Self { shared, board, now } = self;
        match command {
            command::APPLY => {
                if !shared.settings.topology.is_valid(board) {
                    return Err(ExceptionCode::IllegalDataValue);
                }
                shared.confirm_until = Some(now.saturating_add(CONFIRM_WITHIN));
                shared.apply = true;
            }
            command::CONFIRM => {
                shared.confirm_until = None;
                shared.confirmed = shared.live;
            }
            // answered when it is done
            command::SAVE if shared.saving != Saving::No => return Err(ExceptionCode::ServerDeviceBusy),
            command::SAVE => {
                shared.saving = Saving::Asked(0);
                shared.actions.push(Action::Store);
            }
            command::DEFAULTS => {
                shared.settings.topology.set_default(board);
                shared.settings.limits = board.limits;
                shared.settings.slots = [(0, 0); SLOTS];
                shared.polling.clear();
            }
            command::REBOOT => shared.actions.push(Action::Reboot),
            command::CLEAR_COUNTERS => shared.clear_counters(),
            _ => return Err(ExceptionCode::IllegalDataValue),
        }
        Ok(())
    }
}

impl Shared {
    /// Answers a request to the bridge itself.
    pub(super) fn serve_bridge(&mut self, board: &Description, unit: u8, pdu: &[u8], now: Instant) {
        self.diagnostics.requests = self.diagnostics.requests.wrapping_add(1);
        let was_saving = self.saving != Saving::No;
        let mut response = [0; PDU_MAX];
        let mut management = Management { shared: self, board, now };
        let Ok(response) = server::respond(&mut management, pdu, &mut response) else { return };
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

    /// Answers the host that its settings are stored, or that they could not be.
    pub(super) fn saved(&mut self, stored: bool) {
        let Saving::Asked(unit) = self.saving else { return };
        self.saving = Saving::No;
        let function = FunctionCode::WriteSingleRegister.code();
        let [counters, ..] = &mut self.counters;
        if stored {
            let [high, low] = command::SAVE.to_be_bytes();
            self.output.relay(counters, unit, &[function, 0, 0, high, low]);
        } else {
            self.output.refuse(counters, unit, function, ExceptionCode::ServerDeviceFailure);
        }
    }

    fn clear_counters(&mut self) {
        self.counters = [Counters::ZERO; PORTS_MAX];
        self.diagnostics = Diagnostics::ZERO;
    }

    fn health_bits(&self) -> u16 {
        let Health { internal_oscillator, no_can, defaulted } = self.health;
        let bits = [
            internal_oscillator,
            no_can,
            self.bus_off.contains(&true),
            defaulted,
            self.confirm_until.is_some(),
        ];
        bits.iter().rev().fold(0, |word, bit| word << 1 | u16::from(*bit))
    }

    /// Starts the slots anew whose settings have changed.
    pub(super) fn start_slots(&mut self, former: &SlotSettings, now: Instant) {
        for (index, (former, (unit, period))) in former.iter().zip(&self.settings.slots).enumerate() {
            if *former != (*unit, *period) {
                self.polling.set(index, Slot::new(*unit, *period, now));
            }
        }
    }
}

/// Kind of a target, counted from 0, and its port.
fn target_kind(board: &Description, index: usize) -> u16 {
    let target = u16::try_from(index).ok().and_then(|index| board.target(index.saturating_add(1)));
    let (kind, port) = match target {
        None => (0, 0),
        Some(Target::Bridge) => (6, 0),
        Some(Target::Local(place)) => match board.local.get(usize::from(place)) {
            Some(LocalKind::Nxi) => (4, 0),
            Some(LocalKind::Ndam) => (5, 0),
            None => (0, 0),
        },
        Some(Target::Bus(port)) => match board.port(port).map(|port| port.kind) {
            Some(PortKind::Serial { .. }) => (1, port.number()),
            Some(PortKind::Can) => (2, port.number()),
            None => (0, 0),
        },
    };
    u16::from_be_bytes([port, kind])
}

/// A counter of a port; `None` where the register is none.
fn counter(port: &Counters, field: Field) -> Option<u32> {
    Some(match field {
        Field::Received => port.received,
        Field::Sent => port.sent,
        Field::ChecksumErrors => port.checksum_errors,
        Field::DroppedBursts => port.dropped_bursts,
        Field::Timeouts => port.timeouts,
        Field::Retries => port.retries,
        Field::ForeignOrLate => port.foreign_or_late,
        Field::Overruns => port.overruns,
        Field::Expired => port.expired,
        Field::Refused => port.refused,
        Field::BusOff => port.bus_off,
        Field::TransmitErrors => port.transmit_errors,
        _ => return None,
    })
}

/// A value of a polling slot; of its sample the axis that the word belongs to, so that the word is right in its place.
fn slot_value(slot: &Slot, field: Field, word: u16, now: Instant) -> u64 {
    match field {
        Field::SlotState => slot.state(now).value().into(),
        Field::SlotReads => slot.unit.into(),
        Field::SlotSequence => slot.sequence.into(),
        Field::SlotTimestamp => slot.timestamp.as_micros(),
        Field::SlotMissed => slot.missed.into(),
        Field::SlotFailures => slot.failures.into(),
        Field::SlotSample => {
            let axis = slot.sample.0.get(usize::from(word / 2)).copied().unwrap_or(0);
            u64::from(axis as u32)
        }
        _ => 0,
    }
}

/// A word of a value of so many words, high word first.
const fn word_of(value: u64, words: u16, word: u16) -> u16 {
    // a sample has two words an axis
    let (words, word) = if words > 4 { (2, word % 2) } else { (words, word) };
    let place = words.wrapping_sub(1).wrapping_sub(word) as u32;
    value.wrapping_shr(place.wrapping_mul(16)) as u16
}
