//! The register map (manual, section 5). Every value has four bytes, two registers: low word first, each word most
//! significant byte first, as the frame printed in section 3 shows; the same section calls values big-endian.

use super::CHANNELS;

/// What a pair of registers holds, at its first address and with its length in registers. Channels count from 0 (`n`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Register {
    /// `2 + 20 n`, length 2: [`OutputRange`] (5.1.1).
    Range(usize),
    /// `4 + 20 n`, length 2: set value as f32, V or mA by range, range 1 in V (5.1.2).
    SetValue(usize),
    /// `6 + 20 n`, length 2: 0 off, 1 on (5.1.3).
    Output(usize),
    /// `8 + 20 n`, length 2: power-up start, 1 on, anything else off (5.1.4).
    StartEnable(usize),
    /// `10 + 20 n`, length 2: power-up range (5.1.5).
    StartRange(usize),
    /// `12 + 20 n`, length 2: power-up set value (5.1.6).
    StartValue(usize),
    /// `80 + 2 n`, length 2: [`External`] control (5.1.7).
    External(usize),
    /// `422`, length 2: CAN bit/s, 5000 to 1000000 (5.1.29).
    CanBitRate,
    /// `424`, length 2: CAN ID, 1 to 127 (5.1.30).
    CanId,
    /// `428`, length 2: keep range, set value and external control over power-off (5.1.31).
    Keep,
    /// `62436`, length 2: written with 1, every setting that has a default returns to it (5.1.32). Write only.
    FactoryReset,
}

impl Register {
    /// The register pair at an even address.
    #[must_use]
    pub const fn at(address: u16) -> Option<Self> {
        match address {
            2..=73 => {
                let offset = address.wrapping_sub(2);
                let channel = (offset / 20) as usize;
                match offset % 20 {
                    0 => Some(Self::Range(channel)),
                    2 => Some(Self::SetValue(channel)),
                    4 => Some(Self::Output(channel)),
                    6 => Some(Self::StartEnable(channel)),
                    8 => Some(Self::StartRange(channel)),
                    10 => Some(Self::StartValue(channel)),
                    _ => None,
                }
            }
            80 | 82 | 84 | 86 => Some(Self::External((address.wrapping_sub(80) / 2) as usize)),
            422 => Some(Self::CanBitRate),
            424 => Some(Self::CanId),
            428 => Some(Self::Keep),
            62436 => Some(Self::FactoryReset),
            _ => None,
        }
    }
}

/// Range of a channel (5.1.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum OutputRange {
    /// 0: -5 V to 5 V.
    #[default]
    Volts5,
    /// 1: -200 mV to 200 mV; set values are in V.
    Millivolts200,
    /// 2: -200 mA to 200 mA; set values are in mA.
    Milliamperes200,
}

impl OutputRange {
    /// The range with this number; `None` above 2.
    #[must_use]
    pub const fn from_value(value: u32) -> Option<Self> {
        match value {
            0 => Some(Self::Volts5),
            1 => Some(Self::Millivolts200),
            2 => Some(Self::Milliamperes200),
            _ => None,
        }
    }

    /// Its number.
    #[must_use]
    pub const fn value(self) -> u32 {
        match self {
            Self::Volts5 => 0,
            Self::Millivolts200 => 1,
            Self::Milliamperes200 => 2,
        }
    }

    /// Largest magnitude of a set value: V, V, mA.
    #[must_use]
    pub const fn limit(self) -> f32 {
        match self {
            Self::Volts5 => 5.0,
            Self::Millivolts200 => 0.2,
            Self::Milliamperes200 => 200.0,
        }
    }

    /// Whether a set value is a number within the limits.
    #[must_use]
    pub fn contains(self, value: f32) -> bool {
        value.is_finite() && value.abs() <= self.limit()
    }
}

/// What a channel's external input does (5.1.7).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum External {
    /// 0: nothing.
    #[default]
    Off,
    /// 1: each rising edge flips the output (our reading; the manual says "toggle").
    Toggle,
    /// 2: the output is on exactly while the input is active (our reading; the manual says "hold").
    Hold,
}

impl External {
    /// The mode with this number; `None` above 2.
    #[must_use]
    pub const fn from_value(value: u32) -> Option<Self> {
        match value {
            0 => Some(Self::Off),
            1 => Some(Self::Toggle),
            2 => Some(Self::Hold),
            _ => None,
        }
    }

    /// Its number.
    #[must_use]
    pub const fn value(self) -> u32 {
        match self {
            Self::Off => 0,
            Self::Toggle => 1,
            Self::Hold => 2,
        }
    }
}

/// The registers of one channel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Channel {
    /// Range.
    pub range: OutputRange,
    /// Set value, within the range's limits.
    pub set_value: f32,
    /// Whether the output is on.
    pub output: bool,
    /// Power-up start as written; 1 means on.
    pub start_enable: u32,
    /// Range after power-up.
    pub start_range: OutputRange,
    /// Set value after power-up, within that range's limits.
    pub start_value: f32,
    /// External control.
    pub external: External,
}

/// All registers of a card.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Settings {
    /// The channels.
    pub channels: [Channel; CHANNELS],
    /// CAN bit/s.
    pub can_bit_rate: u32,
    /// CAN ID.
    pub can_id: u32,
    /// Keep range, set value and external control over power-off.
    pub keep: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { channels: [Channel::default(); CHANNELS], can_bit_rate: 250_000, can_id: 1, keep: false }
    }
}

impl Settings {
    /// The value of a register; `None` for the one that can't be read, and for channels past the last.
    #[must_use]
    pub fn read(&self, register: Register) -> Option<u32> {
        let channel = |index: usize| self.channels.get(index);
        Some(match register {
            Register::Range(index) => channel(index)?.range.value(),
            Register::SetValue(index) => channel(index)?.set_value.to_bits(),
            Register::Output(index) => u32::from(channel(index)?.output),
            Register::StartEnable(index) => channel(index)?.start_enable,
            Register::StartRange(index) => channel(index)?.start_range.value(),
            Register::StartValue(index) => channel(index)?.start_value.to_bits(),
            Register::External(index) => channel(index)?.external.value(),
            Register::CanBitRate => self.can_bit_rate,
            Register::CanId => self.can_id,
            Register::Keep => u32::from(self.keep),
            Register::FactoryReset => return None,
        })
    }

    /// Every setting for which the manual names a default returns to it; output and power-up start have none.
    pub fn factory_reset(&mut self) {
        let channels = self.channels.map(|channel| Channel {
            output: channel.output,
            start_enable: channel.start_enable,
            ..Channel::default()
        });
        *self = Self { channels, ..Self::default() };
    }

    /// What these settings are after power was off (5.1.4, 5.1.31).
    #[must_use]
    pub fn after_power_up(&self) -> Self {
        let channels = self.channels.map(|channel| {
            let (range, set_value, external) = match self.keep {
                true => (channel.range, channel.set_value, channel.external),
                false => Default::default(),
            };
            match channel.start_enable {
                1 => Channel {
                    range: channel.start_range,
                    set_value: channel.start_value,
                    output: true,
                    external,
                    ..channel
                },
                _ => Channel { range, set_value, output: false, external, ..channel },
            }
        });
        Self { channels, ..*self }
    }
}
