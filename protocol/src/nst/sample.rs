/// Axes of a sensor: Fx Fy Fz Tx Ty Tz.
pub const AXES: usize = 6;

/// Bytes of a sample in the data registers: three an axis (4.1.12).
pub const SAMPLE_LENGTH: usize = AXES * 3;

/// How a negative number is written. The manual says "signed integer" and then names a sign bit and value bits
/// (4.1.9, 4.1.12); it holds for data and zero points alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SignEncoding {
    /// Two's complement.
    #[default]
    TwosComplement,
    /// The top bit is the sign, the others the absolute value.
    SignMagnitude,
}

const I24_MAX: i32 = 0x7F_FFFF;
const I24_SIGN: i32 = 0x80_0000;

impl SignEncoding {
    /// A data value, most significant byte first (4.1.12).
    #[must_use]
    pub const fn decode_i24(self, bytes: [u8; 3]) -> i32 {
        let [high, middle, low] = bytes;
        let raw = i32::from_be_bytes([0, high, middle, low]);
        let magnitude = raw & I24_MAX;
        match self {
            _ if raw & I24_SIGN == 0 => magnitude,
            Self::TwosComplement => raw | !(I24_MAX | I24_SIGN),
            Self::SignMagnitude => magnitude.wrapping_neg(),
        }
    }

    /// A value as data, most significant byte first; what passes 24 bits becomes the nearest value that fits.
    #[must_use]
    pub fn encode_i24(self, value: i32) -> [u8; 3] {
        let raw = match self {
            Self::TwosComplement => value.clamp(!I24_MAX, I24_MAX),
            Self::SignMagnitude if value < 0 => value.saturating_neg().min(I24_MAX) | I24_SIGN,
            Self::SignMagnitude => value.min(I24_MAX),
        };
        let [_, high, middle, low] = raw.to_be_bytes();
        [high, middle, low]
    }

    /// A zero point, least significant byte first (4.1.9).
    #[must_use]
    pub const fn decode_i32(self, bytes: [u8; 4]) -> i32 {
        let raw = i32::from_le_bytes(bytes);
        match self {
            Self::SignMagnitude if raw < 0 => (raw & i32::MAX).wrapping_neg(),
            _ => raw,
        }
    }

    /// A value as a zero point, least significant byte first.
    #[must_use]
    pub const fn encode_i32(self, value: i32) -> [u8; 4] {
        let raw = match self {
            Self::SignMagnitude if value < 0 => value.saturating_neg() | i32::MIN,
            _ => value,
        };
        raw.to_le_bytes()
    }
}

/// One measurement in the units of the device's output mode: mN and mN.m (force), or uV (voltage). No documented
/// register tells which, so the caller knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sample(
    /// Fx Fy Fz Tx Ty Tz.
    pub [i32; AXES],
);

impl Sample {
    /// Decodes the 18 data bytes of 0x0200 (4.1.12).
    #[must_use]
    pub fn decode(bytes: &[u8; SAMPLE_LENGTH], sign: SignEncoding) -> Self {
        let mut axes = [0; AXES];
        for (axis, raw) in axes.iter_mut().zip(bytes.as_chunks::<3>().0) {
            *axis = sign.decode_i24(*raw);
        }
        Self(axes)
    }

    /// Encodes the 18 data bytes of 0x0200.
    #[must_use]
    pub fn encode(&self, sign: SignEncoding) -> [u8; SAMPLE_LENGTH] {
        let mut bytes = [0; SAMPLE_LENGTH];
        self.encode_into(sign, &mut bytes);
        bytes
    }

    /// [`Sample::encode`] to where it is sent from.
    pub(crate) fn encode_into(&self, sign: SignEncoding, bytes: &mut [u8; SAMPLE_LENGTH]) {
        for (raw, axis) in bytes.as_chunks_mut::<3>().0.iter_mut().zip(self.0) {
            *raw = sign.encode_i24(axis);
        }
    }

    /// Fx Fy Fz in N and Tx Ty Tz in N.m, from mN and mN.m.
    #[must_use]
    pub fn newtons(&self) -> [f32; AXES] {
        self.0.map(|milli| milli as f32 / 1000.0)
    }

    /// The six channels in V, from uV.
    #[must_use]
    pub fn volts(&self) -> [f32; AXES] {
        self.0.map(|micro| micro as f32 / 1_000_000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_24_bit_values_come_back_in_both_encodings() {
        for value in (-0x80_0000..=0x7F_FFFFi32).step_by(crate::stride(0xFFFF)) {
            let twos = SignEncoding::TwosComplement;
            assert_eq!(twos.decode_i24(twos.encode_i24(value)), value);
            let magnitude = SignEncoding::SignMagnitude;
            let expected = value.max(-0x7F_FFFF);
            assert_eq!(magnitude.decode_i24(magnitude.encode_i24(value)), expected);
        }
    }

    #[test]
    fn known_bytes() {
        assert_eq!(SignEncoding::TwosComplement.decode_i24([0xFF, 0xFF, 0xFE]), -2);
        assert_eq!(SignEncoding::SignMagnitude.decode_i24([0x80, 0x00, 0x02]), -2);
        assert_eq!(SignEncoding::SignMagnitude.decode_i24([0x80, 0x00, 0x00]), 0);
        assert_eq!(SignEncoding::TwosComplement.encode_i24(i32::MAX), [0x7F, 0xFF, 0xFF]);
        assert_eq!(SignEncoding::TwosComplement.encode_i24(i32::MIN), [0x80, 0x00, 0x00]);
        assert_eq!(SignEncoding::SignMagnitude.encode_i24(i32::MIN), [0xFF, 0xFF, 0xFF]);
        assert_eq!(SignEncoding::SignMagnitude.encode_i32(-2), [2, 0, 0, 0x80]);
        assert_eq!(SignEncoding::SignMagnitude.decode_i32([2, 0, 0, 0x80]), -2);
        assert_eq!(SignEncoding::TwosComplement.decode_i32([0xFE, 0xFF, 0xFF, 0xFF]), -2);
    }

    #[test]
    fn units() {
        let sample = Sample([1500, -2, 0, 0, 0, 1]);
        assert_eq!(sample.newtons(), [1.5, -0.002, 0.0, 0.0, 0.0, 0.001]);
        assert_eq!(sample.volts()[0], 0.0015);
        assert_eq!(Sample::decode(&sample.encode(SignEncoding::default()), SignEncoding::default()), sample);
    }
}
