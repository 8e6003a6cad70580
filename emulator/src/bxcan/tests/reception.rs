//! Frames on their way in: filters and FIFOs.

use super::*;

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
