//! Frames on their way out.

use super::*;

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
