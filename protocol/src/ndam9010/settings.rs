//! Settings of a station (manual, 4.5) and how they are kept. The vendor's configuration protocol is not documented, so
//! these are a validated value with a stored form, not a wire protocol.

use super::{BYTE_TIMEOUT_MS, MODULES_MAX, UNIT_MAX};
use crate::checksum;
use crate::error::error_text;
use crate::wire::{NoSpace, Reader, Writer};

/// Longest device name and password in bytes (4.5.1, 4.5.2).
pub const TEXT_MAX: usize = 15;

/// Baud rates (table 4.1).
pub const BAUDS: [u32; 7] = [1200, 2400, 4800, 9600, 19200, 38400, 57600];

/// Length of the stored form.
pub const STORED_LENGTH: usize = 46;

/// First byte of the stored form; another one is another layout.
const STORED_VERSION: u8 = 1;

/// How frames are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Mode {
    /// Modbus RTU.
    #[default]
    Rtu,
    /// Modbus ASCII.
    Ascii,
}

/// Parity (4.5.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Parity {
    /// No parity bit.
    #[default]
    None,
    /// Even number of ones.
    Even,
    /// Odd number of ones.
    Odd,
    /// Always 1.
    Mark,
    /// Always 0.
    Space,
}

impl Parity {
    const ALL: [Self; 5] = [Self::None, Self::Even, Self::Odd, Self::Mark, Self::Space];
}

/// Up to [`TEXT_MAX`] printable ASCII characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Text {
    bytes: [u8; TEXT_MAX],
    length: u8,
}

impl Text {
    /// A text.
    ///
    /// # Errors
    /// [`SettingsError::Text`] where it is longer, or not printable ASCII.
    pub fn new(text: &[u8]) -> Result<Self, SettingsError> {
        let mut bytes = [0; TEXT_MAX];
        let place = bytes.get_mut(..text.len()).ok_or(SettingsError::Text)?;
        place.copy_from_slice(text);
        let length = u8::try_from(text.len()).map_err(|_| SettingsError::Text)?;
        if text.iter().all(|byte| (b' '..=b'~').contains(byte)) {
            Ok(Self { bytes, length })
        } else {
            Err(SettingsError::Text)
        }
    }

    /// The characters.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.get(..self.length.into()).unwrap_or(&[])
    }
}

/// Why settings don't fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SettingsError {
    /// Name or password is longer than [`TEXT_MAX`] or not printable ASCII.
    Text,
    /// Not a baud rate of [`BAUDS`].
    Baud,
    /// Data bits are not 5 to 8, or too few for the mode: RTU needs 8, ASCII at least 7.
    DataBits,
    /// Stop bits are not 1 or 2.
    StopBits,
    /// A byte timeout of 0.
    ByteTimeout,
    /// Modules are not 1 to 8.
    Modules,
    /// Not the stored form of this version, or damaged.
    Stored,
    /// The start ID is not 1 to 247, or the last module's unit would pass 247.
    StartId,
}

/// Settings of a station.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Settings {
    /// How frames are written.
    pub mode: Mode,
    /// Silence that ends an RTU frame, in ms, 1 and up.
    pub byte_timeout_ms: u16,
    /// Baud rate, one of [`BAUDS`].
    pub baud: u32,
    /// Data bits, 5 to 8.
    pub data_bits: u8,
    /// Stop bits, 1 or 2.
    pub stop_bits: u8,
    /// Parity.
    pub parity: Parity,
    /// Most modules, and so units, of the station, 1 to 8.
    pub modules: u8,
    /// Device name.
    pub name: Text,
    /// Password of the vendor's configuration program.
    pub password: Text,
}

impl Default for Settings {
    /// As from the factory (4.5, 4.6).
    fn default() -> Self {
        let text = |text| Text::new(text).unwrap_or(Text { bytes: [0; TEXT_MAX], length: 0 });
        Self {
            mode: Mode::Rtu,
            byte_timeout_ms: BYTE_TIMEOUT_MS as u16,
            baud: 19200,
            data_bits: 8,
            stop_bits: 1,
            parity: Parity::None,
            modules: MODULES_MAX as u8,
            name: text(b"NDAM-9010"),
            password: text(b"88888888"),
        }
    }
}

impl Settings {
    /// Checks the settings together.
    ///
    /// # Errors
    /// The first [`SettingsError`] found.
    pub fn check(&self) -> Result<(), SettingsError> {
        let least_bits = match self.mode {
            Mode::Rtu => 8,
            Mode::Ascii => 7,
        };
        let checks = [
            (self.byte_timeout_ms >= 1, SettingsError::ByteTimeout),
            (BAUDS.contains(&self.baud), SettingsError::Baud),
            ((least_bits..=8).contains(&self.data_bits), SettingsError::DataBits),
            ((1..=2).contains(&self.stop_bits), SettingsError::StopBits),
            ((1..=MODULES_MAX).contains(&usize::from(self.modules)), SettingsError::Modules),
        ];
        checks.into_iter().find(|(fits, _)| !fits).map_or(Ok(()), |(_, error)| Err(error))
    }

    /// Writes the stored form, CRC included.
    ///
    /// # Errors
    /// [`SettingsError`] where the settings don't fit; nothing is to be stored then.
    pub fn encode(&self) -> Result<[u8; STORED_LENGTH], SettingsError> {
        self.check()?;
        let mut stored = [0; STORED_LENGTH];
        let mut writer = Writer::new(&mut stored);
        // the array is as long as what is written
        self.write(&mut writer).map_err(|NoSpace| SettingsError::Stored)?;
        Ok(stored)
    }

    fn write(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        let parity = Parity::ALL.iter().zip(0..).find(|(parity, _)| **parity == self.parity);
        writer.u8(STORED_VERSION)?;
        writer.u8(u8::from(self.mode == Mode::Ascii))?;
        writer.u16_be(self.byte_timeout_ms)?;
        writer.slice(&self.baud.to_be_bytes())?;
        writer.slice(&[self.data_bits, self.stop_bits, parity.map_or(0, |(_, code)| code), self.modules])?;
        for text in [&self.name, &self.password] {
            writer.u8(text.length)?;
            writer.slice(&text.bytes)?;
        }
        checksum::append_crc(writer)
    }

    /// Reads the stored form.
    ///
    /// # Errors
    /// [`SettingsError`] where it is damaged or its settings don't fit.
    pub fn decode(stored: &[u8; STORED_LENGTH]) -> Result<Self, SettingsError> {
        let content = checksum::strip_crc(stored).ok_or(SettingsError::Stored)?;
        let settings = Self::read(&mut Reader::new(content)).ok_or(SettingsError::Stored)?;
        settings.check()?;
        Ok(settings)
    }
}

impl Settings {
    fn read(reader: &mut Reader<'_>) -> Option<Self> {
        let [version, mode] = reader.array().ok()?;
        let byte_timeout_ms = reader.u16_be().ok()?;
        let baud = u32::from_be_bytes(reader.array().ok()?);
        let [data_bits, stop_bits, parity, modules] = reader.array().ok()?;
        let mode = match (version, mode) {
            (STORED_VERSION, 0) => Mode::Rtu,
            (STORED_VERSION, 1) => Mode::Ascii,
            _ => return None,
        };
        let parity = Parity::ALL.get(usize::from(parity)).copied()?;
        let mut text = || {
            let length = reader.u8().ok()?;
            let bytes: [u8; TEXT_MAX] = reader.array().ok()?;
            Text::new(bytes.get(..length.into())?).ok()
        };
        let (name, password) = (text()?, text()?);
        Some(Self { mode, byte_timeout_ms, baud, data_bits, stop_bits, parity, modules, name, password })
    }
}

/// The settings could not be stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StoreError;

/// Where a station keeps its settings over power-off.
pub trait Storage {
    /// What was stored last; `None` for nothing.
    fn load(&mut self) -> Option<[u8; STORED_LENGTH]>;

    /// Stores, so that a power cut leaves the former or the new settings.
    ///
    /// # Errors
    /// [`StoreError`], and the former ones stay.
    fn store(&mut self, settings: &[u8; STORED_LENGTH]) -> Result<(), StoreError>;
}

/// [`Storage`] in memory, for tests and simulators.
#[derive(Debug, Clone, Default)]
pub struct RamStorage(
    /// What was stored last.
    pub Option<[u8; STORED_LENGTH]>,
);

impl Storage for RamStorage {
    fn load(&mut self) -> Option<[u8; STORED_LENGTH]> {
        self.0
    }

    fn store(&mut self, settings: &[u8; STORED_LENGTH]) -> Result<(), StoreError> {
        self.0 = Some(*settings);
        Ok(())
    }
}

/// The DIP switch, all on: the station returns to its factory settings when it is powered up so (4.6).
pub const DIP_FACTORY_RESET: u8 = 0xFF;

/// How a station started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Start {
    /// With the settings that were stored, or the factory's where none were or they were damaged.
    Run {
        /// Settings in use.
        settings: Settings,
        /// Unit of the first module.
        start_id: u8,
    },
    /// The factory's settings were stored; the station waits for the switch to be set and power to come again.
    FactoryReset,
}

/// Powers a station up: what the DIP switch says, its lowest bit switch 1, and what is stored.
///
/// # Errors
/// [`SettingsError::StartId`] where the switch says 0 or the last unit would pass 247, [`SettingsError::Stored`] where
/// the factory's settings could not be stored.
pub fn power_up(dip: u8, storage: &mut impl Storage) -> Result<Start, SettingsError> {
    if dip == DIP_FACTORY_RESET {
        let factory = Settings::default().encode()?;
        storage.store(&factory).map_err(|StoreError| SettingsError::Stored)?;
        return Ok(Start::FactoryReset);
    }
    let settings = storage.load().and_then(|stored| Settings::decode(&stored).ok()).unwrap_or_default();
    let last = dip.checked_add(settings.modules.saturating_sub(1));
    match last {
        Some(last) if dip > 0 && last <= UNIT_MAX => Ok(Start::Run { settings, start_id: dip }),
        _ => Err(SettingsError::StartId),
    }
}

error_text! {
    SettingsError {
        SettingsError::Text => ("name or password is too long or not printable"),
        SettingsError::Baud => ("no baud rate of the station"),
        SettingsError::DataBits => ("the data bits are not 5 to 8, or too few for the mode"),
        SettingsError::StopBits => ("the stop bits are not 1 or 2"),
        SettingsError::ByteTimeout => ("a byte timeout of 0"),
        SettingsError::Modules => ("the modules are not 1 to 8"),
        SettingsError::Stored => ("no stored form of this version, or damaged"),
        SettingsError::StartId => ("the units are not within 1 to 247"),
    }
}

error_text! {
    StoreError {
        StoreError => ("the settings could not be stored"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factory_settings_fit_and_come_back() {
        let settings = Settings::default();
        assert_eq!(
            (settings.name.as_bytes(), settings.password.as_bytes()),
            (&b"NDAM-9010"[..], &b"88888888"[..])
        );
        let stored = settings.encode().unwrap();
        assert_eq!(Settings::decode(&stored), Ok(settings));
        for bit in 0..STORED_LENGTH * 8 {
            let mut damaged = stored;
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Settings::decode(&damaged), Err(SettingsError::Stored), "bit {bit}");
        }
        assert_eq!(Settings::decode(&[0; STORED_LENGTH]), Err(SettingsError::Stored));
        assert_eq!(Settings::decode(&[0xFF; STORED_LENGTH]), Err(SettingsError::Stored), "erased flash");
    }

    #[test]
    fn every_setting_is_kept() {
        let settings = Settings {
            mode: Mode::Ascii,
            byte_timeout_ms: 1000,
            baud: 57600,
            data_bits: 7,
            stop_bits: 2,
            parity: Parity::Space,
            modules: 3,
            name: Text::new(b"fifteen letters").unwrap(),
            password: Text::new(b"").unwrap(),
        };
        assert_eq!(Settings::decode(&settings.encode().unwrap()), Ok(settings));
    }

    #[test]
    fn settings_outside_their_range() {
        let good = Settings::default();
        for (settings, error) in [
            (Settings { byte_timeout_ms: 0, ..good }, SettingsError::ByteTimeout),
            (Settings { baud: 115_200, ..good }, SettingsError::Baud),
            (Settings { data_bits: 7, ..good }, SettingsError::DataBits),
            (Settings { data_bits: 9, ..good }, SettingsError::DataBits),
            (Settings { mode: Mode::Ascii, data_bits: 6, ..good }, SettingsError::DataBits),
            (Settings { stop_bits: 0, ..good }, SettingsError::StopBits),
            (Settings { stop_bits: 3, ..good }, SettingsError::StopBits),
            (Settings { modules: 0, ..good }, SettingsError::Modules),
            (Settings { modules: 9, ..good }, SettingsError::Modules),
        ] {
            assert_eq!(settings.check(), Err(error));
            assert_eq!(settings.encode(), Err(error));
        }
        assert_eq!(Text::new(b"sixteen letters!"), Err(SettingsError::Text));
        assert_eq!(Text::new(b"new\nline"), Err(SettingsError::Text));
    }

    #[test]
    fn the_switch_gives_the_start_id_or_the_factory_settings() {
        let mut storage = RamStorage::default();
        for dip in 0..=u8::MAX {
            let start = power_up(dip, &mut storage);
            match dip {
                1..=240 => {
                    assert_eq!(start, Ok(Start::Run { settings: Settings::default(), start_id: dip }));
                }
                DIP_FACTORY_RESET => assert_eq!(start, Ok(Start::FactoryReset)),
                _ => assert_eq!(start, Err(SettingsError::StartId), "{dip}"),
            }
        }
        let small = Settings { modules: 1, ..Settings::default() };
        storage.store(&small.encode().unwrap()).unwrap();
        assert_eq!(power_up(247, &mut storage), Ok(Start::Run { settings: small, start_id: 247 }));
        assert_eq!(power_up(214, &mut storage), Ok(Start::Run { settings: small, start_id: 0b1101_0110 }));
        power_up(DIP_FACTORY_RESET, &mut storage).unwrap();
        assert_eq!(power_up(247, &mut storage), Err(SettingsError::StartId), "eight modules again");
        storage.0 = Some([0; STORED_LENGTH]);
        let factory = Settings::default();
        assert_eq!(power_up(1, &mut storage), Ok(Start::Run { settings: factory, start_id: 1 }), "damaged");
    }
}
