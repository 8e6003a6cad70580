//! From the first error to bus-off, and back.

use super::*;

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
