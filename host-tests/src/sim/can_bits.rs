//! How many bits a CAN frame takes on the wire (ISO 11898-1): its fields, CRC-15 and stuff bits, bit by bit.

use jointbus_protocol::can::{Frame, Id};

/// Recessive bits between two frames.
pub const INTERMISSION: u64 = 3;

/// Bits of an error frame: a flag, the longest overlap of the others' flags, the delimiter.
pub const ERROR_FRAME: u64 = 6 + 6 + 8;

/// Recessive bits that a sender waits beyond the intermission once it is error passive.
pub const SUSPEND: u64 = 8;

/// Recessive bits in a row that make a bus idle, of which bus-off recovery counts 128 times.
pub const IDLE: u64 = 11;

/// Bits behind the CRC up to the end: its delimiter, acknowledgement slot and delimiter, end of frame.
const TAIL: u64 = 1 + 1 + 1 + 7;

/// Bits behind the CRC up to the acknowledgement slot, that included.
const TO_ACKNOWLEDGEMENT: u64 = 2;

/// Polynomial of CRC-15, without its top bit.
const POLYNOMIAL: u32 = 0x4599;

/// A frame's length on the wire, stuff bits included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Length {
    /// Start of frame to end of frame.
    pub whole: u64,
    /// Start of frame to acknowledgement slot, both included.
    pub to_acknowledgement: u64,
}

/// Bits in the order in which they are sent.
#[derive(Default)]
struct Bits {
    bits: u128,
    count: u32,
}

impl Bits {
    fn push(&mut self, value: u32, width: u32) {
        let mask = if width >= 32 { u32::MAX } else { (1 << width) - 1 };
        self.bits = self.bits << width | u128::from(value & mask);
        self.count += width;
    }

    fn iter(&self) -> impl Iterator<Item = bool> + '_ {
        (0..self.count).rev().map(|index| self.bits >> index & 1 == 1)
    }
}

/// The length of a frame.
#[must_use]
pub fn length(frame: &Frame) -> Length {
    let mut bits = fields(frame);
    bits.push(crc15(&bits), 15);
    let stuffed = u64::from(bits.count) + stuff_bits(&bits);
    Length { whole: stuffed + TAIL, to_acknowledgement: stuffed + TO_ACKNOWLEDGEMENT }
}

/// What decides an arbitration: the lower one wins.
#[must_use]
pub fn arbitration(frame: &Frame) -> u64 {
    let remote = u64::from(frame.is_remote());
    // base identifier, RTR or SRR, IDE, the rest of the identifier, RTR
    match frame.id() {
        Id::Standard(id) => u64::from(id) << 21 | remote << 20,
        Id::Extended(id) => {
            let (base, rest) = (u64::from(id >> 18), u64::from(id & 0x3_FFFF));
            base << 21 | 0b11 << 19 | rest << 1 | remote
        }
    }
}

/// Start of frame to data.
fn fields(frame: &Frame) -> Bits {
    let mut bits = Bits::default();
    let remote = u32::from(frame.is_remote());
    bits.push(0, 1);
    match frame.id() {
        Id::Standard(id) => {
            bits.push(id.into(), 11);
            // RTR, IDE, reserved
            bits.push(remote << 2, 3);
        }
        Id::Extended(id) => {
            bits.push(id >> 18, 11);
            // SRR, IDE
            bits.push(0b11, 2);
            bits.push(id, 18);
            // RTR, two reserved
            bits.push(remote << 2, 3);
        }
    }
    bits.push(frame.dlc().into(), 4);
    frame.data().iter().for_each(|byte| bits.push((*byte).into(), 8));
    bits
}

fn crc15(bits: &Bits) -> u32 {
    bits.iter().fold(0, |crc: u32, bit| {
        let next = bit != (crc & 0x4000 != 0);
        let shifted = crc << 1 & 0x7FFF;
        if next { shifted ^ POLYNOMIAL } else { shifted }
    })
}

/// Bits that are put in after five equal ones, which they count with in turn.
fn stuff_bits(bits: &Bits) -> u64 {
    let (mut stuffed, mut last, mut run) = (0, true, 0);
    for bit in bits.iter() {
        run = if bit == last { run + 1 } else { 1 };
        last = bit;
        if run == 5 {
            stuffed += 1;
            (last, run) = (!bit, 1);
        }
    }
    stuffed
}

#[cfg(test)]
mod tests {
    use super::*;

    fn extended(id: u32, data: &[u8]) -> Frame {
        Frame::data_frame(Id::Extended(id), data).unwrap()
    }

    #[test]
    fn lengths_stay_between_the_bare_and_the_worst() {
        for id in [0, 0x1FFF_FFFF, 0x0001_7F10, 0x0555_5555, 0x007F_0110] {
            for data in
                [&[][..], &[0; 8], &[0xFF; 8], &[0x55; 8], &[0x3C, 0xC3, 0x3C], &[0x03, 0x02, 0x00, 0x12]]
            {
                let bare = 64 + 8 * data.len() as u64;
                let worst = bare + (bare - TAIL - 1) / 4;
                let length = length(&extended(id, data));
                assert!((bare..=worst).contains(&length.whole), "{id:x} {data:02x?}: {length:?}");
                assert_eq!(length.whole - length.to_acknowledgement, 8);
            }
        }
    }

    #[test]
    fn no_stuff_bit_in_alternating_bits() {
        let mut bits = Bits::default();
        bits.push(0x5555_5555, 32);
        assert_eq!(stuff_bits(&bits), 0);
        bits.push(0, 32);
        assert_eq!(stuff_bits(&bits), 32 / 5, "a one after each five zeroes");
    }

    #[test]
    fn the_crc_of_known_bits() {
        // the check value of CRC-15/CAN over "123456789"
        let mut bits = Bits::default();
        b"123456789".iter().for_each(|byte| bits.push((*byte).into(), 8));
        assert_eq!(crc15(&bits), 0x059E);
    }

    #[test]
    fn the_lower_identifier_wins_and_base_format_before_extended() {
        let standard = |id| Frame::data_frame(Id::Standard(id), &[]).unwrap();
        assert!(arbitration(&standard(3)) < arbitration(&extended(3 << 18, &[])));
        assert!(arbitration(&extended(3 << 18, &[])) < arbitration(&standard(4)));
        assert!(arbitration(&extended(0x0001_7F10, &[])) < arbitration(&extended(0x007F_0110, &[])));
        let remote = Frame::from_parts(Id::Standard(3), true, 0, [0; 8]).unwrap();
        assert!(arbitration(&standard(3)) < arbitration(&remote));
    }
}
