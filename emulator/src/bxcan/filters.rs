//! The acceptance filters (RM0090, 32.7.4): 28 banks, of which CAN1 has those below CAN2SB.

use super::mailbox::identifier_register;
use super::registers::{filter, frame};
use jointbus_protocol::can::Frame;

/// The filter that lets a frame in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Match {
    pub(super) fifo: usize,
    /// Number of the filter, counted for each FIFO.
    pub(super) index: u32,
}

/// A value, and the bits in which a frame must be equal to it.
type Pattern = (u32, u32);

#[derive(Debug, Clone)]
pub(super) struct Filters {
    fmr: u32,
    /// FM1R: a bank's two registers are a list rather than value and mask.
    list: u32,
    /// FS1R: a bank compares 32 bits rather than 16.
    wide: u32,
    /// FFA1R.
    fifo: u32,
    /// FA1R.
    active: u32,
    banks: [[u32; 2]; filter::COUNT],
}

impl Default for Filters {
    fn default() -> Self {
        Self {
            fmr: filter::FMR_AFTER_RESET,
            list: 0,
            wide: 0,
            fifo: 0,
            active: 0,
            banks: [[0; 2]; filter::COUNT],
        }
    }
}

const fn bit(register: u32, bank: usize) -> bool {
    register >> bank & 1 != 0
}

/// A frame's identifier as the 16 bit filters see it: STID, RTR, IDE, EXID\[17:15\].
const fn short(identifier: u32) -> u32 {
    let remote = (identifier & frame::RTR != 0) as u32;
    let extended = (identifier & frame::IDE != 0) as u32;
    identifier >> frame::STID << 5 | remote << 4 | extended << 3 | identifier >> 18 & 0b111
}

impl Filters {
    const fn initialising(&self) -> bool {
        self.fmr & filter::FINIT != 0
    }

    fn own_banks(&self) -> usize {
        ((self.fmr >> filter::CAN2SB & 0x3f) as usize).min(filter::COUNT)
    }

    /// The filters of one bank, in their order.
    fn patterns(&self, bank: usize) -> Vec<Pattern> {
        const HALF: u32 = 0xffff;
        // TXRQ's place is no part of a received identifier.
        const WHOLE: u32 = !frame::TXRQ;
        let [a, b] = self.banks[bank];
        match (bit(self.wide, bank), bit(self.list, bank)) {
            (true, false) => vec![(a, b & WHOLE)],
            (true, true) => vec![(a, WHOLE), (b, WHOLE)],
            (false, false) => vec![(a & HALF, a >> 16), (b & HALF, b >> 16)],
            (false, true) => vec![(a & HALF, HALF), (a >> 16, HALF), (b & HALF, HALF), (b >> 16, HALF)],
        }
    }

    /// The filter that lets this frame in: of several a 32 bit one before a 16 bit one, then a list before a mask,
    /// then the lowest number. Banks that are not active count in the numbering.
    pub(super) fn find(&self, frame: &Frame) -> Option<Match> {
        if self.initialising() {
            return None;
        }
        let identifier = identifier_register(frame);
        let mut next_index = [0; 2];
        let mut best = None;
        for bank in 0..self.own_banks() {
            let (wide, list, fifo) =
                (bit(self.wide, bank), bit(self.list, bank), usize::from(bit(self.fifo, bank)));
            let seen = if wide { identifier } else { short(identifier) };
            for (value, mask) in self.patterns(bank) {
                let index = next_index[fifo];
                next_index[fifo] += 1;
                if bit(self.active, bank) && (seen ^ value) & mask == 0 {
                    let rank = (!wide, !list, index);
                    if best.is_none_or(|(best_rank, _)| rank < best_rank) {
                        best = Some((rank, Match { fifo, index }));
                    }
                }
            }
        }
        best.map(|(_, found)| found)
    }

    pub(super) fn read(&self, offset: u32) -> u32 {
        match offset {
            filter::FMR => self.fmr,
            filter::FM1R => self.list,
            filter::FS1R => self.wide,
            filter::FFA1R => self.fifo,
            filter::FA1R => self.active,
            filter::BANKS..filter::END => {
                let (bank, register) = bank_register(offset);
                self.banks[bank][register]
            }
            _ => 0,
        }
    }

    /// Mode, scale and FIFO of a bank change in initialisation only, its registers also while it is not active.
    pub(super) fn write(&mut self, offset: u32, value: u32) {
        let initialising = self.initialising();
        match offset {
            filter::FMR => self.fmr = self.fmr & !filter::FMR_STORED | value & filter::FMR_STORED,
            filter::FM1R if initialising => self.list = value & filter::ALL,
            filter::FS1R if initialising => self.wide = value & filter::ALL,
            filter::FFA1R if initialising => self.fifo = value & filter::ALL,
            filter::FA1R => self.active = value & filter::ALL,
            filter::BANKS..filter::END => {
                let (bank, register) = bank_register(offset);
                if initialising || !bit(self.active, bank) {
                    self.banks[bank][register] = value;
                }
            }
            _ => {}
        }
    }
}

const fn bank_register(offset: u32) -> (usize, usize) {
    let word = (offset - filter::BANKS) as usize / 4;
    (word / 2, word % 2)
}
