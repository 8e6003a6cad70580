//! Values that take several registers.

/// Which register of a wide value comes first. Modbus does not say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum WordOrder {
    /// The most significant one, as the bridge's own unit has it.
    HighFirst,
    /// The least significant one, as an NXI-6201 has it.
    LowFirst,
}

/// A number that takes one or more registers.
pub trait RegisterValue: Copy {
    /// Registers that it takes, 1 to 4.
    const WORDS: u16;

    /// Makes it of its bits.
    fn from_bits(bits: u64) -> Self;

    /// Its bits.
    fn to_bits(self) -> u64;
}

macro_rules! register_value {
    ($($kind:ty, $words:literal, $bits:ident => $from:expr, $value:ident => $to:expr;)*) => {
        $(impl RegisterValue for $kind {
            const WORDS: u16 = $words;

            fn from_bits($bits: u64) -> Self {
                $from
            }

            fn to_bits(self) -> u64 {
                let $value = self;
                $to
            }
        })*
    };
}

register_value! {
    u16, 1, bits => bits as u16, value => value.into();
    i16, 1, bits => bits as i16, value => (value as u16).into();
    u32, 2, bits => bits as u32, value => value.into();
    i32, 2, bits => bits as i32, value => (value as u32).into();
    f32, 2, bits => f32::from_bits(bits as u32), value => f32::to_bits(value).into();
    u64, 4, bits => bits, value => value;
    i64, 4, bits => bits as i64, value => value as u64;
    f64, 4, bits => f64::from_bits(bits), value => f64::to_bits(value);
}

/// Values out of registers; what is left over is none.
pub(super) fn decode<T: RegisterValue>(words: &[u16], order: WordOrder) -> Vec<T> {
    let join = |words: &[u16]| {
        let bits = |bits, word: &u16| bits << 16 | u64::from(*word);
        match order {
            WordOrder::HighFirst => words.iter().fold(0, bits),
            WordOrder::LowFirst => words.iter().rev().fold(0, bits),
        }
    };
    words.chunks_exact(usize::from(T::WORDS)).map(|words| T::from_bits(join(words))).collect()
}

/// The registers of values.
pub(super) fn encode<T: RegisterValue>(values: &[T], order: WordOrder) -> Vec<u16> {
    let words = |value: &T| {
        let bits = value.to_bits();
        let mut words: Vec<u16> = (0..T::WORDS).map(|word| (bits >> (16 * word)) as u16).collect();
        if order == WordOrder::HighFirst {
            words.reverse();
        }
        words
    };
    values.iter().flat_map(words).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_in_either_order() {
        assert_eq!(encode(&[0x1234_5678_u32], WordOrder::HighFirst), [0x1234, 0x5678]);
        assert_eq!(encode(&[0x1234_5678_u32], WordOrder::LowFirst), [0x5678, 0x1234]);
        assert_eq!(encode(&[-2_i16, 5], WordOrder::LowFirst), [0xFFFE, 5]);
        assert_eq!(decode::<f32>(&[0x4020, 0], WordOrder::HighFirst), [2.5]);
        for order in [WordOrder::HighFirst, WordOrder::LowFirst] {
            assert_eq!(decode::<f64>(&encode(&[-1.5, 1e300], order), order), [-1.5, 1e300]);
            assert_eq!(decode::<i64>(&encode(&[-3, i64::MAX], order), order), [-3, i64::MAX]);
            assert_eq!(decode::<i32>(&encode(&[i32::MIN], order), order), [i32::MIN]);
            assert_eq!(decode::<u64>(&[1, 2, 3], order), []);
        }
    }
}
