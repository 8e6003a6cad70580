//! The registers that a device keeps over power-off, by their names.

use super::register::{self, Access, Register, SETTINGS_LENGTH, Values};
use super::{ADDRESS_MIN, AXES, Refusal, Sample, SettingsError, SignEncoding};

/// Which of its two interfaces the shared pins of an NST2000 are (4.1.10).
///
/// [`Daq`](super::Daq) answers in every form whatever the register says: the pins are the board's to connect, and
/// models without shared pins have nothing to choose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Channel {
    /// 0: CAN.
    #[default]
    Can,
    /// 1: RS485.
    Rs485,
}

/// What a device is on Ethernet (4.1.11).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum EthernetMode {
    /// 0: UDP.
    #[default]
    Udp,
    /// 1: TCP server.
    TcpServer,
}

/// The registers 0x0000 to 0x01FF: every value is in its set, so that no device is mute for want of an address.
///
/// What is written takes effect after a restart; [`ActiveSettings`] are in use until then.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Settings {
    bytes: [u8; SETTINGS_LENGTH],
}

impl Settings {
    /// The settings of a device that has stored none: address 1, CAN at 1000 kbit/s, both UARTs at 115200 baud, channel
    /// CAN, UDP, the rest 0. The manual names the baud rates alone.
    pub const FACTORY: Self = {
        let mut bytes = [0; SETTINGS_LENGTH];
        put(&mut bytes, register::ADDRESS, [ADDRESS_MIN]);
        put(&mut bytes, register::UART1_BAUD, register::DEFAULT_BAUD.to_le_bytes());
        put(&mut bytes, register::CAN_RATE, 1000u32.to_le_bytes());
        put(&mut bytes, register::UART2_BAUD, register::DEFAULT_BAUD.to_le_bytes());
        Self { bytes }
    };

    /// Take the bytes of a store. An unknown baud rate becomes [`DEFAULT_BAUD`](register::DEFAULT_BAUD), as it does where
    /// it is written (4.1.4, 4.1.6).
    ///
    /// # Errors
    /// [`SettingsError`] where the store is blank or a value is not in its set: a firmware goes on with
    /// [`Settings::FACTORY`].
    pub fn decode(stored: &[u8; SETTINGS_LENGTH]) -> Result<Self, SettingsError> {
        if [0x00, 0xFF].iter().any(|blank| stored.iter().all(|byte| byte == blank)) {
            return Err(SettingsError::Blank);
        }
        let mut settings = Self { bytes: *stored };
        settings.check(0, register::DATA.first).map_err(SettingsError::Value)?;
        Ok(settings)
    }

    /// Return the bytes to be stored.
    #[must_use]
    pub const fn as_bytes(&self) -> &[u8; SETTINGS_LENGTH] {
        &self.bytes
    }

    /// Return the bytes of a register; none of [`DATA`](register::DATA), which is measured.
    #[must_use]
    pub fn bytes(&self, register: Register) -> &[u8] {
        self.bytes.get(usize::from(register.first)..=usize::from(register.last())).unwrap_or(&[])
    }

    /// Write bytes from the register `first` on, as function code 0x10 does: all or none.
    ///
    /// # Errors
    /// [`Refusal::Length`] for no bytes, [`Refusal::Register`] for bytes past the last register, [`Refusal::ReadOnly`],
    /// [`Refusal::Value`] for a value outside its set.
    pub fn write(&mut self, first: u16, data: &[u8]) -> Result<(), Refusal> {
        let mut settings = *self;
        settings.write_or_spoil(first, data)?;
        *self = settings;
        Ok(())
    }

    /// [`Settings::write`] on a copy, which is of no use after an error.
    pub(super) fn write_or_spoil(&mut self, first: u16, data: &[u8]) -> Result<(), Refusal> {
        let length = u16::try_from(data.len()).map_err(|_| Refusal::Length)?;
        let last =
            length.checked_sub(1).ok_or(Refusal::Length)?.checked_add(first).ok_or(Refusal::Register)?;
        if last > register::DATA.last() {
            return Err(Refusal::Register);
        }
        let mut touched = register::TABLE.iter().filter(|register| register.meets(first, last));
        if touched.any(|register| register.access == Access::Read) {
            return Err(Refusal::ReadOnly);
        }
        let place = self.bytes.iter_mut().skip(usize::from(first));
        place.zip(data).for_each(|(byte, new)| *byte = *new);
        self.check(first, last).map_err(|_| Refusal::Value)
    }

    /// Check the registers in `first..=last`; tell the first that does not fit.
    fn check(&mut self, first: u16, last: u16) -> Result<(), Register> {
        for register in register::TABLE.iter().filter(|register| register.meets(first, last)) {
            let fits = match register.values {
                Values::Any => true,
                Values::Between(least, most) => {
                    self.bytes(*register).iter().all(|byte| (least..=most).contains(byte))
                }
                Values::OneOf(known) => known.contains(&self.u32(*register)),
                Values::OneOfOrDefault(known) => {
                    if !known.contains(&self.u32(*register)) {
                        put(&mut self.bytes, *register, register::DEFAULT_BAUD.to_le_bytes());
                    }
                    true
                }
            };
            if !fits {
                return Err(*register);
            }
        }
        Ok(())
    }

    /// Return the [`SERIAL_NUMBER`](register::SERIAL_NUMBER).
    #[must_use]
    pub const fn serial_number(&self) -> [u8; 16] {
        get(&self.bytes, register::SERIAL_NUMBER)
    }

    /// Set the [`SERIAL_NUMBER`](register::SERIAL_NUMBER), which no request can.
    pub const fn set_serial_number(&mut self, text: [u8; 16]) {
        put(&mut self.bytes, register::SERIAL_NUMBER, text);
    }

    /// Return the [`MODEL`](register::MODEL).
    #[must_use]
    pub const fn model(&self) -> [u8; 16] {
        get(&self.bytes, register::MODEL)
    }

    /// Set the [`MODEL`](register::MODEL), which no request can.
    pub const fn set_model(&mut self, text: [u8; 16]) {
        put(&mut self.bytes, register::MODEL, text);
    }

    /// Return the [`ADDRESS`](register::ADDRESS), 1 to 127; on CAN it is the node.
    #[must_use]
    pub const fn address(&self) -> u8 {
        let [address] = get(&self.bytes, register::ADDRESS);
        address
    }

    /// Set the [`ADDRESS`](register::ADDRESS).
    ///
    /// # Errors
    /// [`Refusal::Value`] where it is not 1 to 127.
    pub fn set_address(&mut self, address: u8) -> Result<(), Refusal> {
        self.write(register::ADDRESS.first, &[address])
    }

    /// Return [`UART1_BAUD`](register::UART1_BAUD) in baud.
    #[must_use]
    pub const fn uart1_baud(&self) -> u32 {
        self.u32(register::UART1_BAUD)
    }

    /// Set [`UART1_BAUD`](register::UART1_BAUD).
    ///
    /// # Errors
    /// [`Refusal::Value`] where it is not one of [`UART1_BAUDS`](register::UART1_BAUDS).
    pub fn set_uart1_baud(&mut self, baud: u32) -> Result<(), Refusal> {
        self.set_one_of(register::UART1_BAUD, &register::UART1_BAUDS, baud)
    }

    /// Return [`CAN_RATE`](register::CAN_RATE) in kbit/s.
    #[must_use]
    pub const fn can_rate(&self) -> u32 {
        self.u32(register::CAN_RATE)
    }

    /// Set [`CAN_RATE`](register::CAN_RATE).
    ///
    /// # Errors
    /// [`Refusal::Value`] where it is not one of [`CAN_RATES`](register::CAN_RATES).
    pub fn set_can_rate(&mut self, rate: u32) -> Result<(), Refusal> {
        self.set_one_of(register::CAN_RATE, &register::CAN_RATES, rate)
    }

    /// Return [`UART2_BAUD`](register::UART2_BAUD) in baud.
    #[must_use]
    pub const fn uart2_baud(&self) -> u32 {
        self.u32(register::UART2_BAUD)
    }

    /// Set [`UART2_BAUD`](register::UART2_BAUD).
    ///
    /// # Errors
    /// [`Refusal::Value`] where it is not one of [`UART2_BAUDS`](register::UART2_BAUDS).
    pub fn set_uart2_baud(&mut self, baud: u32) -> Result<(), Refusal> {
        self.set_one_of(register::UART2_BAUD, &register::UART2_BAUDS, baud)
    }

    /// Return the [`IP_ADDRESS`](register::IP_ADDRESS).
    #[must_use]
    pub const fn ip_address(&self) -> [u8; 4] {
        get(&self.bytes, register::IP_ADDRESS)
    }

    /// Set the [`IP_ADDRESS`](register::IP_ADDRESS).
    pub const fn set_ip_address(&mut self, address: [u8; 4]) {
        put(&mut self.bytes, register::IP_ADDRESS, address);
    }

    /// Return the [`IP_PORT`](register::IP_PORT).
    #[must_use]
    pub const fn ip_port(&self) -> u16 {
        u16::from_le_bytes(get(&self.bytes, register::IP_PORT))
    }

    /// Set the [`IP_PORT`](register::IP_PORT).
    pub const fn set_ip_port(&mut self, port: u16) {
        put(&mut self.bytes, register::IP_PORT, port.to_le_bytes());
    }

    /// Return the [`ZERO_POINTS`](register::ZERO_POINTS), in the units of a sample.
    #[must_use]
    pub fn zero_points(&self, sign: SignEncoding) -> Sample {
        let raw: [u8; AXES * 4] = get(&self.bytes, register::ZERO_POINTS);
        let mut zero = Sample::default();
        for (axis, raw) in zero.0.iter_mut().zip(raw.as_chunks::<4>().0) {
            *axis = sign.decode_i32(*raw);
        }
        zero
    }

    /// Set the [`ZERO_POINTS`](register::ZERO_POINTS).
    pub fn set_zero_points(&mut self, zero: Sample, sign: SignEncoding) {
        let mut raw = [0; AXES * 4];
        for (place, axis) in raw.as_chunks_mut::<4>().0.iter_mut().zip(zero.0) {
            *place = sign.encode_i32(axis);
        }
        put(&mut self.bytes, register::ZERO_POINTS, raw);
    }

    /// Return the [`CHANNEL`](register::CHANNEL).
    #[must_use]
    pub const fn channel(&self) -> Channel {
        match get(&self.bytes, register::CHANNEL) {
            [0] => Channel::Can,
            _ => Channel::Rs485,
        }
    }

    /// Set the [`CHANNEL`](register::CHANNEL).
    pub const fn set_channel(&mut self, channel: Channel) {
        put(&mut self.bytes, register::CHANNEL, [channel as u8]);
    }

    /// Return the [`ETHERNET_MODE`](register::ETHERNET_MODE).
    #[must_use]
    pub const fn ethernet_mode(&self) -> EthernetMode {
        match get(&self.bytes, register::ETHERNET_MODE) {
            [0] => EthernetMode::Udp,
            _ => EthernetMode::TcpServer,
        }
    }

    /// Set the [`ETHERNET_MODE`](register::ETHERNET_MODE).
    pub const fn set_ethernet_mode(&mut self, mode: EthernetMode) {
        put(&mut self.bytes, register::ETHERNET_MODE, [mode as u8]);
    }

    const fn u32(&self, register: Register) -> u32 {
        u32::from_le_bytes(get(&self.bytes, register))
    }

    fn set_one_of(&mut self, register: Register, known: &[u32], value: u32) -> Result<(), Refusal> {
        if !known.contains(&value) {
            return Err(Refusal::Value);
        }
        put(&mut self.bytes, register, value.to_le_bytes());
        Ok(())
    }
}

/// The settings in use since the device last started (4.1.3 to 4.1.11), whatever has been written since.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ActiveSettings {
    /// Address 1 to 127; on CAN the node.
    pub address: u8,
    /// Baud rate of UART1, RS232 or RS485.
    pub uart1_baud: u32,
    /// Bit rate of CAN in kbit/s.
    pub can_rate: u32,
    /// Baud rate of UART2, USB.
    pub uart2_baud: u32,
    /// IPv4 address in reading order.
    pub ip_address: [u8; 4],
    /// Port.
    pub ip_port: u16,
    /// Zero points, which are taken off every sample.
    pub zero_points: Sample,
    /// What the shared pins are.
    pub channel: Channel,
    /// What the device is on Ethernet.
    pub ethernet_mode: EthernetMode,
}

impl ActiveSettings {
    /// Return what a device uses that starts with these settings.
    #[must_use]
    pub fn new(settings: &Settings, sign: SignEncoding) -> Self {
        Self {
            address: settings.address(),
            uart1_baud: settings.uart1_baud(),
            can_rate: settings.can_rate(),
            uart2_baud: settings.uart2_baud(),
            ip_address: settings.ip_address(),
            ip_port: settings.ip_port(),
            zero_points: settings.zero_points(sign),
            channel: settings.channel(),
            ethernet_mode: settings.ethernet_mode(),
        }
    }
}

/// The bytes of a register that has so many.
const fn get<const N: usize>(bytes: &[u8; SETTINGS_LENGTH], register: Register) -> [u8; N] {
    match bytes.split_at_checked(register.first as usize) {
        Some((_, rest)) => match rest.first_chunk() {
            Some(value) => *value,
            None => [0; N],
        },
        None => [0; N],
    }
}

/// Puts a value of the register's length into it.
const fn put<const N: usize>(bytes: &mut [u8; SETTINGS_LENGTH], register: Register, value: [u8; N]) {
    if let Some((_, rest)) = bytes.split_at_mut_checked(register.first as usize)
        && let Some(place) = rest.first_chunk_mut()
    {
        *place = value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIGN: SignEncoding = SignEncoding::TwosComplement;

    #[test]
    fn a_blank_store_is_refused() {
        for blank in [0x00, 0xFF] {
            assert_eq!(Settings::decode(&[blank; SETTINGS_LENGTH]), Err(SettingsError::Blank));
        }
        assert_eq!(Settings::decode(Settings::FACTORY.as_bytes()), Ok(Settings::FACTORY));
    }

    #[test]
    fn a_store_with_a_value_outside_its_set_is_refused() {
        let with = |register: Register, value: &[u8]| {
            let mut stored = *Settings::FACTORY.as_bytes();
            stored[usize::from(register.first)..][..value.len()].copy_from_slice(value);
            Settings::decode(&stored)
        };
        for address in 0..=u8::MAX {
            let expected = match address {
                0x01..=0x7F => Ok(address),
                _ => Err(SettingsError::Value(register::ADDRESS)),
            };
            assert_eq!(with(register::ADDRESS, &[address]).map(|settings| settings.address()), expected);
        }
        assert_eq!(with(register::CAN_RATE, &[0; 4]), Err(SettingsError::Value(register::CAN_RATE)));
        assert_eq!(with(register::CHANNEL, &[2]), Err(SettingsError::Value(register::CHANNEL)));
        assert_eq!(with(register::ETHERNET_MODE, &[2]), Err(SettingsError::Value(register::ETHERNET_MODE)));
        assert_eq!(with(register::UART1_BAUD, &[0xFF; 4]), Ok(Settings::FACTORY), "as where it is written");
    }

    #[test]
    fn every_register_is_set_where_it_is() {
        let mut settings = Settings::FACTORY;
        settings.set_serial_number(*b"NST2000-00000001");
        settings.set_model(*b"NST2000-M1234567");
        settings.set_address(0x7F).unwrap();
        settings.set_uart1_baud(19200).unwrap();
        settings.set_can_rate(500).unwrap();
        settings.set_uart2_baud(460_800).unwrap();
        settings.set_ip_address([192, 168, 0, 7]);
        settings.set_ip_port(0x1234);
        settings.set_zero_points(Sample([1, -2, 3, -4, 5, -6]), SIGN);
        settings.set_channel(Channel::Rs485);
        settings.set_ethernet_mode(EthernetMode::TcpServer);

        assert_eq!(settings.serial_number(), *b"NST2000-00000001");
        assert_eq!(settings.model(), *b"NST2000-M1234567");
        let expected = ActiveSettings {
            address: 0x7F,
            uart1_baud: 19200,
            can_rate: 500,
            uart2_baud: 460_800,
            ip_address: [192, 168, 0, 7],
            ip_port: 0x1234,
            zero_points: Sample([1, -2, 3, -4, 5, -6]),
            channel: Channel::Rs485,
            ethernet_mode: EthernetMode::TcpServer,
        };
        assert_eq!(ActiveSettings::new(&settings, SIGN), expected);
        for (register, bytes) in [
            (register::SERIAL_NUMBER, &b"NST2000-00000001"[..]),
            (register::MODEL, b"NST2000-M1234567"),
            (register::ADDRESS, &[0x7F]),
            (register::UART1_BAUD, &[0, 0x4B, 0, 0]),
            (register::CAN_RATE, &[0xF4, 1, 0, 0]),
            (register::UART2_BAUD, &[0, 8, 7, 0]),
            (register::IP_ADDRESS, &[192, 168, 0, 7]),
            (register::IP_PORT, &[0x34, 0x12]),
            (register::CHANNEL, &[1]),
            (register::ETHERNET_MODE, &[1]),
        ] {
            assert_eq!(settings.bytes(register), bytes, "{register:?}");
        }
        assert_eq!(settings.bytes(register::ZERO_POINTS)[4..8], [0xFE, 0xFF, 0xFF, 0xFF]);
        assert_eq!(settings.bytes(register::DATA), []);
        assert_eq!(Settings::decode(settings.as_bytes()), Ok(settings));
    }

    #[test]
    fn a_refused_value_changes_nothing() {
        let mut settings = Settings::FACTORY;
        assert_eq!(settings.set_address(0), Err(Refusal::Value));
        assert_eq!(settings.set_address(0x80), Err(Refusal::Value));
        assert_eq!(settings.set_uart1_baud(230_400), Err(Refusal::Value));
        assert_eq!(settings.set_can_rate(999), Err(Refusal::Value));
        assert_eq!(settings.set_uart2_baud(1), Err(Refusal::Value));
        assert_eq!(settings.write(register::MODEL.first, &[1]), Err(Refusal::ReadOnly));
        assert_eq!(settings.write(register::CHANNEL.first - 1, &[7, 2]), Err(Refusal::Value));
        assert_eq!(settings, Settings::FACTORY);
    }
}
