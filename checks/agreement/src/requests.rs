//! Requests, correct and not, from a seed.

use jointbus_protocol::checksum::crc16;

/// Longest frame.
const FRAME_MAX: usize = 256;

/// Numbers without a pattern, the same for the same seed (xorshift64*).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D)
    }

    fn below(&mut self, limit: usize) -> usize {
        (self.next() >> 33) as usize % limit
    }

    fn byte(&mut self) -> u8 {
        (self.next() >> 40) as u8
    }

    fn one_in(&mut self, chances: usize) -> bool {
        self.below(chances) == 0
    }

    fn among<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.below(values.len())]
    }

    /// A 16-bit number, mostly near one that matters.
    fn word(&mut self, edges: &[u16]) -> u16 {
        match self.below(4) {
            0 => self.next() as u16,
            1 => self.among(edges).wrapping_add(self.below(5) as u16).wrapping_sub(2),
            2 => self.below(16) as u16,
            _ => self.among(edges),
        }
    }
}

/// The next frame: a request to `unit`, most often changed in some places, most often with a right CRC.
pub(crate) fn next(random: &mut Random, unit: u8) -> Vec<u8> {
    let mut frame = vec![if random.one_in(16) { random.among(&[0, 2, 247, 255]) } else { unit }];
    frame.extend(pdu(random));
    for _ in 0..random.among(&[0, 0, 1, 1, 2, 3]) {
        mutate(random, &mut frame);
    }
    frame.truncate(FRAME_MAX - 2);
    if frame.is_empty() {
        frame.push(unit);
    }
    frame.extend(crc16(&frame).to_le_bytes());
    if random.one_in(24) {
        let at = random.below(frame.len());
        frame[at] ^= 1 << random.below(8);
    }
    frame
}

/// A correct request, but perhaps for its range.
fn pdu(random: &mut Random) -> Vec<u8> {
    const ADDRESSES: [u16; 8] = [0, 7, 64, 120, 127, 128, 2000, 0xFFFF];
    let function = random.among(&[1, 2, 3, 4, 5, 6, 15, 16, 22, 23]);
    let mut pdu = vec![function];
    let mut words = |words: &[u16]| pdu.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    let address = random.word(&ADDRESSES);
    match function {
        1 | 2 => words(&[address, random.word(&[0, 1, 8, 2000])]),
        3 | 4 => words(&[address, random.word(&[0, 1, 125])]),
        5 => words(&[address, random.among(&[0xFF00, 0, 0xFF00, 0, 1, 0x1234, 0xFFFF])]),
        6 => words(&[address, random.next() as u16]),
        15 => {
            let quantity = random.word(&[0, 1, 8, 9, 1968]);
            words(&[address, quantity]);
            data(random, &mut pdu, quantity.div_ceil(8).into());
        }
        16 => {
            let quantity = random.word(&[0, 1, 2, 123]);
            words(&[address, quantity]);
            data(random, &mut pdu, 2 * usize::from(quantity));
        }
        22 => words(&[address, random.next() as u16, random.next() as u16]),
        _ => {
            let quantity = random.word(&[0, 1, 2, 121]);
            words(&[address, random.word(&[0, 1, 125]), random.word(&ADDRESSES), quantity]);
            data(random, &mut pdu, 2 * usize::from(quantity));
        }
    }
    pdu
}

/// A byte count and so many bytes, as far as a frame holds them.
fn data(random: &mut Random, pdu: &mut Vec<u8>, length: usize) {
    let length = length.min(FRAME_MAX - 4 - pdu.len());
    pdu.push(u8::try_from(length).expect("less than a frame"));
    pdu.extend((0..length).map(|_| random.byte()));
}

/// One change.
fn mutate(random: &mut Random, frame: &mut Vec<u8>) {
    let at = random.below(frame.len());
    match random.below(6) {
        // the head is where the meaning is
        0 | 1 => {
            let at = random.below(frame.len().min(8));
            frame[at] =
                if random.one_in(2) { random.byte() } else { random.among(&[0, 1, 2, 0x7F, 0x80, 0xFF]) };
        }
        2 => frame[at] ^= 1 << random.below(8),
        3 => frame.truncate(at.max(1)),
        4 => {
            for _ in 0..=random.below(4) {
                let byte = random.byte();
                frame.push(byte);
            }
        }
        _ => frame[at.min(1)] = random.byte(),
    }
}
