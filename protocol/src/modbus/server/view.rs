use core::slice;

use crate::modbus::{bit, packed_len};

/// The values of a write: registers in the request's data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Registers<'a>(&'a [[u8; 2]]);

impl<'a> Registers<'a> {
    /// The registers in `data`, each most significant byte first; an odd byte at the end is left out.
    #[must_use]
    pub const fn new(data: &'a [u8]) -> Self {
        Self(data.as_chunks().0)
    }

    /// How many there are.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are none: never so in a request that was checked.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The value at `index`, counted from the first address of the request.
    #[must_use]
    pub fn get(&self, index: usize) -> Option<u16> {
        self.0.get(index).map(|pair| u16::from_be_bytes(*pair))
    }

    /// The values in order.
    pub fn iter(&self) -> impl Iterator<Item = u16> + use<'a> {
        self.0.iter().map(|pair| u16::from_be_bytes(*pair))
    }

    /// Copies the values to the front of `table`, as many as it has room for.
    pub fn copy_to(&self, table: &mut [u16]) {
        table.iter_mut().zip(self.iter()).for_each(|(place, value)| *place = value);
    }
}

/// Takes the registers of a read, in order, and writes them into the response.
#[derive(Debug)]
pub struct RegisterWriter<'a> {
    pairs: slice::IterMut<'a, [u8; 2]>,
}

impl<'a> RegisterWriter<'a> {
    /// Registers for all of `data`, most significant byte first; an odd byte at the end stays.
    #[must_use]
    pub fn new(data: &'a mut [u8]) -> Self {
        Self { pairs: data.as_chunks_mut().0.iter_mut() }
    }

    /// How many are still wanted.
    #[must_use]
    pub fn remaining(&self) -> usize {
        self.pairs.len()
    }

    /// The next value; past the last nothing happens.
    pub fn push(&mut self, value: u16) {
        if let Some(pair) = self.pairs.next() {
            *pair = value.to_be_bytes();
        }
    }
}

/// The next values, until either end.
impl Extend<u16> for RegisterWriter<'_> {
    fn extend<T: IntoIterator<Item = u16>>(&mut self, values: T) {
        // slices, because zipped with another one they make the shorter loop
        let pairs = core::mem::take(&mut self.pairs).into_slice();
        let mut written = 0usize;
        for (pair, value) in pairs.iter_mut().zip(values) {
            *pair = value.to_be_bytes();
            written = written.wrapping_add(1);
        }
        self.pairs = pairs.get_mut(written..).unwrap_or_default().iter_mut();
    }
}

/// The values of a write: packed bits in the request's data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bits<'a> {
    bytes: &'a [u8],
    quantity: u16,
}

impl<'a> Bits<'a> {
    /// The first `quantity` bits of `bytes`, the least significant bit of the first byte first; bits past its end
    /// are 0.
    #[must_use]
    pub const fn new(bytes: &'a [u8], quantity: u16) -> Self {
        Self { bytes, quantity }
    }

    /// How many there are.
    #[must_use]
    pub const fn len(&self) -> u16 {
        self.quantity
    }

    /// Whether there are none: never so in a request that was checked.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.quantity == 0
    }

    /// The bit at `index`, counted from the first address of the request; `None` past the last.
    #[must_use]
    pub fn get(&self, index: u16) -> Option<bool> {
        (index < self.quantity).then(|| bit(self.bytes, index))
    }

    /// The bits in order.
    pub fn iter(&self) -> impl Iterator<Item = bool> + use<'a> {
        let bytes = self.bytes;
        (0..self.quantity).map(move |index| bit(bytes, index))
    }

    /// Copies the bits into a packed table, the first one to bit `first`; bits past its end are left out.
    pub fn copy_to(&self, table: &mut [u8], first: u16) {
        for (place, value) in (usize::from(first)..).zip(self.iter()) {
            let Some(byte) = table.get_mut(place >> 3) else { break };
            let mask = 1u8 << (place & 7);
            *byte = if value { *byte | mask } else { *byte & !mask };
        }
    }
}

/// Takes the coils or inputs of a read, in order, and packs them into the response.
#[derive(Debug)]
pub struct BitWriter<'a> {
    bytes: &'a mut [u8],
    quantity: u16,
    written: u16,
}

impl<'a> BitWriter<'a> {
    /// `quantity` bits for the front of `bytes`.
    #[must_use]
    pub const fn new(bytes: &'a mut [u8], quantity: u16) -> Self {
        let used = packed_len(quantity);
        let used = if used < bytes.len() { used } else { bytes.len() };
        let bytes = match bytes.split_at_mut_checked(used) {
            Some((bytes, _)) => bytes,
            None => &mut [],
        };
        Self { bytes, quantity, written: 0 }
    }

    /// How many are still wanted.
    #[must_use]
    pub const fn remaining(&self) -> u16 {
        self.quantity.saturating_sub(self.written)
    }

    /// The next bit; past the last nothing happens.
    pub fn push(&mut self, value: bool) {
        if self.written < self.quantity
            && let Some(byte) = self.bytes.get_mut(usize::from(self.written >> 3))
        {
            // the bits that fill the last byte are 0 (6.1)
            let before = if self.written & 7 == 0 { 0 } else { *byte };
            *byte = before | u8::from(value).wrapping_shl(u32::from(self.written & 7));
            self.written = self.written.wrapping_add(1);
        }
    }

    /// All bits at once, from a packed table whose bit `first` becomes the first one; bits past its end are 0.
    pub fn copy_from(&mut self, table: &[u8], first: u16) {
        let (mut window, mut source) = match table.get(usize::from(first >> 3)..) {
            Some([byte, source @ ..]) => (u32::from(*byte), source),
            _ => (0, &[][..]),
        };
        let (pairs, single) = self.bytes.as_chunks_mut::<2>();
        for pair in pairs {
            let next = match source {
                [low, high, behind @ ..] => {
                    source = behind;
                    u16::from_le_bytes([*low, *high])
                }
                [low] => {
                    source = &[];
                    u16::from(*low)
                }
                [] => 0,
            };
            window |= u32::from(next) << 8;
            let [low, high, ..] = (window >> (first & 7)).to_le_bytes();
            *pair = [low, high];
            window >>= 16;
        }
        if let [last] = single {
            window |= source.first().copied().map_or(0, u32::from) << 8;
            [*last, ..] = (window >> (first & 7)).to_le_bytes();
        }
        // the byte that is not full, if there is one
        if let Some(last) = self.bytes.get_mut(usize::from(self.quantity >> 3)) {
            *last &= 1u8.wrapping_shl(u32::from(self.quantity & 7)).wrapping_sub(1);
        }
        self.written = self.quantity;
    }
}

/// The next bits, until either end.
impl Extend<bool> for BitWriter<'_> {
    fn extend<T: IntoIterator<Item = bool>>(&mut self, values: T) {
        (0..self.remaining()).zip(values).for_each(|(_, value)| self.push(value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn registers_are_seen_and_filled_most_significant_byte_first() {
        let values = Registers::new(&[1, 2, 3, 4, 5]);
        assert_eq!((values.len(), values.get(1), values.get(2)), (2, Some(0x0304), None));
        assert_eq!(values.iter().collect::<Vec<_>>(), [0x0102, 0x0304]);
        let mut table = [7; 3];
        values.copy_to(&mut table);
        assert_eq!(table, [0x0102, 0x0304, 7]);

        let mut data = [0xEE; 7];
        let mut out = RegisterWriter::new(&mut data);
        out.extend([0x1122, 0x3344]);
        assert_eq!(out.remaining(), 1);
        out.push(0x5566);
        out.push(0x7788);
        assert_eq!(out.remaining(), 0);
        assert_eq!(data, [0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0xEE]);
    }

    #[test]
    fn packed_bits_are_copied_from_any_place_like_one_by_one() {
        let table = [0b1010_0101, 0b0011_1100, 0b1111_0000];
        for first in 0..30 {
            for quantity in 1..=24 {
                let (mut packed, mut single) = ([0xEE; 3], [0xEE; 3]);
                BitWriter::new(&mut packed, quantity).copy_from(&table, first);
                BitWriter::new(&mut single, quantity).extend((first..).map(|index| bit(&table, index)));
                let used = packed_len(quantity);
                assert_eq!(packed[..used], single[..used], "{quantity} from {first}");
                assert!(packed[used..].iter().all(|byte| *byte == 0xEE), "bytes past the last bit stay");
            }
        }
    }

    #[test]
    fn bits_for_which_there_are_no_bytes_are_left_out() {
        let mut short = [0xEE];
        BitWriter::new(&mut short, 12).copy_from(&[0xF0, 0x0F], 4);
        assert_eq!(short, [0xFF], "all bits of a byte that is full");
    }

    #[test]
    fn packed_bits_are_written_to_any_place_and_nowhere_else() {
        let values = [0b1010_0101, 0b0011_1100];
        for first in 0..30 {
            for quantity in 1..=16 {
                let mut table = [0b0110_0110; 3];
                Bits::new(&values, quantity).copy_to(&mut table, first);
                for at in 0..24u16 {
                    let expected = match at.checked_sub(first) {
                        Some(index) if index < quantity => bit(&values, index),
                        _ => bit(&[0b0110_0110; 3], at),
                    };
                    assert_eq!(bit(&table, at), expected, "bit {at}: {quantity} to {first}");
                }
            }
        }
    }

    #[test]
    fn bits_end_at_their_quantity() {
        let bits = Bits::new(&[0xFF, 0xFF], 9);
        assert_eq!((bits.len(), bits.get(8), bits.get(9)), (9, Some(true), None));
        assert_eq!(bits.iter().count(), 9);
        let mut bytes = [0xEE; 2];
        let mut out = BitWriter::new(&mut bytes, 9);
        out.push(false);
        assert_eq!(out.remaining(), 8);
        out.extend([true; 20]);
        out.push(true);
        assert_eq!(out.remaining(), 0);
        assert_eq!(bytes, [0xFE, 0x01]);
    }
}
