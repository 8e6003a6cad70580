//! A receive FIFO of three frames (RM0090, 32.7.3).

use super::mailbox::identifier_register;
use super::registers::{frame, ier, rfr};
use jointbus_protocol::can::Frame;
use std::collections::VecDeque;

const DEPTH: usize = 3;

#[derive(Debug, Clone, Default)]
pub(super) struct Fifo {
    /// RIxR, RDTxR, RDLxR, RDHxR of each frame.
    frames: VecDeque<[u32; 4]>,
    /// What the output registers show when nothing is stored.
    last: [u32; 4],
    /// FULL, FOVR.
    flags: u32,
}

impl Fifo {
    /// Stores a frame; whether none was lost over it.
    pub(super) fn store(&mut self, frame: &Frame, filter: u32, locked: bool) -> bool {
        let [a, b, c, d, e, f, g, h] = *frame.payload();
        let entry = [
            identifier_register(frame),
            filter << frame::FMI | u32::from(frame.dlc()),
            u32::from_le_bytes([a, b, c, d]),
            u32::from_le_bytes([e, f, g, h]),
        ];
        let fits = self.frames.len() < DEPTH;
        if !fits {
            self.flags |= rfr::FOVR;
            if locked {
                return false;
            }
            self.frames.pop_back();
        }
        self.frames.push_back(entry);
        if self.frames.len() == DEPTH {
            self.flags |= rfr::FULL;
        }
        fits
    }

    /// Whether the next frame costs one.
    pub(super) fn is_full(&self) -> bool {
        self.frames.len() == DEPTH
    }

    /// Whether one of the interrupts enabled in `enabled` (moved to FIFO 0's place) is due.
    pub(super) fn interrupt(&self, enabled: u32) -> bool {
        enabled & ier::FMPIE != 0 && !self.frames.is_empty()
            || enabled & ier::FFIE != 0 && self.flags & rfr::FULL != 0
            || enabled & ier::FOVIE != 0 && self.flags & rfr::FOVR != 0
    }

    /// RIxR to RDHxR.
    pub(super) fn read(&mut self, register: usize) -> u32 {
        if let Some(&front) = self.frames.front() {
            self.last = front;
        }
        self.last[register]
    }

    pub(super) fn read_status(&self) -> u32 {
        self.frames.len() as u32 | self.flags
    }

    pub(super) fn write_status(&mut self, value: u32) {
        self.flags &= !(value & (rfr::FULL | rfr::FOVR));
        if value & rfr::RFOM != 0 {
            self.frames.pop_front();
        }
    }
}
