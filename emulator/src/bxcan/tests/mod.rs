//! The controller as firmware and bus see it, by its registers alone.

mod errors;
mod mailboxes;
mod reception;

use super::*;
use jointbus_protocol::can::Id;

const RQCP: u32 = tsr::RQCP;
const TEC_UNIT: u32 = 8;

fn standard(id: u16, data: &[u8]) -> Frame {
    Frame::data_frame(Id::Standard(id), data).unwrap()
}

fn extended(id: u32, data: &[u8]) -> Frame {
    Frame::data_frame(Id::Extended(id), data).unwrap()
}

/// A controller on the bus, with these control bits and a first filter that lets everything into FIFO 0.
fn on_bus(control: u32) -> BxCan {
    let mut can = BxCan::new();
    can.write(mcr::OFFSET, control | mcr::INRQ);
    set_filters(&mut can, |can| {
        can.write(filter::FS1R, 1);
        can.write(filter::FA1R, 1);
    });
    can.write(mcr::OFFSET, control);
    can.recessive_sequence();
    assert_eq!(can.read(msr::OFFSET), msr::RECESSIVE);
    can
}

fn set_filters(can: &mut BxCan, set: impl FnOnce(&mut BxCan)) {
    can.write(filter::FMR, filter::FMR_AFTER_RESET);
    set(can);
    can.write(filter::FMR, filter::FMR_AFTER_RESET & !filter::FINIT);
}

fn request(can: &mut BxCan, mailbox: u32, frame: &Frame) {
    let base = frame::MAILBOXES + 16 * mailbox;
    let [a, b, c, d, e, f, g, h] = *frame.payload();
    can.write(base + 4, u32::from(frame.dlc()));
    can.write(base + 8, u32::from_le_bytes([a, b, c, d]));
    can.write(base + 12, u32::from_le_bytes([e, f, g, h]));
    can.write(base, mailbox::identifier_register(frame) | frame::TXRQ);
}

/// Sends what is pending; the identifiers in their order.
fn send_all(can: &mut BxCan) -> Vec<Id> {
    let mut sent = Vec::new();
    while let Some(frame) = can.begin() {
        can.finish(Transmission::Acknowledged);
        sent.push(frame.id());
    }
    sent
}

fn status(can: &mut BxCan, mailbox: u32) -> u32 {
    can.read(tsr::OFFSET) >> (8 * mailbox) & 0xff
}

fn transmit_errors(can: &mut BxCan) -> u32 {
    can.read(esr::OFFSET) >> esr::TEC
}

fn stored(can: &mut BxCan, fifo: u32) -> u32 {
    can.read(rfr::OFFSET_0 + 4 * fifo) & 3
}

/// FIFO 0's front identifier register and filter match index; releases it.
fn take(can: &mut BxCan) -> (u32, u32) {
    let front = (can.read(frame::FIFOS), can.read(frame::FIFOS + 4) >> frame::FMI & 0xff);
    can.write(rfr::OFFSET_0, rfr::RFOM);
    front
}

#[test]
fn registers_start_as_the_manual_says() {
    let mut can = BxCan::new();
    for (offset, value) in [
        (mcr::OFFSET, 0x0001_0002),
        (msr::OFFSET, 0x0000_0c02),
        (tsr::OFFSET, 0x1c00_0000),
        (rfr::OFFSET_0, 0),
        (rfr::OFFSET_1, 0),
        (ier::OFFSET, 0),
        (esr::OFFSET, 0),
        (btr::OFFSET, 0x0123_0000),
        (filter::FMR, 0x2a1c_0e01),
        (filter::FA1R, 0),
    ] {
        assert_eq!(can.read(offset), value, "{offset:#x}");
    }
}

#[test]
fn modes_are_acknowledged() {
    let mut can = BxCan::new();
    let mode = |can: &mut BxCan| can.read(msr::OFFSET) & (msr::INAK | msr::SLAK);
    can.write(mcr::OFFSET, mcr::INRQ);
    assert_eq!(mode(&mut can), msr::INAK);
    can.write(mcr::OFFSET, mcr::SLEEP);
    assert_eq!(mode(&mut can), msr::SLAK);
    can.write(mcr::OFFSET, 0);
    assert!(can.awaits_recessive_bits());
    assert_eq!(mode(&mut can), msr::SLAK);
    can.recessive_sequence();
    assert_eq!(mode(&mut can), 0);
    assert!(!can.awaits_recessive_bits());
}

#[test]
fn a_stuck_bus_is_never_joined_and_initialisation_still_works() {
    let mut can = BxCan::new();
    can.write(mcr::OFFSET, mcr::INRQ);
    can.write(mcr::OFFSET, 0);
    request(&mut can, 0, &standard(1, &[]));
    assert_eq!(can.read(msr::OFFSET) & msr::INAK, msr::INAK);
    assert_eq!((can.begin(), can.contender(), can.listens()), (None, None, false));
    can.write(tsr::OFFSET, tsr::ABRQ);
    assert_eq!(status(&mut can, 0), RQCP);
    can.write(mcr::OFFSET, mcr::SLEEP);
    assert_eq!(can.read(msr::OFFSET) & msr::SLAK, msr::SLAK);
}

#[test]
fn a_mode_change_waits_for_the_frame_on_the_wire() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    request(&mut can, 1, &standard(2, &[]));
    can.begin().unwrap();
    can.write(mcr::OFFSET, mcr::INRQ);
    assert_eq!(can.read(msr::OFFSET) & msr::INAK, 0);
    can.finish(Transmission::Acknowledged);
    assert_eq!(can.read(msr::OFFSET) & msr::INAK, msr::INAK);
    assert_eq!(can.begin(), None);
    can.write(mcr::OFFSET, 0);
    can.recessive_sequence();
    assert_eq!(send_all(&mut can), [Id::Standard(2)]);
}

#[test]
fn going_to_sleep_and_waking_up_raise_status_interrupts() {
    let mut can = on_bus(mcr::AWUM);
    can.write(ier::OFFSET, ier::SLKIE | ier::WKUIE);
    can.write(mcr::OFFSET, mcr::AWUM | mcr::SLEEP);
    assert_eq!(can.read(msr::OFFSET), msr::RECESSIVE | msr::SLAK | msr::SLAKI);
    assert!(can.interrupts().status);
    can.write(msr::OFFSET, msr::SLAKI);
    assert!(!can.interrupts().status);
    assert_eq!(can.receive(&standard(1, &[])), Reception::Deaf);
    assert_eq!(can.read(msr::OFFSET) & msr::WKUI, msr::WKUI);
    assert!(can.interrupts().status && can.awaits_recessive_bits());
    can.recessive_sequence();
    assert_eq!(can.receive(&standard(1, &[])), Reception::Stored(0));
}

#[test]
fn bit_timing_is_set_in_initialisation_only() {
    let mut can = on_bus(0);
    can.write(btr::OFFSET, 0x001a_0002);
    assert_eq!(can.read(btr::OFFSET), btr::AFTER_RESET);
    can.write(mcr::OFFSET, mcr::INRQ);
    can.write(btr::OFFSET, 0x001a_0002);
    // 42 MHz / 3 / (1 + 11 + 2)
    assert_eq!(can.clocks_per_bit(), 42);
}

#[test]
fn looped_back_it_hears_itself_alone() {
    for silent in [0, btr::SILM] {
        let mut can = on_bus(0);
        can.write(mcr::OFFSET, mcr::INRQ);
        can.write(btr::OFFSET, btr::LBKM | silent);
        can.write(mcr::OFFSET, 0);
        can.recessive_sequence();
        request(&mut can, 0, &standard(1, &[]));
        can.begin().unwrap();
        can.finish(Transmission::NotAcknowledged);
        assert_eq!(status(&mut can, 0), RQCP | tsr::TXOK);
        assert_eq!(can.receive(&standard(2, &[])), Reception::Deaf);
        assert_eq!(take(&mut can).0, 1 << 21);
        assert_eq!(can.drives_bus(), silent == 0);
    }
}

#[test]
fn silent_it_hears_and_never_sends() {
    let mut can = on_bus(0);
    can.write(mcr::OFFSET, mcr::INRQ);
    can.write(btr::OFFSET, btr::SILM);
    can.write(mcr::OFFSET, 0);
    can.recessive_sequence();
    request(&mut can, 0, &standard(1, &[]));
    assert_eq!((can.begin(), can.contender()), (None, None));
    assert_eq!(can.receive(&standard(2, &[])), Reception::Stored(0));
}

#[test]
fn a_master_reset_keeps_the_filters_and_the_reset_line_does_not() {
    let mut can = on_bus(0);
    can.receive(&standard(1, &[]));
    request(&mut can, 0, &standard(1, &[]));
    can.write(mcr::OFFSET, mcr::RESET);
    assert_eq!((can.read(mcr::OFFSET), can.read(msr::OFFSET)), (mcr::AFTER_RESET, 0xc02));
    assert_eq!((stored(&mut can, 0), can.read(tsr::OFFSET)), (0, 0x1c00_0000));
    assert_eq!(can.read(filter::FA1R), 1);
    can.reset();
    assert_eq!(can.read(filter::FA1R), 0);
}
