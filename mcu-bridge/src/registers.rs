//! The register map of the bridge's own unit, 247, as one table.
//!
//! The engine dispatches by it, `REGISTERS.md` is written from it, and these constants are its rows. Values wider than a
//! register come high word first.

use crate::board::{Description, ROUTES, TARGETS_MAX};

/// Version of the map.
pub const MAP: u16 = 1;

/// Number of polling slots.
pub const SLOTS: usize = 8;

/// Last input register; what is listed nowhere up to there reads 0.
pub const INPUT_LAST: u16 = 0x02FF;

/// Values of [`COMMAND`].
pub mod command {
    /// Checks the staged ports and routes and makes them live; without [`CONFIRM`] in time the former ones return.
    pub const APPLY: u16 = 0xA991;
    /// Keeps what was applied.
    pub const CONFIRM: u16 = 0xC0F1;
    /// Stores what is confirmed, and the registers that act at once.
    pub const SAVE: u16 = 0x5A7E;
    /// Stages the board's ports and routes, and sets the registers that act at once to their defaults.
    pub const DEFAULTS: u16 = 0xDEFA;
    /// Restarts the bridge after the answer has been sent.
    pub const REBOOT: u16 = 0xB007;
    /// Clears all counters.
    pub const CLEAR_COUNTERS: u16 = 0xC1EA;
}

/// Which of the two spaces a register is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Space {
    /// Function code 04.
    Input,
    /// Function codes 03, 06 and 10.
    Holding,
}

/// What a write does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// It can't be written.
    Read,
    /// It acts at once, and the register reads 0.
    Command,
    /// It acts at once.
    Write,
    /// It is staged, and acts with [`command::APPLY`].
    Staged,
}

/// How often a register is there, one for each of something.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Repeat {
    /// Once.
    Once,
    /// For each port of the board.
    Ports,
    /// For each target of the board.
    Targets,
    /// For each route.
    Routes,
    /// For each polling slot.
    Slots,
}

impl Repeat {
    /// How many there are on a board.
    #[must_use]
    pub const fn count(self, board: &Description) -> usize {
        match self {
            Self::Once => 1,
            Self::Ports => board.ports.len(),
            Self::Targets => board.targets(),
            Self::Routes => ROUTES,
            Self::Slots => SLOTS,
        }
    }
}

/// Which values can be written one by one; together they are checked by [`command::APPLY`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Range {
    /// Every value.
    Any,
    /// From one to another.
    Between(u16, u16),
    /// One of a few.
    OneOf(&'static [u16]),
    /// The number of one of the board's targets.
    Target,
}

impl Range {
    /// Whether it holds a value, on a board.
    #[must_use]
    pub const fn contains(self, value: u16, board: &Description) -> bool {
        match self {
            Self::Any => true,
            Self::Between(first, last) => first <= value && value <= last,
            Self::OneOf(mut values) => loop {
                let [first, rest @ ..] = values else { return false };
                if *first == value {
                    return true;
                }
                values = rest;
            },
            Self::Target => board.target(value).is_some(),
        }
    }
}

/// The value before anybody has written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Initial {
    /// What is measured or counted.
    None,
    /// The same on every board.
    Value(u16),
    /// The board's.
    Board,
}

/// A row of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Register {
    /// Name in documents and tools.
    pub name: &'static str,
    /// Input or holding register.
    pub space: Space,
    /// Address of the first one.
    pub address: u16,
    /// Registers that its value takes.
    pub words: u16,
    /// From one to the next, where it repeats.
    pub stride: u16,
    /// How often it is there.
    pub repeat: Repeat,
    /// What a write does.
    pub access: Access,
    /// Unit of its value; empty where it has none.
    pub unit: &'static str,
    /// Which values can be written.
    pub range: Range,
    /// Its value before anybody has written.
    pub initial: Initial,
    /// Its meaning.
    pub meaning: &'static str,
    /// What the engine puts there.
    pub(crate) field: Field,
}

impl Register {
    /// Address of the one at that place, counted from 0.
    #[must_use]
    pub const fn at(&self, index: usize) -> u16 {
        self.address.wrapping_add(self.stride.wrapping_mul(index as u16))
    }
}

/// What the engine needs of a [`Register`]: without its texts, which take no flash then.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Row {
    address: u16,
    pub(crate) words: u16,
    stride: u16,
    pub(crate) repeat: Repeat,
    pub(crate) access: Access,
    pub(crate) range: Range,
    pub(crate) field: Field,
}

impl Row {
    const fn of(register: &Register) -> Self {
        let Register { address, words, stride, repeat, access, range, field, .. } = *register;
        Self { address, words, stride, repeat, access, range, field }
    }

    const fn at(&self, index: u16) -> u16 {
        self.address.wrapping_add(self.stride.wrapping_mul(index))
    }
}

/// All rows, in the order of the addresses of each space.
pub(crate) fn rows() -> impl Iterator<Item = &'static Row> {
    BLOCKS.iter().flat_map(|block| block.rows)
}

/// The row of an address of a board, its place, and the word of its value there.
#[must_use]
pub(crate) fn find(space: Space, address: u16, board: &Description) -> Option<(&'static Row, usize, u16)> {
    let block = BLOCKS.iter().find(|block| block.space == space && block.contains(address))?;
    let offset = address.wrapping_sub(block.address);
    let index = offset.checked_div(block.stride).unwrap_or(0);
    let offset = offset.checked_rem(block.stride).unwrap_or(offset);
    let row = block.rows.iter().find(|row| {
        let word = offset.wrapping_sub(row.address.wrapping_sub(block.address));
        word < row.words
    })?;
    let word = address.wrapping_sub(row.at(index));
    (usize::from(index) < row.repeat.count(board)).then_some((row, index.into(), word))
}

/// Rows that repeat together.
struct Block {
    space: Space,
    address: u16,
    stride: u16,
    /// Most of them on any board.
    most: u16,
    rows: &'static [Row],
}

impl Block {
    const fn contains(&self, address: u16) -> bool {
        let span = match self.stride {
            0 => self.most,
            stride => stride.wrapping_mul(self.most),
        };
        address.wrapping_sub(self.address) < span
    }
}

macro_rules! registers {
    ($($space:ident $repeat:ident $address:literal, stride $stride:literal, most $most:literal: {
        $($offset:literal $words:literal $name:ident $field:ident $access:ident, $unit:literal, $range:expr, $initial:expr,
            $meaning:literal;)*
    })*) => {
        /// What the engine puts into a register.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub(crate) enum Field {
            $($($field,)*)*
        }

        $($(
            #[doc = concat!(
                $meaning, " ", stringify!($space), " register ", stringify!($address), " + ", stringify!($offset),
                ", ", stringify!($words), " long; stride ", stringify!($stride), "."
            )]
            pub const $name: Register = Register {
                name: stringify!($name),
                space: Space::$space,
                address: $address + $offset,
                words: $words,
                stride: $stride,
                repeat: Repeat::$repeat,
                access: Access::$access,
                unit: $unit,
                range: $range,
                initial: $initial,
                meaning: $meaning,
                field: Field::$field,
            };
        )*)*

        /// Every register, in the order of the addresses of each space.
        pub const ALL: &[Register] = &[$($($name,)*)*];

        const BLOCKS: &[Block] = &[$(Block {
            space: Space::$space,
            address: $address,
            stride: $stride,
            most: $most,
            rows: &[$(Row::of(&$name),)*],
        },)*];
    };
}

use Initial::{Board, None as NoInitial, Value};
use Range::{Any, Between, OneOf};

registers! {
    Input Once 0x0000, stride 0, most 16: {
        0x00 1 MAP_VERSION MapVersion Read, "", Any, NoInitial, "Version of this map.";
        0x01 1 FIRMWARE_MAJOR FirmwareMajor Read, "", Any, NoInitial, "Version of the firmware, major.";
        0x02 1 FIRMWARE_MINOR FirmwareMinor Read, "", Any, NoInitial, "Version of the firmware, minor.";
        0x03 1 FIRMWARE_PATCH FirmwarePatch Read, "", Any, NoInitial, "Version of the firmware, patch.";
        0x04 4 UPTIME Uptime Read, "us", Any, NoInitial, "Time since the bridge started.";
        0x08 1 RESET_CAUSE ResetCause Read, "", Any, NoInitial,
            "Why the bridge started: 1 power-on, 2 reset pin, 3 software, 4 watchdog, 5 panic.";
        0x09 1 HEALTH Health Read, "", Any, NoInitial,
            "Bits: 0 internal oscillator, 1 no CAN controller, 2 CAN bus-off now, 3 configuration defaulted, 4 configuration unconfirmed.";
        0x0A 1 PORT_COUNT PortCount Read, "", Any, NoInitial, "Number of ports.";
        0x0B 1 TARGET_COUNT TargetCount Read, "", Any, NoInitial, "Number of targets that a route can lead to.";
        0x0C 1 ROUTE_COUNT RouteCount Read, "", Any, NoInitial, "Number of routes.";
        0x0D 1 SLOT_COUNT SlotCount Read, "", Any, NoInitial, "Number of polling slots.";
        0x0E 1 BOARD_NUMBER BoardNumber Read, "", Any, NoInitial, "Number of the board; 1 is the STM32F405.";
    }
    Input Targets 0x0010, stride 1, most 16: {
        0x00 1 TARGET TargetKind Read, "", Any, NoInitial,
            "Kind of target 1 and up in the low byte: 1 serial, 2 CAN, 4 outputs as NXI, 5 inputs and outputs as NDAM, 6 the bridge; its port in the high byte, 0 where it has none.";
    }
    Input Ports 0x0020, stride 0x20, most 6: {
        0x00 2 RECEIVED Received Read, "frames", Any, NoInitial, "Frames received.";
        0x02 2 SENT Sent Read, "frames", Any, NoInitial, "Frames sent; on CAN frames, not transfers.";
        0x04 2 CHECKSUM_ERRORS ChecksumErrors Read, "frames", Any, NoInitial,
            "Frames and characters with a wrong checksum, parity or stop bit.";
        0x06 2 DROPPED_BURSTS DroppedBursts Read, "bursts", Any, NoInitial,
            "Dropped bursts; one to an unknown unit counts as refused instead.";
        0x08 2 TIMEOUTS Timeouts Read, "attempts", Any, NoInitial, "Attempts that no response came to in time.";
        0x0A 2 RETRIES Retries Read, "attempts", Any, NoInitial, "Reads sent again.";
        0x0C 2 FOREIGN_OR_LATE ForeignOrLate Read, "frames", Any, NoInitial,
            "Frames that belong to no request, or came too late for theirs.";
        0x0E 2 OVERRUNS Overruns Read, "", Any, NoInitial, "Times that received bytes or frames were lost.";
        0x10 2 EXPIRED Expired Read, "requests", Any, NoInitial,
            "Requests whose time to live ended before they were sent; at the bus's port.";
        0x12 2 REFUSED Refused Read, "requests", Any, NoInitial,
            "Requests refused: queue full, unknown unit, quarantine, write protection; at the host's port.";
        0x14 2 BUS_OFF BusOff Read, "", Any, NoInitial, "Times that the CAN controller went bus-off.";
        0x16 2 TRANSMIT_ERRORS TransmitErrors Read, "", Any, NoInitial, "Transmit errors and collisions.";
    }
    Input Slots 0x0100, stride 0x20, most 8: {
        0x00 1 SLOT_STATE SlotState Read, "", Any, NoInitial, "0 off, 1 no sample yet, 2 fresh, 3 stale.";
        0x01 1 SLOT_READS SlotReads Read, "", Any, NoInitial, "The unit that the slot reads.";
        0x02 2 SLOT_SEQUENCE SlotSequence Read, "", Any, NoInitial, "Samples so far.";
        0x04 4 SLOT_TIMESTAMP SlotTimestamp Read, "us", Any, NoInitial,
            "When the last byte or frame of the newest sample came, since the bridge started.";
        0x08 2 SLOT_MISSED SlotMissed Read, "periods", Any, NoInitial, "Periods that ended before the slot could read.";
        0x0A 2 SLOT_FAILURES SlotFailures Read, "reads", Any, NoInitial, "Reads without a response.";
        0x0C 12 SLOT_SAMPLE SlotSample Read, "counts", Any, NoInitial,
            "The newest sample: Fx, Fy, Fz, Tx, Ty, Tz as i32 each.";
    }
    Input Routes 0x0200, stride 4, most 16: {
        0x00 1 QUARANTINED Quarantined Read, "", Any, NoInitial,
            "Units of the route in quarantine; bit 0 is its first unit.";
        0x01 1 RESPONSE_TIME ResponseTime Read, "10 us", Any, NoInitial, "Response time of the last transaction.";
        0x02 1 RESPONSE_TIME_MAX ResponseTimeMax Read, "10 us", Any, NoInitial, "Largest such time.";
    }
    Holding Once 0x0000, stride 0, most 1: {
        0x00 1 COMMAND Command Command, "", OneOf(&[
            command::APPLY, command::CONFIRM, command::SAVE, command::DEFAULTS, command::REBOOT, command::CLEAR_COUNTERS,
        ]), Value(0),
            "A command: 0xA991 apply, 0xC0F1 confirm, 0x5A7E save, 0xDEFA defaults, 0xB007 reboot, 0xC1EA clear counters.";
    }
    Holding Ports 0x0010, stride 8, most 6: {
        0x00 1 PORT_RATE PortRate Staged, "100 bit/s; CAN: kbit/s", Between(1, u16::MAX), Board, "Baud or bit rate.";
        0x01 1 PORT_FORMAT PortFormat Staged, "", OneOf(&[0x0100, 0x0101, 0x0102, 0x0200, 0x0201, 0x0202]), Board,
            "Parity in the low byte: 0 none, 1 even, 2 odd; stop bits in the high byte: 1 or 2.";
        0x02 1 PORT_GAP PortGap Staged, "100 us", Any, Board, "Silence before a frame; 0 is 3.5 characters.";
        0x03 1 PORT_NODE PortNode Staged, "", Between(0, 255), Board, "CAN: the bridge's own node, 1 to 127.";
        0x04 1 PORT_FLAGS PortFlags Staged, "", Between(0, 1), Board, "Bit 0: the port hears what it sends.";
    }
    Holding Once 0x0040, stride 0, most 4: {
        0x00 1 QUARANTINE_AFTER QuarantineAfter Write, "transactions", Between(0, 255), Board,
            "Transactions in a row without a response until a device is in quarantine; 0 is never.";
        0x01 1 PROBE_PERIOD ProbePeriod Write, "ms", Between(1, u16::MAX), Board,
            "Time between two probes of a device in quarantine.";
        0x02 1 HOST_SILENCE HostSilence Write, "ms", Any, Board,
            "Time without a valid request that switches the board's own outputs off; 0 is never.";
        0x03 1 BURST_SILENCE BurstSilence Write, "100 us", Between(1, u16::MAX), Board,
            "Silence that ends a burst from the host.";
    }
    Holding Slots 0x0050, stride 2, most 8: {
        0x00 1 SLOT_UNIT SlotUnit Write, "", Between(0, 255), Value(0), "Unit that the slot reads.";
        0x01 1 SLOT_PERIOD SlotPeriod Write, "100 us", Any, Value(0), "Period of the slot; 0 is off.";
    }
    Holding Routes 0x0100, stride 0x10, most 16: {
        0x00 1 ROUTE_FIRST_UNIT RouteFirstUnit Staged, "", Between(0, 255), Board,
            "First unit that the host sees.";
        0x01 1 ROUTE_LAST_UNIT RouteLastUnit Staged, "", Between(0, 255), Board,
            "Last unit that the host sees; 0 with a first unit of 0 leaves the row unused.";
        0x02 1 ROUTE_TARGET RouteTarget Staged, "", Range::Target, Board, "Number of the target.";
        0x03 1 ROUTE_PROTOCOL RouteProtocol Staged, "", Between(0, 3), Board,
            "0 Modbus RTU, 1 Modbus ASCII, 2 NST, 3 NST over CAN.";
        0x04 1 ROUTE_FIRST_ADDRESS RouteFirstAddress Staged, "", Between(0, 255), Board,
            "Address of the first unit over there: 1 to 254 on Modbus, 1 to 127 on NST.";
        0x05 1 ROUTE_READ_TIMEOUT RouteReadTimeout Staged, "ms", Between(1, u16::MAX), Board,
            "Time that a device has to answer a read.";
        0x06 1 ROUTE_WRITE_TIMEOUT RouteWriteTimeout Staged, "ms", Between(1, u16::MAX), Board,
            "Time that a device has to answer anything else.";
        0x07 1 ROUTE_RETRIES RouteRetries Staged, "", Between(0, 9), Board, "How often a read is sent again.";
        0x08 1 ROUTE_TIME_TO_LIVE RouteTimeToLive Staged, "ms", Between(1, u16::MAX), Board,
            "Time after which a request is no longer sent.";
        0x09 1 ROUTE_LATE_WINDOW RouteLateWindow Staged, "ms", Any, Board,
            "How long a late response is waited for; 0 is three times the timeout.";
        0x0A 1 ROUTE_FLAGS RouteFlags Staged, "", Between(0, 1), Board, "Bit 0: refuses writes.";
    }
}

const _: () = assert!(TARGETS_MAX == 16 && ROUTES == 16 && SLOTS == 8 && crate::board::PORTS_MAX == 6);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::boards::stm32f405::BOARD;

    #[test]
    fn every_register_is_found_where_it_is_and_nowhere_else() {
        let mut found = std::collections::BTreeMap::new();
        for row in ALL {
            for index in 0..row.repeat.count(BOARD) {
                for word in 0..row.words {
                    let address = row.at(index) + word;
                    let expected = Some((&Row::of(row), index, word));
                    assert_eq!(find(row.space, address, BOARD), expected, "{}", row.name);
                    let key = (row.space == Space::Input, address);
                    assert_eq!(found.insert(key, row.name), None, "two registers at {address:#06x}");
                }
            }
        }
        for (space, is_input) in [(Space::Input, true), (Space::Holding, false)] {
            for address in 0..=u16::MAX {
                assert_eq!(
                    find(space, address, BOARD).is_some(),
                    found.contains_key(&(is_input, address)),
                    "{space:?} {address:#06x}"
                );
            }
        }
    }

    #[test]
    fn a_range_tells_which_values_it_holds() {
        assert!(PORT_FORMAT.range.contains(0x0201, BOARD) && !PORT_FORMAT.range.contains(0x0003, BOARD));
        assert!(ROUTE_RETRIES.range.contains(9, BOARD) && !ROUTE_RETRIES.range.contains(10, BOARD));
        assert!(ROUTE_TARGET.range.contains(6, BOARD));
        assert!(![0, 7].iter().any(|number| ROUTE_TARGET.range.contains(*number, BOARD)));
    }
}
