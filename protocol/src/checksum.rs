//! CRC-16/MODBUS, which NST and Modbus RTU frames share, and the LRC of Modbus ASCII.

use crate::wire::{NoSpace, Writer};
use core::hint::black_box;

/// What eight bits that leave the CRC put into it: the table of the `crc` crate.
static BYTES: [u16; 256] = {
    let crc = crc::Crc::<u16>::new(&crc::CRC_16_MODBUS);
    let [table] = *crc.table();
    table
};

/// Bytes that [`append_crc`] appends.
pub const CRC_LENGTH: usize = 2;

/// CRC-16/MODBUS of `bytes`: polynomial 0x8005 reflected, start 0xFFFF. A table of 512 bytes, one look a byte.
#[must_use]
pub fn crc16(bytes: &[u8]) -> u16 {
    by_table(bytes, || {})
}

/// [`crc16`] in a loop that the compiler does not unroll: for the general server, in which it stands twice, 412 bytes less
/// on a Cortex-M4, and eight instructions less for a frame of eight bytes.
pub(crate) fn crc16_rolled(bytes: &[u8]) -> u16 {
    by_table(bytes, || black_box(()))
}

/// [`crc16`]; `each` is called for each two bytes.
#[inline(always)]
fn by_table(bytes: &[u8], each: impl Fn()) -> u16 {
    // a loop of our own, two bytes at once: for frames this short the crate's takes half as much again on a Cortex-M4
    let look = |index: u32| {
        let [index, ..] = index.to_le_bytes();
        u32::from(BYTES.get(usize::from(index)).copied().unwrap_or(0))
    };
    let (pairs, single) = bytes.as_chunks::<2>();
    let mut crc = u32::from(START);
    for pair in pairs {
        each();
        let both = crc ^ u32::from(u16::from_le_bytes(*pair));
        let first = look(both);
        crc = first >> 8 ^ look(both >> 8 ^ first);
    }
    if let [last] = single {
        crc = crc >> 8 ^ look(crc ^ u32::from(*last));
    }
    let [low, high, ..] = crc.to_le_bytes();
    u16::from_le_bytes([low, high])
}

/// What eight bits that leave the CRC put into it when none, one, two or three bytes follow them: rows of the `crc` crate.
static SLICES: [[u16; 256]; 4] = {
    let crc = crc::Crc::<u16, crc::Table<16>>::new(&crc::CRC_16_MODBUS);
    let [none, one, two, three, ..] = *crc.table();
    [none, one, two, three]
};

/// [`crc16`] with tables of 2 KiB, four bytes at once: for hosts; a Cortex-M4 gains next to nothing by it.
#[must_use]
pub fn crc16_sliced(bytes: &[u8]) -> u16 {
    let [none, one, two, three] = &SLICES;
    let look = |row: &[u16; 256], index: u8| row.get(usize::from(index)).copied().unwrap_or(0);
    let (fours, rest) = bytes.as_chunks::<4>();
    let mut crc = START;
    for [a, b, c, d] in fours {
        let [low, high] = (crc ^ u16::from_le_bytes([*a, *b])).to_le_bytes();
        crc = look(three, low) ^ look(two, high) ^ look(one, *c) ^ look(none, *d);
    }
    let (pairs, single) = rest.as_chunks::<2>();
    if let [pair] = pairs {
        let [low, high] = (crc ^ u16::from_le_bytes(*pair)).to_le_bytes();
        crc = look(one, low) ^ look(none, high);
    }
    if let [last] = single {
        let [low, high] = crc.to_le_bytes();
        crc = u16::from(high) ^ look(none, low ^ last);
    }
    crc
}

/// The polynomial with its bits reversed, and the CRC of no bytes.
const POLYNOMIAL: u16 = 0xA001;
const START: u16 = 0xFFFF;

const fn shift(mut crc: u16, bits: u32) -> u16 {
    let mut bit = 0u32;
    while bit < bits {
        let carry = crc & 1 == 1;
        crc >>= 1;
        if carry {
            crc ^= POLYNOMIAL;
        }
        bit = bit.wrapping_add(1);
    }
    crc
}

/// What four bits that leave the CRC put into it.
static NIBBLES: [u16; 16] = [
    shift(0, 4),
    shift(1, 4),
    shift(2, 4),
    shift(3, 4),
    shift(4, 4),
    shift(5, 4),
    shift(6, 4),
    shift(7, 4),
    shift(8, 4),
    shift(9, 4),
    shift(10, 4),
    shift(11, 4),
    shift(12, 4),
    shift(13, 4),
    shift(14, 4),
    shift(15, 4),
];

/// [`crc16`] with a table of 32 bytes, two looks a byte.
#[must_use]
pub fn crc16_small(bytes: &[u8]) -> u16 {
    let look = |crc: u16| crc >> 4 ^ NIBBLES.get(usize::from(crc & 0xF)).copied().unwrap_or(0);
    bytes.iter().fold(START, |crc, byte| look(look(crc ^ u16::from(*byte))))
}

/// [`crc16`] without a table, eight steps a byte.
#[must_use]
pub fn crc16_bitwise(bytes: &[u8]) -> u16 {
    bytes.iter().fold(START, |crc, byte| shift(crc ^ u16::from(*byte), 8))
}

/// The content of a frame that ends with its CRC, low byte first; `None` where the CRC is wrong or missing.
///
/// The NST manual (4.2.3) names the high byte first; every frame that it prints has the low byte first.
#[must_use]
pub fn strip_crc(frame: &[u8]) -> Option<&[u8]> {
    let (content, crc) = frame.split_last_chunk::<CRC_LENGTH>()?;
    (crc16(content) == u16::from_le_bytes(*crc)).then_some(content)
}

/// Appends the CRC of all that has been written, low byte first.
///
/// # Errors
/// [`NoSpace`] where the buffer has no room for it.
pub fn append_crc(writer: &mut Writer<'_>) -> Result<(), NoSpace> {
    let crc = crc16(writer.written());
    writer.slice(&crc.to_le_bytes())
}

/// Puts the CRC of what is before them into the last two bytes of a frame.
pub(crate) fn close(frame: &mut [u8]) {
    if let Some((content, crc)) = frame.split_last_chunk_mut::<CRC_LENGTH>() {
        *crc = crc16(content).to_le_bytes();
    }
}

/// A frame of an address, what `content` writes, and the CRC.
pub(crate) fn frame(
    address: u8,
    content: impl FnOnce(&mut Writer<'_>) -> Result<(), NoSpace>,
    buffer: &mut [u8],
) -> Result<&[u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(address)?;
    content(&mut writer)?;
    append_crc(&mut writer)?;
    Ok(writer.finish())
}

/// LRC of Modbus ASCII over the bytes that the characters stand for: two's complement of their 8-bit sum.
#[must_use]
pub fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)).wrapping_neg()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lrc_of_the_ndam_manual_corrected() {
        assert_eq!(lrc(&[0x02, 0x01, 0x00, 0x00, 0x00, 0x01]), 0xFC);
    }

    #[test]
    fn check_value_of_the_catalogue() {
        assert_eq!(crc16(b"123456789"), 0x4B37);
    }

    #[test]
    fn the_ways_to_the_crc_agree() {
        let bytes: [u8; 256] = core::array::from_fn(|index| (index * 167 + 13) as u8);
        for start in (0..bytes.len()).step_by(crate::stride(17)) {
            for length in [0, 1, 2, 3, 4, 5, 6, 7, 8, 40] {
                let Some(bytes) = bytes.get(start..start + length) else { continue };
                assert_eq!(crc16_rolled(bytes), crc16(bytes));
                assert_eq!(crc16_sliced(bytes), crc16(bytes));
                assert_eq!(crc16_small(bytes), crc16(bytes));
                assert_eq!(crc16_bitwise(bytes), crc16(bytes));
            }
        }
    }

    #[test]
    fn a_frame_is_sealed_and_verified() {
        let mut buffer = [0xEE; 9];
        let mut writer = Writer::new(&mut buffer);
        // NST manual, 4.3.1.10
        writer.slice(&[0x01, 0x03, 0x02, 0x00, 0x12]).unwrap();
        append_crc(&mut writer).unwrap();
        let frame = writer.finish();
        assert_eq!(frame, [0x01, 0x03, 0x02, 0x00, 0x12, 0x38, 0x49]);
        assert_eq!(strip_crc(frame), Some(&frame[..5]));
        for cut in 0..frame.len() {
            assert_eq!(strip_crc(&frame[..cut]), None);
        }
    }
}
