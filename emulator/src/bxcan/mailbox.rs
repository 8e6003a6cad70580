//! The three transmit mailboxes: requests, priority, outcome, abort (RM0090, 32.7.1).

use super::registers::{frame, tsr};
use jointbus_protocol::can::{Frame, Id};

const COUNT: usize = 3;

/// Which of several waiting frames goes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    /// The one that would win arbitration; of equals the lower mailbox.
    Identifier,
    /// The one requested first.
    Request,
}

/// The arbitration field of a frame as a number: the smaller one wins the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Arbitration(u64);

impl Arbitration {
    /// The field of this frame.
    #[must_use]
    pub fn of(frame: &Frame) -> Self {
        Self::of_register(identifier_register(frame))
    }

    /// Eleven identifier bits, SRR or RTR, IDE, eighteen identifier bits, RTR.
    fn of_register(register: u32) -> Self {
        let base = u64::from(register >> frame::STID);
        let remote = u64::from(register & frame::RTR != 0);
        if register & frame::IDE == 0 {
            return Self(base << 21 | remote << 20);
        }
        let extension = u64::from(register >> frame::EXID & 0x3_ffff);
        Self(base << 21 | 1 << 20 | 1 << 19 | extension << 1 | remote)
    }
}

/// A frame's identifier, IDE and RTR as TIxR and RIxR hold them.
pub(super) fn identifier_register(frame: &Frame) -> u32 {
    let remote = if frame.is_remote() { frame::RTR } else { 0 };
    match frame.id() {
        Id::Standard(id) => u32::from(id) << frame::STID | remote,
        Id::Extended(id) => id << frame::EXID | frame::IDE | remote,
    }
}

/// What became of one attempt to transmit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Attempt {
    Sent,
    Lost,
    Failed,
}

#[derive(Debug, Clone, Copy, Default)]
struct Mailbox {
    /// TIxR, TDTxR, TDLxR, TDHxR.
    registers: [u32; 4],
    /// RQCP, TXOK, ALST, TERR.
    status: u32,
    abort: bool,
    /// Number of the request, counted over all mailboxes.
    request: u64,
}

impl Mailbox {
    const fn is_pending(&self) -> bool {
        self.registers[0] & frame::TXRQ != 0
    }

    fn complete(&mut self, outcome: u32) {
        self.registers[0] &= !frame::TXRQ;
        self.status = tsr::RQCP | outcome;
        self.abort = false;
    }

    fn frame(&self) -> Frame {
        let [identifier, length, low, high] = self.registers;
        let id = if identifier & frame::IDE == 0 {
            Id::Standard((identifier >> frame::STID) as u16)
        } else {
            Id::Extended(identifier >> frame::EXID)
        };
        let mut data = [0; 8];
        data[..4].copy_from_slice(&low.to_le_bytes());
        data[4..].copy_from_slice(&high.to_le_bytes());
        Frame::from_parts(id, identifier & frame::RTR != 0, (length & 0xf) as u8, data)
            .expect("identifier and length have no more bits than their fields")
    }
}

#[derive(Debug, Clone, Default)]
pub(super) struct Mailboxes {
    boxes: [Mailbox; COUNT],
    requests: u64,
    on_wire: Option<usize>,
}

impl Mailboxes {
    pub(super) const fn on_wire(&self) -> bool {
        self.on_wire.is_some()
    }

    pub(super) fn any_completed(&self) -> bool {
        self.boxes.iter().any(|mailbox| mailbox.status & tsr::RQCP != 0)
    }

    /// The pending mailboxes, the one that goes first in front.
    fn pending(&self, order: Order) -> Vec<usize> {
        let mut pending: Vec<usize> = (0..COUNT).filter(|&i| self.boxes[i].is_pending()).collect();
        match order {
            Order::Identifier => {
                pending.sort_by_key(|&i| Arbitration::of_register(self.boxes[i].registers[0]))
            }
            Order::Request => pending.sort_by_key(|&i| self.boxes[i].request),
        }
        pending
    }

    /// The arbitration field of the frame that goes next.
    pub(super) fn contender(&self, order: Order) -> Option<Arbitration> {
        let next = *self.pending(order).first()?;
        Some(Arbitration::of_register(self.boxes[next].registers[0]))
    }

    /// Puts the next frame on the wire.
    pub(super) fn begin(&mut self, order: Order) -> Option<Frame> {
        let next = *self.pending(order).first()?;
        self.on_wire = Some(next);
        Some(self.boxes[next].frame())
    }

    /// The frame on the wire has ended; it is returned if it was sent. A failed one waits for the next attempt,
    /// unless it is the only one or has been aborted.
    pub(super) fn finish(&mut self, attempt: Attempt, only_attempt: bool) -> Option<Frame> {
        let mailbox = &mut self.boxes[self.on_wire.take()?];
        let outcome = match attempt {
            Attempt::Sent => tsr::TXOK,
            Attempt::Lost => tsr::ALST,
            Attempt::Failed => tsr::TERR,
        };
        let frame = (attempt == Attempt::Sent).then(|| mailbox.frame());
        if frame.is_some() || only_attempt || mailbox.abort {
            mailbox.complete(outcome);
        } else {
            mailbox.status = outcome;
        }
        frame
    }

    pub(super) fn read(&self, mailbox: usize, register: usize) -> u32 {
        self.boxes[mailbox].registers[register]
    }

    /// Writes TIxR to TDHxR; a pending mailbox is write-protected.
    pub(super) fn write(&mut self, mailbox: usize, register: usize, value: u32) {
        let mailbox = &mut self.boxes[mailbox];
        if mailbox.is_pending() {
            return;
        }
        mailbox.registers[register] = value & frame::STORED[register];
        if mailbox.is_pending() {
            self.requests += 1;
            mailbox.request = self.requests;
            mailbox.status = 0;
        }
    }

    pub(super) fn read_status(&self, order: Order) -> u32 {
        let pending = self.pending(order);
        let mut value = 0;
        for (i, mailbox) in self.boxes.iter().enumerate() {
            let abort = if mailbox.abort { tsr::ABRQ } else { 0 };
            value |= (mailbox.status | abort) << (8 * i);
            value |= u32::from(!mailbox.is_pending()) << (tsr::TME as usize + i);
        }
        if let [_, .., lowest] = pending[..] {
            value |= 1 << (tsr::LOW as usize + lowest);
        }
        let free = (0..COUNT).find(|i| !pending.contains(i));
        let code = free.or(pending.last().copied()).unwrap_or(0);
        value | (code as u32) << tsr::CODE
    }

    pub(super) fn write_status(&mut self, value: u32) {
        for (i, mailbox) in self.boxes.iter_mut().enumerate() {
            let bits = value >> (8 * i);
            if bits & tsr::RQCP != 0 {
                mailbox.status = 0;
            }
            mailbox.status &= !(bits & (tsr::TXOK | tsr::ALST | tsr::TERR));
            if bits & tsr::ABRQ != 0 && mailbox.is_pending() {
                if self.on_wire == Some(i) {
                    mailbox.abort = true;
                } else {
                    mailbox.complete(0);
                }
            }
        }
    }
}
