//! How a card's settings are kept over power-off.

use super::{CHANNELS, Channel, External, OutputRange, Settings};
use crate::checksum;
use crate::wire::{NoSpace, Reader, Writer};

/// Length of the stored form.
pub const STORED_LENGTH: usize = 1 + CHANNELS * CHANNEL_LENGTH + 9 + checksum::CRC_LENGTH;

const CHANNEL_LENGTH: usize = 16;

/// First byte of the stored form; another one is another layout.
const STORED_VERSION: u8 = 1;

impl Settings {
    /// The stored form, CRC included. All registers but the outputs' switches, which are off after power-up or follow
    /// the power-up start; see [`Settings::after_power_up`].
    #[must_use]
    pub fn encode(&self) -> [u8; STORED_LENGTH] {
        let mut stored = [0; STORED_LENGTH];
        // the array is as long as what is written
        let _ = self.write(&mut Writer::new(&mut stored));
        stored
    }

    fn write(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        writer.u8(STORED_VERSION)?;
        for channel in &self.channels {
            let code = |value: u32| u8::try_from(value).unwrap_or(u8::MAX);
            writer.u8(code(channel.range.value()))?;
            writer.slice(&channel.set_value.to_be_bytes())?;
            writer.slice(&channel.start_enable.to_be_bytes())?;
            writer.u8(code(channel.start_range.value()))?;
            writer.slice(&channel.start_value.to_be_bytes())?;
            writer.slice(&[code(channel.external.value()), 0])?;
        }
        writer.slice(&self.can_bit_rate.to_be_bytes())?;
        writer.slice(&self.can_id.to_be_bytes())?;
        writer.u8(self.keep.into())?;
        checksum::append_crc(writer)
    }

    /// The settings in a stored form; `None` where it is damaged, of another version, or a value is outside its set.
    #[must_use]
    pub fn decode(stored: &[u8; STORED_LENGTH]) -> Option<Self> {
        let mut reader = Reader::new(checksum::strip_crc(stored)?);
        if reader.u8().ok()? != STORED_VERSION {
            return None;
        }
        let mut settings = Self::default();
        for channel in &mut settings.channels {
            *channel = read_channel(&mut reader)?;
        }
        settings.can_bit_rate = u32::from_be_bytes(reader.array().ok()?);
        settings.can_id = u32::from_be_bytes(reader.array().ok()?);
        settings.keep = reader.u8().ok()? == 1;
        let fits =
            (5000..=1_000_000).contains(&settings.can_bit_rate) && (1..=127).contains(&settings.can_id);
        fits.then_some(settings)
    }
}

fn read_channel(reader: &mut Reader<'_>) -> Option<Channel> {
    let range = OutputRange::from_value(reader.u8().ok()?.into())?;
    let set_value = f32::from_be_bytes(reader.array().ok()?);
    let start_enable = u32::from_be_bytes(reader.array().ok()?);
    let start_range = OutputRange::from_value(reader.u8().ok()?.into())?;
    let start_value = f32::from_be_bytes(reader.array().ok()?);
    let [external, _] = reader.array().ok()?;
    let external = External::from_value(external.into())?;
    let fits = range.contains(set_value) && start_range.contains(start_value);
    fits.then_some(Channel {
        range,
        set_value,
        output: false,
        start_enable,
        start_range,
        start_value,
        external,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_come_back_with_outputs_off() {
        let mut settings = Settings { can_bit_rate: 500_000, can_id: 9, keep: true, ..Settings::default() };
        settings.channels[2] = Channel {
            range: OutputRange::Milliamperes200,
            set_value: -150.0,
            output: true,
            start_enable: 7,
            start_range: OutputRange::Millivolts200,
            start_value: 0.1,
            external: External::Hold,
        };
        let stored = settings.encode();
        let mut expected = settings;
        expected.channels[2].output = false;
        assert_eq!(Settings::decode(&stored), Some(expected));
        assert_eq!(expected.after_power_up(), settings.after_power_up());
        for bit in 0..STORED_LENGTH * 8 {
            let mut damaged = stored;
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Settings::decode(&damaged), None, "bit {bit}");
        }
        assert_eq!(Settings::decode(&[0xFF; STORED_LENGTH]), None, "erased flash");
        assert_eq!(Settings::decode(&[0; STORED_LENGTH]), None);
    }

    #[test]
    fn a_value_outside_its_range_is_not_restored() {
        let mut settings = Settings::default();
        settings.channels[0].set_value = 6.0;
        assert_eq!(Settings::decode(&settings.encode()), None);
        settings.channels[0].set_value = f32::NAN;
        assert_eq!(Settings::decode(&settings.encode()), None);
        let slow = Settings { can_bit_rate: 4999, ..Settings::default() };
        assert_eq!(Settings::decode(&slow.encode()), None);
    }
}
