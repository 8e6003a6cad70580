//! The CAN controller (RM0090, chapter 32), with a bound on every wait. Driven by its registers because the kept
//! driver crate waits for the controller without bound and stops at a data length code above 8.

use crate::constants::HARDWARE_TRIES;
use jointbus_protocol::can::{Frame, Id};
use stm32f4xx_hal::pac::can1::RegisterBlock;

/// The controller did not follow.
#[derive(Clone, Copy)]
pub struct NoController;

/// Mailboxes for transmission.
const MAILBOXES: usize = 3;

/// Bits of TSR that belong to mailbox 0; those of the others are 8 and 16 places up.
mod tsr {
    pub(super) const COMPLETED: u32 = 1;
    pub(super) const SENT: u32 = 1 << 1;
    pub(super) const ABORT: u32 = 1 << 7;
    /// All three mailboxes are empty.
    pub(super) const EMPTY: u32 = 0b111 << 26;
}

/// Bits of an identifier register.
mod ir {
    pub(super) const REQUEST: u32 = 1;
    pub(super) const REMOTE: u32 = 1 << 1;
    pub(super) const EXTENDED: u32 = 1 << 2;
}

/// What became of frames since it was asked last.
#[derive(Clone, Copy, Default)]
pub struct Completed {
    /// Frames that were acknowledged.
    pub sent: u32,
}

/// Takes the controller through its modes, and sets bit rate and filter. It joins the bus as soon as that is idle,
/// and nobody waits for it.
pub fn start(can: &RegisterBlock, bus_hz: u32, kbit_per_s: u16, node: u8) -> Result<(), NoController> {
    // sleep off, initialisation on
    can.mcr().modify(|_, w| w.sleep().clear_bit().inrq().set_bit());
    wait(|| can.msr().read().inak().bit_is_set() && can.msr().read().slak().bit_is_clear())?;
    let timing = bit_timing(bus_hz, u32::from(kbit_per_s) * 1000).ok_or(NoController)?;
    // SAFETY: a value that `bit_timing` made for this register
    can.btr().write(|w| unsafe { w.bits(timing) });
    can.mcr().modify(|_, w| {
        // stay bus-off until it is restarted; transmit in the order of the requests; never stop retrying by itself
        w.abom().clear_bit().txfp().set_bit().nart().clear_bit().rflm().clear_bit()
    });
    set_filter(can, node);
    can.ier().write(|w| {
        w.fmpie0().set_bit().fovie0().set_bit().tmeie().set_bit().lecie().set_bit().errie().set_bit()
    });
    can.mcr().modify(|_, w| w.inrq().clear_bit());
    Ok(())
}

fn wait(ready: impl Fn() -> bool) -> Result<(), NoController> {
    if (0..HARDWARE_TRIES).any(|_| ready()) { Ok(()) } else { Err(NoController) }
}

/// Only extended data frames to `node` with bits 28:24 zero pass, into FIFO 0.
fn set_filter(can: &RegisterBlock, node: u8) {
    const FIELDS: u32 = 0x1F00_FF00 << 3 | ir::EXTENDED | ir::REMOTE;
    let value = u32::from(node) << 11 | ir::EXTENDED;
    can.fmr().modify(|_, w| w.finit().set_bit());
    // SAFETY: bank 0 as one 32-bit mask for FIFO 0, the others off; all values are allowed
    unsafe {
        can.fa1r().write(|w| w.bits(0));
        can.fm1r().write(|w| w.bits(0));
        can.fs1r().write(|w| w.bits(1));
        can.ffa1r().write(|w| w.bits(0));
        can.fb(0).fr1().write(|w| w.bits(value));
        can.fb(0).fr2().write(|w| w.bits(FIELDS));
        can.fa1r().write(|w| w.bits(1));
    }
    can.fmr().modify(|_, w| w.finit().clear_bit());
}

/// Value of BTR for a bit rate: 8 to 25 time quanta a bit, sampled at about 7/8.
fn bit_timing(bus_hz: u32, rate: u32) -> Option<u32> {
    let quanta = (8..=18).rev().find(|quanta| {
        let step = rate * quanta;
        bus_hz.is_multiple_of(step) && (1..=1024).contains(&(bus_hz / step))
    })?;
    let prescaler = bus_hz / (rate * quanta);
    let after = (quanta / 8).max(1);
    let before = quanta - 1 - after;
    Some((after - 1) << 20 | (before - 1) << 16 | (prescaler - 1))
}

fn free_mailbox(can: &RegisterBlock) -> Option<usize> {
    let status = can.tsr().read().bits();
    (0..MAILBOXES).find(|index| status & 1 << (26 + index) != 0)
}

/// Whether a mailbox is free.
pub fn has_room(can: &RegisterBlock) -> bool {
    free_mailbox(can).is_some()
}

/// Puts a frame into a free mailbox; [`has_room`] tells whether there is one.
pub fn transmit(can: &RegisterBlock, frame: &Frame) {
    let Some(free) = free_mailbox(can) else { return };
    let [a, b, c, d, e, f, g, h] = *frame.payload();
    let mut identifier = match frame.id() {
        Id::Standard(id) => u32::from(id) << 21,
        Id::Extended(id) => id << 3 | ir::EXTENDED,
    };
    if frame.is_remote() {
        identifier |= ir::REMOTE;
    }
    let mailbox = can.tx(free);
    // SAFETY: any content is a frame; the request bit goes last
    unsafe {
        mailbox.tdtr().write(|w| w.bits(frame.dlc().into()));
        mailbox.tdlr().write(|w| w.bits(u32::from_le_bytes([a, b, c, d])));
        mailbox.tdhr().write(|w| w.bits(u32::from_le_bytes([e, f, g, h])));
        mailbox.tir().write(|w| w.bits(identifier | ir::REQUEST));
    }
}

/// Gives up every frame that has not been sent; see [`is_empty`].
pub fn abort(can: &RegisterBlock) {
    let all = tsr::ABORT | tsr::ABORT << 8 | tsr::ABORT << 16;
    // SAFETY: the other bits of this register ignore a written 0
    can.tsr().write(|w| unsafe { w.bits(all) });
}

/// Whether no mailbox holds a frame.
pub fn is_empty(can: &RegisterBlock) -> bool {
    can.tsr().read().bits() & tsr::EMPTY == tsr::EMPTY
}

/// The interrupt of the mailboxes: which requests are complete, and clears them.
pub fn completed(can: &RegisterBlock) -> Completed {
    let status = can.tsr().read().bits();
    let mut completed = Completed::default();
    for shift in [0, 8, 16] {
        let mailbox = status >> shift;
        if mailbox & tsr::COMPLETED != 0 {
            completed.sent += u32::from(mailbox & tsr::SENT != 0);
            // SAFETY: the other bits of this register ignore a written 0
            can.tsr().write(|w| unsafe { w.bits(tsr::COMPLETED << shift) });
        }
    }
    completed
}

/// A frame as it waits for the main loop, in few bytes.
pub struct Received {
    /// The identifier register; the filter lets nothing pass whose highest four bits are set, so the data length code
    /// takes their place.
    head: u32,
    data: [u32; 2],
    /// When it came, the low half of the microseconds since boot.
    pub micros: u32,
}

impl Received {
    /// The frame; `None` for one that no controller should pass on.
    pub fn frame(&self) -> Option<Frame> {
        let [low, high] = self.data;
        let ([a, b, c, d], [e, f, g, h]) = (low.to_le_bytes(), high.to_le_bytes());
        let identifier = self.head & 0x0FFF_FFFF;
        let id = match identifier & ir::EXTENDED {
            0 => Id::Standard((identifier >> 21) as u16),
            _ => Id::Extended(identifier >> 3),
        };
        let remote = identifier & ir::REMOTE != 0;
        Frame::from_parts(id, remote, (self.head >> 28) as u8, [a, b, c, d, e, f, g, h]).ok()
    }
}

/// The oldest frame of FIFO 0, which makes room for another.
pub fn receive(can: &RegisterBlock, micros: u32) -> Option<Received> {
    if can.rf0r().read().fmp().bits() == 0 {
        return None;
    }
    let mailbox = can.rx(0);
    let length = u32::from(mailbox.rdtr().read().dlc().bits());
    let received = Received {
        head: mailbox.rir().read().bits() & 0x0FFF_FFFF | length << 28,
        data: [mailbox.rdlr().read().bits(), mailbox.rdhr().read().bits()],
        micros,
    };
    can.rf0r().write(|w| w.rfom().set_bit());
    Some(received)
}

/// Whether FIFO 0 lost a frame since it was asked last.
pub fn overrun(can: &RegisterBlock) -> bool {
    let lost = can.rf0r().read().fovr().bit_is_set();
    if lost {
        can.rf0r().write(|w| w.fovr().set_bit());
    }
    lost
}

/// What went wrong on the bus last.
pub enum BusError {
    /// While this node was sending.
    Transmit,
    /// While another one was.
    Receive,
}

/// The interrupt of errors: what it was, if anything.
pub fn error(can: &RegisterBlock) -> Option<BusError> {
    /// Written to see the next error.
    const NONE: u8 = 7;
    let code = can.esr().read().lec().bits();
    // SAFETY: the field takes any three bits
    can.esr().modify(|_, w| unsafe { w.lec().bits(NONE) });
    can.msr().write(|w| w.erri().set_bit());
    match code {
        // acknowledgement, bit recessive, bit dominant
        3..=5 => Some(BusError::Transmit),
        // stuff, form, CRC
        1 | 2 | 6 => Some(BusError::Receive),
        _ => None,
    }
}

/// Restarts the controller after it went bus-off: it returns once the bus was idle for 128 times eleven bits.
pub fn restart(can: &RegisterBlock) -> Result<(), NoController> {
    can.mcr().modify(|_, w| w.inrq().set_bit());
    let result = wait(|| can.msr().read().inak().bit_is_set());
    can.mcr().modify(|_, w| w.inrq().clear_bit());
    result
}

/// Whether the controller is bus-off.
pub fn is_bus_off(can: &RegisterBlock) -> bool {
    can.esr().read().boff().bit_is_set()
}
