//! What the host asks, made so that the right answer can be told from every other one by its content.

use super::boards::INPUTS;
use super::station::pattern;
use jointbus_mcu_bridge::board::{Protocol, Route};
use jointbus_protocol::modbus::{self, AddressRange, FunctionCode, rtu};
use jointbus_protocol::nst::{self, Sample, SignEncoding, can, register, serial};
use jointbus_protocol::nxi6201;
use jointbus_protocol::time::Instant;

/// First register of the analog inputs and of the analog outputs of a module.
const ANALOG_INPUTS: u16 = 0x40;
const ANALOG_OUTPUTS: u16 = 0x60;

/// First digital output of a module, as a coil.
const COILS: u16 = 0x0200;

/// A register that no module has.
const NOWHERE: u16 = 0x99;

/// The output card's bit rate setting (NXI-6201 manual, 5.1.29).
const CARD_RATE: u16 = 422;

/// The bridge's input registers of its first polling slot.
const SLOT: AddressRange = AddressRange::new(0x0100, 24);

/// The bridge's input register of its health bits.
const HEALTH: AddressRange = AddressRange::new(0x0009, 1);

/// Function codes that no module knows: those that the host's silence delimits, and three whose length is known.
pub(super) const UNSUPPORTED: [u8; 6] = [0x41, 0x48, 0x64, 0x08, 0x16, 0x17];

/// A question to one unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Question {
    /// NST: registers that hold a pattern of their own.
    Pattern {
        /// First register.
        register: u16,
        /// How many.
        length: u8,
    },
    /// NST: the six axes, which spell the moment of the reading.
    Sample {
        /// How many registers: those of the axes, and more.
        length: u8,
    },
    /// NST: a write of a number that is used once.
    Write {
        /// First register.
        register: u16,
        /// Length of the data, four bytes at least.
        length: u8,
        /// The number.
        token: u32,
    },
    /// NST: set zero, or clear zero, which can't be told apart from another of its kind.
    Command {
        /// Which of them.
        set: bool,
    },
    /// Modbus: analog inputs, which spell the moment of the reading.
    Inputs {
        /// First channel.
        first: u8,
        /// How many.
        count: u8,
    },
    /// Modbus 06: an analog output, to a number that is used once.
    SetOne {
        /// The channel.
        channel: u8,
        /// The number.
        token: u16,
    },
    /// Modbus 16: two analog outputs, to a number that is used once.
    SetTwo {
        /// The first channel.
        channel: u8,
        /// The number.
        token: u32,
    },
    /// Modbus: a register that does not exist.
    Nowhere,
    /// Modbus 08: the bridge returns a number.
    Loopback {
        /// The number.
        token: u16,
    },
    /// Modbus: a function code that no module knows.
    Unsupported {
        /// Function code.
        function: u8,
        /// A number that is used once.
        token: u16,
    },
    /// The board's analog inputs, which stay as they are.
    BoardInputs {
        /// The first channel.
        first: u8,
        /// How many.
        count: u8,
    },
    /// Modbus 05: a digital output of the board.
    BoardOutput {
        /// The channel.
        channel: u8,
        /// On or off.
        on: bool,
    },
    /// The bit rate setting of the output card.
    CardRate,
    /// The output card's set value of a channel.
    CardValue {
        /// The channel.
        channel: u8,
        /// A number that is used once; its set value is made of it.
        token: u16,
    },
    /// The first polling slot as a block.
    Slot,
    /// The bridge's health bits.
    Health,
}

/// How an answer fits a question.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fit {
    /// It is the answer.
    Right,
    /// It is the answer if it was measured at this moment, which was before the question or is used up otherwise.
    At(Instant),
    /// It is the answer if a module of the station had such inputs since the question.
    Inputs,
    /// It is not.
    Wrong,
}

impl Question {
    /// Whether it changes nothing.
    #[must_use]
    pub const fn is_read(&self) -> bool {
        matches!(
            self,
            Self::Pattern { .. }
                | Self::Sample { .. }
                | Self::Inputs { .. }
                | Self::Nowhere
                | Self::Loopback { .. }
                | Self::BoardInputs { .. }
                | Self::CardRate
                | Self::Slot
                | Self::Health
        )
    }

    /// The number that is used once, if it is a write with one.
    #[must_use]
    pub const fn token(&self) -> Option<u32> {
        match *self {
            Self::Write { token, .. } | Self::SetTwo { token, .. } => Some(token),
            Self::SetOne { token, .. } => Some(token as u32),
            _ => None,
        }
    }

    /// Whether only silence ends its frame.
    #[must_use]
    pub const fn ends_with_silence(&self) -> bool {
        matches!(self, Self::Unsupported { function: 0x41.., .. })
    }

    /// Transfers that it takes on CAN.
    #[must_use]
    pub fn transfers(&self, route: &Route) -> u64 {
        match (route.protocol, self) {
            (Protocol::NstOverCan, Self::Pattern { length, .. }) => {
                u64::from(*length).div_ceil(can::READ_MAX as u64)
            }
            (Protocol::NstOverCan, Self::Write { length, .. }) => {
                u64::from(*length).div_ceil(can::WRITE_MAX as u64)
            }
            _ => 1,
        }
    }

    /// The whole frame for `unit`.
    ///
    /// # Panics
    /// Never: every question fits a frame.
    #[must_use]
    pub fn frame(&self, unit: u8) -> Vec<u8> {
        let mut buffer = [0; rtu::FRAME_MAX];
        let zero_points = |function| nst::Request::Command {
            function,
            register: register::ZERO_POINTS.first,
            length: register::ZERO_POINTS.length as u8,
        };
        let mut data = [0xA5; nst::WRITE_DATA_MAX];
        let in_nst = match *self {
            Self::Pattern { register, length } => Some(nst::Request::read(register, length)),
            Self::Sample { length } => Some(nst::Request::read(register::DATA.first, length)),
            Self::Write { register, length, token } => {
                data[..4].copy_from_slice(&token.to_be_bytes());
                Some(nst::Request::Write { register, data: &data[..usize::from(length)] })
            }
            Self::Command { set: true } => Some(zero_points(nst::FunctionCode::SetZero)),
            Self::Command { set: false } => Some(zero_points(nst::FunctionCode::ClearZero)),
            _ => None,
        };
        if let Some(request) = in_nst {
            let frame = serial::encode_request(unit, &request, &mut buffer);
            return frame.unwrap_or_else(|_| unreachable!("it fits")).to_vec();
        }
        let (mut data, mut length) = ([0; 11], 0);
        let mut put = |bytes: &[u8]| {
            data[length..length + bytes.len()].copy_from_slice(bytes);
            length += bytes.len();
        };
        match *self {
            Self::SetTwo { token, .. } => put(&token.to_be_bytes()),
            Self::Loopback { token } => put(&[&[0, 0][..], &token.to_be_bytes()].concat()),
            Self::CardValue { token, .. } => {
                // low word first, at most 5 V
                let [a, b, c, d] = (f32::from(token) / 16_384.0).to_be_bytes();
                put(&[c, d, a, b]);
            }
            // an address and two masks; or a range to be read, and one register to be written; or anything
            Self::Unsupported { function, token } => {
                put(&[0, 0]);
                put(&token.to_be_bytes());
                put(match function {
                    0x16 => &[0xA5, 0x5A],
                    0x17 => &[0, 0x60, 0, 1, 2, 0, 7],
                    0x08 => &[],
                    _ => &[0x10, 0x20, 0x30],
                });
            }
            _ => {}
        }
        let data = &data[..length];
        let request = match *self {
            Self::Inputs { first, count } | Self::BoardInputs { first, count } => {
                modbus::Request::ReadInputRegisters(AddressRange::new(
                    ANALOG_INPUTS + u16::from(first),
                    count.into(),
                ))
            }
            Self::SetOne { channel, token } => modbus::Request::WriteSingleRegister {
                address: ANALOG_OUTPUTS + u16::from(channel),
                value: token,
            },
            Self::SetTwo { channel, .. } => modbus::Request::WriteMultipleRegisters {
                range: AddressRange::new(ANALOG_OUTPUTS + u16::from(channel), 2),
                data,
            },
            Self::BoardOutput { channel, on } => modbus::Request::WriteSingleCoil {
                address: COILS + u16::from(channel),
                value: if on { 0xFF00 } else { 0 },
            },
            Self::CardRate => modbus::Request::ReadHoldingRegisters(AddressRange::new(CARD_RATE, 2)),
            Self::CardValue { channel, .. } => modbus::Request::WriteMultipleRegisters {
                range: AddressRange::new(4 + 20 * u16::from(channel), 2),
                data,
            },
            Self::Slot => modbus::Request::ReadInputRegisters(SLOT),
            Self::Health => modbus::Request::ReadInputRegisters(HEALTH),
            Self::Nowhere => modbus::Request::ReadInputRegisters(AddressRange::new(NOWHERE, 1)),
            Self::Unsupported { function, .. } => {
                modbus::Request::Other { function: FunctionCode::from_code(function), data }
            }
            _ => modbus::Request::Other { function: FunctionCode::Diagnostics, data },
        };
        rtu::encode_request(unit, &request, &mut buffer).unwrap_or_else(|_| unreachable!("it fits")).to_vec()
    }

    /// Whether a reply, from function code on, answers this question to the device with this
    /// [number](super::device_number).
    #[must_use]
    pub fn fit(&self, device: u8, reply: &[u8]) -> Fit {
        let right = |fits: bool| if fits { Fit::Right } else { Fit::Wrong };
        // whatever the unit is
        let request = self.frame(0);
        match (*self, reply) {
            (Self::Sample { length }, [0x03, count, axes @ ..])
                if length == *count && axes.len() == usize::from(length) =>
            {
                let sample =
                    axes.first_chunk().map(|axes| Sample::decode(axes, SignEncoding::TwosComplement));
                sample
                    .and_then(|sample| jointbus::devices::motion::spelt_moment(&sample))
                    .map_or(Fit::Wrong, Fit::At)
            }
            (Self::Pattern { register, length }, [0x03, count, data @ ..]) => {
                let expected = (register..).map(|register| pattern(device, register));
                right(
                    *count == length
                        && data.len() == usize::from(length)
                        && expected.zip(data).all(|(a, b)| a == *b),
                )
            }
            (Self::Write { length, .. }, [0x10, count]) => right(*count == length),
            (Self::Command { set }, [function, 24]) => right(*function == if set { 0x12 } else { 0x19 }),
            (Self::Inputs { count, .. }, [0x04, bytes, data @ ..]) => {
                if *bytes == 2 * count && data.len() == usize::from(*bytes) {
                    Fit::Inputs
                } else {
                    Fit::Wrong
                }
            }
            (Self::SetOne { .. } | Self::Loopback { .. } | Self::BoardOutput { .. }, reply) => {
                right(request.get(1..request.len() - 2) == Some(reply))
            }
            (Self::SetTwo { .. } | Self::CardValue { .. }, reply) => right(request.get(1..6) == Some(reply)),
            (Self::Unsupported { function, .. }, reply) => right(reply == [function | 0x80, 1]),
            (Self::BoardInputs { .. }, [0x04, _, data @ ..]) => {
                let expected = INPUTS.get(self.channels()).unwrap_or(&[]);
                right(expected.iter().flat_map(|value| value.to_be_bytes()).eq(data.iter().copied()))
            }
            (Self::CardRate, [0x03, 4, data @ ..]) => {
                let rate = nxi6201::Settings::default().read(nxi6201::Register::CanBitRate);
                let [a, b, c, d] = rate.unwrap_or(0).to_be_bytes();
                right(data == [c, d, a, b])
            }
            (Self::Health, reply) => right(matches!(reply, [0x04, 2, 0, _])),
            (Self::Slot, [0x04, 48, data @ ..]) => right(is_coherent(data)),
            (Self::Nowhere, reply) => right(reply == [0x84, 2]),
            _ => Fit::Wrong,
        }
    }

    /// The channels that it reads, if it reads inputs.
    #[must_use]
    pub fn channels(&self) -> std::ops::Range<usize> {
        match *self {
            Self::Inputs { first, count } | Self::BoardInputs { first, count } => {
                usize::from(first)..usize::from(first) + usize::from(count)
            }
            _ => 0..0,
        }
    }
}

/// Whether a slot's registers belong to one moment: a sample that is none yet, or one whose axes spell a single moment
/// shortly before its stamp.
fn is_coherent(registers: &[u8]) -> bool {
    let stamp =
        registers.get(8..).and_then(|rest| rest.first_chunk()).map_or(0, |at| u64::from_be_bytes(*at));
    let axes =
        registers.get(24..).unwrap_or(&[]).as_chunks::<4>().0.iter().map(|axis| i32::from_be_bytes(*axis));
    let mut sample = Sample::default();
    sample.0.iter_mut().zip(axes).for_each(|(place, axis)| *place = axis);
    let measured = jointbus::devices::motion::spelt_moment(&sample).map(Instant::as_micros);
    match registers {
        [0, 0 | 1, ..] => stamp == 0,
        _ => measured.is_some_and(|measured| measured < stamp && stamp - measured < 1_000_000),
    }
}
