//! The CAN controller of the STM32F4 (bxCAN, RM0090 chapter 32) as its registers and its bus see it.
//!
//! The model knows no time. Its surroundings bracket a frame of its own with [`BxCan::begin`] and
//! [`BxCan::finish`], hand it others' with [`BxCan::receive`], and tell it when the bus has been recessive for
//! eleven bits ([`BxCan::recessive_sequence`]), which is what it waits for to join the bus.
//!
//! Not modelled: time stamps and time-triggered mode, the receive error counter, CAN2 (its share of the filter
//! banks is left out), the debug freeze. Where the manual is silent on what a master reset (MCR.RESET) keeps, it
//! keeps the filters and nothing else.

mod errors;
mod fifo;
mod filters;
mod mailbox;
mod registers;
#[cfg(test)]
mod tests;

pub use mailbox::Arbitration;

use errors::{Errors, LastError};
use fifo::Fifo;
use filters::Filters;
use jointbus_protocol::can::Frame;
use mailbox::{Attempt, Mailboxes, Order};
use registers::{btr, esr, filter, frame, ier, mcr, msr, rfr, tsr};

/// Bytes that the registers occupy.
pub const SIZE: u32 = 0x400;

/// How the bus ended a frame of ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transmission {
    /// Sent, and another node acknowledged it.
    Acknowledged,
    /// Sent, and no other node acknowledged it.
    NotAcknowledged,
    /// A recessive level where a dominant one was sent.
    BitError,
    /// Another frame had the smaller arbitration field.
    ArbitrationLost,
}

/// What the controller did with a frame of another node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reception {
    /// Nothing: it is asleep, being initialised, bus-off, or looped back.
    Deaf,
    /// Seen, and no filter let it in.
    Filtered,
    /// Stored in this FIFO.
    Stored(usize),
    /// This FIFO was full: the frame or the newest one before it is lost.
    Overrun(usize),
}

/// Levels of the four interrupt lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Interrupts {
    /// CAN1_TX: a mailbox has completed.
    pub transmit: bool,
    /// CAN1_RX0 and CAN1_RX1: a FIFO has a frame, is full or has lost one.
    pub receive: [bool; 2],
    /// CAN1_SCE: error or change of status.
    pub status: bool,
}

/// The mode the controller has acknowledged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Sleep,
    Initialisation,
    Normal,
}

/// One controller.
#[derive(Debug, Clone)]
pub struct BxCan {
    mcr: u32,
    mode: Mode,
    /// ERRI, WKUI, SLAKI.
    status: u32,
    ier: u32,
    btr: u32,
    errors: Errors,
    mailboxes: Mailboxes,
    fifos: [Fifo; 2],
    filters: Filters,
}

impl Default for BxCan {
    fn default() -> Self {
        Self {
            mcr: mcr::AFTER_RESET,
            mode: Mode::Sleep,
            status: 0,
            ier: 0,
            btr: btr::AFTER_RESET,
            errors: Errors::default(),
            mailboxes: Mailboxes::default(),
            fifos: Default::default(),
            filters: Filters::default(),
        }
    }
}

/// The bus's side.
impl BxCan {
    /// A controller after power-on.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The reset line.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// Cycles of the peripheral clock that one bit takes.
    #[must_use]
    pub const fn clocks_per_bit(&self) -> u32 {
        let prescaler = (self.btr >> btr::BRP & 0x3ff) + 1;
        let quanta = 3 + (self.btr >> btr::TS1 & 0xf) + (self.btr >> btr::TS2 & 0x7);
        prescaler * quanta
    }

    /// Whether the frames of other nodes reach the controller, so that it acknowledges them (unless it is silent).
    #[must_use]
    pub fn listens(&self) -> bool {
        self.is_active() && !self.is_looped_back()
    }

    /// Whether the controller ever sends a dominant bit: not in silent mode.
    #[must_use]
    pub const fn drives_bus(&self) -> bool {
        self.btr & btr::SILM == 0
    }

    /// Whether no frame that came now would be lost, or cost another one.
    #[must_use]
    pub fn has_room(&self) -> bool {
        !self.is_active() || !self.fifos.iter().any(Fifo::is_full)
    }

    /// Whether it waits for [`Self::recessive_sequence`]: to join the bus, or to recover from bus-off.
    #[must_use]
    pub fn awaits_recessive_bits(&self) -> bool {
        self.is_joining() || self.mode == Mode::Normal && self.errors.recovers(self.has(mcr::ABOM))
    }

    /// The bus has been recessive for eleven bits.
    pub fn recessive_sequence(&mut self) {
        if self.is_joining() {
            if self.mode == Mode::Initialisation {
                self.errors.restart();
            }
            self.mode = Mode::Normal;
        } else if self.mode == Mode::Normal {
            self.errors.recessive_sequence(self.has(mcr::ABOM));
        }
    }

    /// What the frame that it would send next bids for the bus.
    #[must_use]
    pub fn contender(&self) -> Option<Arbitration> {
        if self.may_send() { self.mailboxes.contender(self.order()) } else { None }
    }

    /// Puts its next frame on the wire.
    pub fn begin(&mut self) -> Option<Frame> {
        if self.may_send() { self.mailboxes.begin(self.order()) } else { None }
    }

    /// Whether a frame of its own is on the wire.
    #[must_use]
    pub const fn is_on_wire(&self) -> bool {
        self.mailboxes.on_wire()
    }

    /// Its frame on the wire has ended.
    pub fn finish(&mut self, transmission: Transmission) {
        if !self.is_on_wire() {
            return;
        }
        let (attempt, error) = match transmission {
            Transmission::Acknowledged => (Attempt::Sent, None),
            Transmission::NotAcknowledged if self.is_looped_back() => (Attempt::Sent, None),
            Transmission::NotAcknowledged => (Attempt::Failed, Some(LastError::Acknowledgement)),
            Transmission::BitError => (Attempt::Failed, Some(LastError::BitDominant)),
            Transmission::ArbitrationLost => (Attempt::Lost, None),
        };
        if let Some(error) = error
            && self.errors.failed(error, self.ier)
        {
            self.status |= msr::ERRI;
        }
        if let Some(frame) = self.mailboxes.finish(attempt, self.has(mcr::NART)) {
            self.errors.passed(true);
            if self.is_looped_back() {
                self.store(&frame);
            }
        }
        self.follow_mode_requests();
    }

    /// Another node's frame has passed on the bus.
    pub fn receive(&mut self, frame: &Frame) -> Reception {
        if self.mode == Mode::Sleep {
            self.wake_up();
        }
        if !self.listens() {
            return Reception::Deaf;
        }
        self.errors.passed(false);
        self.store(frame)
    }

    /// Levels of the interrupt lines.
    #[must_use]
    pub fn interrupts(&self) -> Interrupts {
        let enabled = |interrupt| self.ier & interrupt != 0;
        let raised = |flag| self.status & flag != 0;
        Interrupts {
            transmit: enabled(ier::TMEIE) && self.mailboxes.any_completed(),
            receive: [self.fifos[0].interrupt(self.ier), self.fifos[1].interrupt(self.ier >> 3)],
            status: enabled(ier::ERRIE) && raised(msr::ERRI)
                || enabled(ier::WKUIE) && raised(msr::WKUI)
                || enabled(ier::SLKIE) && raised(msr::SLAKI),
        }
    }

    const fn has(&self, control: u32) -> bool {
        self.mcr & control != 0
    }

    const fn is_looped_back(&self) -> bool {
        self.btr & btr::LBKM != 0
    }

    /// On the bus and not bus-off.
    fn is_active(&self) -> bool {
        self.mode == Mode::Normal && !self.errors.is_bus_off()
    }

    fn is_joining(&self) -> bool {
        self.mode != Mode::Normal && !self.has(mcr::INRQ | mcr::SLEEP)
    }

    fn may_send(&self) -> bool {
        self.is_active() && !self.is_on_wire() && (self.drives_bus() || self.is_looped_back())
    }

    const fn order(&self) -> Order {
        if self.has(mcr::TXFP) { Order::Request } else { Order::Identifier }
    }

    fn store(&mut self, frame: &Frame) -> Reception {
        let Some(found) = self.filters.find(frame) else { return Reception::Filtered };
        let locked = self.has(mcr::RFLM);
        if self.fifos[found.fifo].store(frame, found.index, locked) {
            Reception::Stored(found.fifo)
        } else {
            Reception::Overrun(found.fifo)
        }
    }

    /// Traffic on the bus while asleep; the frame itself is lost.
    fn wake_up(&mut self) {
        if self.has(mcr::SLEEP) {
            self.status |= msr::WKUI;
            if self.has(mcr::AWUM) {
                self.mcr &= !mcr::SLEEP;
            }
        }
    }

    /// Enters the requested mode, as soon as no frame of ours is on the wire. Joining the bus takes a
    /// [`Self::recessive_sequence`] instead.
    fn follow_mode_requests(&mut self) {
        if self.is_on_wire() {
            return;
        }
        match (self.has(mcr::INRQ), self.has(mcr::SLEEP)) {
            (true, false) => self.mode = Mode::Initialisation,
            (false, true) if self.mode != Mode::Sleep => {
                self.mode = Mode::Sleep;
                if self.ier & ier::SLKIE != 0 {
                    self.status |= msr::SLAKI;
                }
            }
            _ => {}
        }
    }
}

/// The processor's side: 32 bit registers at byte offsets.
impl BxCan {
    /// Reads a register; one that is not there is 0.
    pub fn read(&mut self, offset: u32) -> u32 {
        match offset {
            mcr::OFFSET => self.mcr,
            msr::OFFSET => self.read_master_status(),
            tsr::OFFSET => self.mailboxes.read_status(self.order()),
            rfr::OFFSET_0 => self.fifos[0].read_status(),
            rfr::OFFSET_1 => self.fifos[1].read_status(),
            ier::OFFSET => self.ier,
            esr::OFFSET => self.errors.read(),
            btr::OFFSET => self.btr,
            frame::MAILBOXES..frame::FIFOS => {
                let (mailbox, register) = frame_register(offset - frame::MAILBOXES);
                self.mailboxes.read(mailbox, register)
            }
            frame::FIFOS..frame::END => {
                let (fifo, register) = frame_register(offset - frame::FIFOS);
                self.fifos[fifo].read(register)
            }
            filter::FMR..filter::END => self.filters.read(offset),
            _ => 0,
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) {
        match offset {
            mcr::OFFSET => self.write_master_control(value),
            msr::OFFSET => self.status &= !value,
            tsr::OFFSET => self.mailboxes.write_status(value),
            rfr::OFFSET_0 => self.fifos[0].write_status(value),
            rfr::OFFSET_1 => self.fifos[1].write_status(value),
            ier::OFFSET => self.ier = value & ier::STORED,
            esr::OFFSET => self.errors.write(value),
            btr::OFFSET if self.mode == Mode::Initialisation => self.btr = value & btr::STORED,
            frame::MAILBOXES..frame::FIFOS => {
                let (mailbox, register) = frame_register(offset - frame::MAILBOXES);
                self.mailboxes.write(mailbox, register, value);
            }
            filter::FMR..filter::END => self.filters.write(offset, value),
            _ => {}
        }
    }

    fn read_master_status(&self) -> u32 {
        let mode = match self.mode {
            Mode::Sleep => msr::SLAK,
            Mode::Initialisation => msr::INAK,
            Mode::Normal => 0,
        };
        mode | self.status | msr::RECESSIVE
    }

    fn write_master_control(&mut self, value: u32) {
        if value & mcr::RESET != 0 {
            let filters = self.filters.clone();
            *self = Self { filters, ..Self::default() };
        } else {
            self.mcr = value & mcr::STORED;
            self.follow_mode_requests();
        }
    }
}

/// Which group of four registers, and which register of it.
const fn frame_register(offset: u32) -> (usize, usize) {
    let word = offset as usize / 4;
    (word / 4, word % 4)
}
