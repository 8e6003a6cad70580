//! The controller as firmware and bus see it, by its registers alone.

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
fn mailboxes_go_by_identifier() {
    let mut can = on_bus(0);
    request(&mut can, 0, &extended(0x123 << 18, &[]));
    request(&mut can, 1, &standard(0x124, &[]));
    request(&mut can, 2, &standard(0x123, &[]));
    let status = can.read(tsr::OFFSET);
    assert_eq!(status >> tsr::TME & 7, 0);
    assert_eq!(status >> tsr::LOW & 7, 0b010);
    assert_eq!(status >> tsr::CODE & 3, 1);
    // Of one base identifier the base format wins.
    let order = [Id::Standard(0x123), Id::Extended(0x123 << 18), Id::Standard(0x124)];
    assert_eq!(send_all(&mut can), order);
}

#[test]
fn a_data_frame_goes_before_the_remote_frame_of_its_identifier() {
    let remote = |id| Frame::from_parts(id, true, 0, [0; 8]).unwrap();
    assert!(Arbitration::of(&standard(5, &[])) < Arbitration::of(&remote(Id::Standard(5))));
    assert!(Arbitration::of(&extended(5, &[])) < Arbitration::of(&remote(Id::Extended(5))));
    assert!(Arbitration::of(&remote(Id::Standard(5))) < Arbitration::of(&extended(5 << 18, &[])));
}

#[test]
fn of_equal_identifiers_the_lower_mailbox_goes_first() {
    let mut can = on_bus(0);
    request(&mut can, 2, &standard(5, &[2]));
    request(&mut can, 1, &standard(5, &[1]));
    assert_eq!(can.begin().unwrap().data(), [1]);
}

#[test]
fn mailboxes_go_by_request_where_asked_to() {
    let mut can = on_bus(mcr::TXFP);
    for (mailbox, id) in [(2, 7), (0, 5), (1, 6)] {
        request(&mut can, mailbox, &standard(id, &[]));
    }
    assert_eq!(send_all(&mut can), [Id::Standard(7), Id::Standard(5), Id::Standard(6)]);
}

#[test]
fn a_free_mailbox_is_offered_and_a_pending_one_protected() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[1]));
    assert_eq!(can.read(tsr::OFFSET) >> tsr::CODE & 3, 1);
    assert_eq!(can.read(tsr::OFFSET) >> tsr::LOW, 0);
    request(&mut can, 0, &standard(2, &[2]));
    assert_eq!(can.begin(), Some(standard(1, &[1])));
}

#[test]
fn completion_is_reported_until_it_is_cleared() {
    let mut can = on_bus(0);
    can.write(ier::OFFSET, ier::TMEIE);
    request(&mut can, 1, &standard(1, &[]));
    can.begin().unwrap();
    assert!(!can.interrupts().transmit);
    can.finish(Transmission::Acknowledged);
    assert!(can.interrupts().transmit);
    assert_eq!(status(&mut can, 1), RQCP | tsr::TXOK);
    can.write(tsr::OFFSET, RQCP << 8);
    assert_eq!(status(&mut can, 1), 0);
    assert!(!can.interrupts().transmit);
}

#[test]
fn a_waiting_frame_is_aborted_at_once() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    can.write(tsr::OFFSET, tsr::ABRQ);
    assert_eq!(status(&mut can, 0), RQCP);
    assert_eq!(can.begin(), None);
}

#[test]
fn an_abort_does_not_stop_a_frame_that_gets_through() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    can.begin().unwrap();
    can.write(tsr::OFFSET, tsr::ABRQ);
    assert_eq!(status(&mut can, 0), tsr::ABRQ);
    can.finish(Transmission::Acknowledged);
    assert_eq!(status(&mut can, 0), RQCP | tsr::TXOK);
}

#[test]
fn a_frame_that_nobody_acknowledges_is_repeated_until_aborted() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    for _ in 0..3 {
        can.begin().unwrap();
        can.finish(Transmission::NotAcknowledged);
        assert_eq!(status(&mut can, 0), tsr::TERR);
        assert_eq!(can.read(esr::OFFSET) >> esr::LEC & 7, 3);
    }
    assert_eq!(transmit_errors(&mut can), 3 * TEC_UNIT);
    can.begin().unwrap();
    can.write(tsr::OFFSET, tsr::ABRQ);
    can.finish(Transmission::NotAcknowledged);
    assert_eq!(status(&mut can, 0), RQCP | tsr::TERR);
    assert_eq!(can.begin(), None);
}

#[test]
fn alone_on_the_bus_a_node_stays_error_passive() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    for _ in 0..100 {
        can.begin().unwrap();
        can.finish(Transmission::NotAcknowledged);
    }
    assert_eq!(can.read(esr::OFFSET) & 7, esr::EWGF | esr::EPVF);
    assert_eq!(transmit_errors(&mut can), 128);
}

#[test]
fn without_repetition_the_first_attempt_decides() {
    for (transmission, flag) in
        [(Transmission::NotAcknowledged, tsr::TERR), (Transmission::ArbitrationLost, tsr::ALST)]
    {
        let mut can = on_bus(mcr::NART);
        request(&mut can, 0, &standard(1, &[]));
        can.begin().unwrap();
        can.finish(transmission);
        assert_eq!(status(&mut can, 0), RQCP | flag);
        assert_eq!(can.begin(), None);
    }
}

#[test]
fn lost_arbitration_is_no_error() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    can.begin().unwrap();
    can.finish(Transmission::ArbitrationLost);
    assert_eq!(status(&mut can, 0), tsr::ALST);
    assert_eq!(can.read(esr::OFFSET), 0);
    assert_eq!(send_all(&mut can), [Id::Standard(1)]);
    assert_eq!(status(&mut can, 0), RQCP | tsr::TXOK);
}

fn fail_until_bus_off(can: &mut BxCan) -> u32 {
    request(can, 0, &standard(1, &[]));
    let mut failures = 0;
    while can.begin().is_some() {
        can.finish(Transmission::BitError);
        failures += 1;
    }
    failures
}

#[test]
fn errors_lead_past_warning_and_passive_to_bus_off() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    let mut seen = Vec::new();
    for failure in 1..=32 {
        can.begin().unwrap();
        can.finish(Transmission::BitError);
        let flags = can.read(esr::OFFSET) & 7;
        if seen.last().is_none_or(|&(_, last)| last != flags) {
            seen.push((failure, flags));
        }
    }
    assert_eq!(seen, [(1, 0), (12, 1), (16, 3), (32, 7)]);
    assert_eq!(can.read(esr::OFFSET) >> esr::LEC & 7, 5);
    assert_eq!((can.begin(), can.receive(&standard(2, &[]))), (None, Reception::Deaf));
}

#[test]
fn each_error_state_has_its_interrupt() {
    for (enabled, failures) in [(ier::LECIE, 1), (ier::EWGIE, 12), (ier::EPVIE, 16), (ier::BOFIE, 32)] {
        let mut can = on_bus(0);
        can.write(ier::OFFSET, ier::ERRIE | enabled);
        request(&mut can, 0, &standard(1, &[]));
        let mut count = 0;
        while !can.interrupts().status {
            can.begin().unwrap();
            can.finish(Transmission::BitError);
            count += 1;
        }
        assert_eq!(count, failures);
        can.write(msr::OFFSET, msr::ERRI);
        assert!(!can.interrupts().status);
    }
}

#[test]
fn the_error_interrupt_alone_never_fires() {
    let mut can = on_bus(0);
    can.write(ier::OFFSET, ier::ERRIE);
    assert_eq!(fail_until_bus_off(&mut can), 32);
    assert!(!can.interrupts().status);
}

#[test]
fn bus_off_ends_by_itself_where_asked_to() {
    let mut can = on_bus(mcr::ABOM);
    fail_until_bus_off(&mut can);
    for _ in 0..128 {
        assert_eq!(can.read(esr::OFFSET) & esr::BOFF, esr::BOFF);
        assert!(can.awaits_recessive_bits());
        can.recessive_sequence();
    }
    assert_eq!(can.read(esr::OFFSET) & 7, 0);
    assert_eq!(transmit_errors(&mut can), 0);
    // The frame that failed is still wanted.
    assert_eq!(send_all(&mut can), [Id::Standard(1)]);
}

#[test]
fn bus_off_otherwise_ends_after_initialisation() {
    let mut can = on_bus(0);
    fail_until_bus_off(&mut can);
    for _ in 0..200 {
        can.recessive_sequence();
    }
    assert!(!can.awaits_recessive_bits());
    can.write(mcr::OFFSET, mcr::INRQ);
    can.write(mcr::OFFSET, 0);
    can.recessive_sequence();
    assert_eq!(can.read(msr::OFFSET) & msr::INAK, 0);
    for _ in 0..128 {
        assert_eq!(can.read(esr::OFFSET) & esr::BOFF, esr::BOFF);
        can.recessive_sequence();
    }
    assert_eq!(can.read(esr::OFFSET) & esr::BOFF, 0);
}

#[test]
fn success_pays_errors_back() {
    let mut can = on_bus(0);
    request(&mut can, 0, &standard(1, &[]));
    can.begin().unwrap();
    can.finish(Transmission::BitError);
    can.write(esr::OFFSET, 7 << esr::LEC);
    assert_eq!(can.read(esr::OFFSET) >> esr::LEC & 7, 7);
    send_all(&mut can);
    assert_eq!(can.read(esr::OFFSET), 7 << esr::TEC);
}

#[test]
fn received_frames_are_stored_as_they_came() {
    let mut can = on_bus(0);
    can.receive(&extended(0x18ff_0123, &[1, 2, 3, 4, 5]));
    assert_eq!(can.read(frame::FIFOS), 0x18ff_0123 << 3 | frame::IDE);
    assert_eq!(can.read(frame::FIFOS + 4), 5);
    assert_eq!(can.read(frame::FIFOS + 8), 0x0403_0201);
    assert_eq!(can.read(frame::FIFOS + 12), 0x05);
}

#[test]
fn length_codes_above_eight_pass_both_ways() {
    let long = Frame::from_parts(Id::Standard(1), false, 15, [9; 8]).unwrap();
    let mut can = on_bus(0);
    can.receive(&long);
    assert_eq!(can.read(frame::FIFOS + 4) & 0xf, 15);
    assert_eq!(can.read(frame::FIFOS + 12), 0x0909_0909);
    request(&mut can, 0, &long);
    assert_eq!(can.begin(), Some(long));
}

#[test]
fn a_full_fifo_loses_its_newest_frame() {
    let mut can = on_bus(0);
    for id in 1..=3 {
        assert_eq!(can.receive(&standard(id, &[])), Reception::Stored(0));
    }
    assert_eq!(can.read(rfr::OFFSET_0), 3 | rfr::FULL);
    assert_eq!(can.receive(&standard(4, &[])), Reception::Overrun(0));
    assert_eq!(can.read(rfr::OFFSET_0), 3 | rfr::FULL | rfr::FOVR);
    let left: Vec<u32> = (0..3).map(|_| take(&mut can).0 >> frame::STID).collect();
    assert_eq!(left, [1, 2, 4]);
}

#[test]
fn a_locked_fifo_loses_the_frame_that_comes() {
    let mut can = on_bus(mcr::RFLM);
    for id in 1..=4 {
        can.receive(&standard(id, &[]));
    }
    let left: Vec<u32> = (0..3).map(|_| take(&mut can).0 >> frame::STID).collect();
    assert_eq!(left, [1, 2, 3]);
    can.write(rfr::OFFSET_0, rfr::FULL | rfr::FOVR);
    assert_eq!(can.read(rfr::OFFSET_0), 0);
}

#[test]
fn a_fifo_has_three_interrupts() {
    let mut can = on_bus(0);
    let due = |can: &mut BxCan, enabled| {
        can.write(ier::OFFSET, enabled);
        can.interrupts().receive[0]
    };
    let mut seen = Vec::new();
    for id in 0..=4 {
        seen.push([ier::FMPIE, ier::FFIE, ier::FOVIE].map(|enabled| due(&mut can, enabled)));
        can.receive(&standard(id, &[]));
    }
    let (no, yes) = (false, true);
    assert_eq!(seen, [[no, no, no], [yes, no, no], [yes, no, no], [yes, yes, no], [yes, yes, yes]]);
}

#[test]
fn filters_of_all_four_kinds() {
    // Register values of one bank, whether it is a list, whether it is wide; a frame that passes and one that does not.
    let short = |id: u32| id << 5;
    let wide = |id: u32| id << 21;
    let cases = [
        ("mask 32", [wide(0x120), wide(0x7f0) | frame::IDE], false, true, 0x12f, 0x130),
        ("list 32", [wide(0x123), wide(0x456)], true, true, 0x456, 0x455),
        ("mask 16", [short(0x120) | (short(0x7f0) | 1 << 3) << 16, u32::MAX], false, false, 0x12f, 0x130),
        ("list 16", [short(1) | short(2) << 16, short(3) | short(4) << 16], true, false, 4, 5),
    ];
    for (name, bank, is_list, is_wide, passes, stopped) in cases {
        let mut can = on_bus(0);
        set_filters(&mut can, |can| {
            can.write(filter::FM1R, u32::from(is_list));
            can.write(filter::FS1R, u32::from(is_wide));
            can.write(filter::BANKS, bank[0]);
            can.write(filter::BANKS + 4, bank[1]);
            can.write(filter::FA1R, 1);
        });
        assert_eq!(can.receive(&standard(passes, &[])), Reception::Stored(0), "{name}");
        assert_eq!(can.receive(&standard(stopped, &[])), Reception::Filtered, "{name}");
        assert_eq!(can.receive(&extended(u32::from(passes) << 18, &[])), Reception::Filtered, "{name}");
    }
}

#[test]
fn filters_see_extended_identifiers() {
    let mut can = on_bus(0);
    set_filters(&mut can, |can| {
        can.write(filter::BANKS, 0x18ff_0000 << 3 | frame::IDE);
        can.write(filter::BANKS + 4, 0x1fff_0000 << 3 | frame::IDE);
    });
    assert_eq!(can.receive(&extended(0x18ff_1234, &[])), Reception::Stored(0));
    assert_eq!(can.receive(&extended(0x18fe_1234, &[])), Reception::Filtered);
    set_filters(&mut can, |can| {
        // STID, IDE and EXID[17:15] of the same identifier; RTR is compared too.
        can.write(filter::FS1R, 0);
        let value = 0x18ff_0000 >> 18 << 5 | 1 << 3 | 0x18ff_0000 >> 15 & 7;
        can.write(filter::BANKS, 0xffff_0000 | value);
        can.write(filter::BANKS + 4, u32::MAX);
    });
    assert_eq!(can.receive(&extended(0x18ff_1234, &[])), Reception::Stored(0));
    assert_eq!(can.receive(&extended(0x18fe_0000, &[])), Reception::Filtered);
}

#[test]
fn the_most_particular_filter_is_reported() {
    let mut can = on_bus(0);
    set_filters(&mut can, |can| {
        // 0: mask 16, FIFO 0, filters 0 and 1. 1: not active, list 16, FIFO 0, filters 2 to 5. 2: mask 32, FIFO 0,
        // filter 6. 3: list 32, FIFO 1, filters 0 and 1.
        can.write(filter::FM1R, 0b1010);
        can.write(filter::FS1R, 0b1100);
        can.write(filter::FFA1R, 0b1000);
        can.write(filter::FA1R, 0b1101);
        can.write(filter::BANKS + 8 * 3 + 4, 0x123 << 21);
    });
    assert_eq!(can.receive(&standard(0x123, &[])), Reception::Stored(1));
    assert_eq!(can.read(frame::FIFOS + 16 + 4) >> frame::FMI & 0xff, 1);
    assert_eq!(can.receive(&standard(0x124, &[])), Reception::Stored(0));
    assert_eq!(take(&mut can), (0x124 << 21, 6));
    assert_eq!(stored(&mut can, 1), 1);
}

#[test]
fn banks_of_the_other_controller_do_not_count() {
    let mut can = on_bus(0);
    let set = |can: &mut BxCan, first_foreign: u32| {
        set_filters(can, |can| can.write(filter::FA1R, 1 << 14));
        can.write(filter::FMR, first_foreign << filter::CAN2SB);
    };
    set(&mut can, 14);
    assert_eq!(can.receive(&standard(1, &[])), Reception::Filtered);
    set(&mut can, 15);
    assert_eq!(can.receive(&standard(1, &[])), Reception::Stored(0));
}

#[test]
fn filters_are_set_in_initialisation_only() {
    let mut can = on_bus(0);
    can.write(filter::FM1R, 1);
    can.write(filter::BANKS, 5);
    assert_eq!((can.read(filter::FM1R), can.read(filter::BANKS)), (0, 0));
    can.write(filter::BANKS + 8, 5);
    assert_eq!(can.read(filter::BANKS + 8), 5);
    can.write(filter::FMR, filter::FMR_AFTER_RESET);
    assert_eq!(can.receive(&standard(1, &[])), Reception::Filtered);
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
