//! The bridge itself: its registers, its polling and its own outputs.

use crate::world::{SAMPLE, World, modbus};
use crate::{LATER, READ, SOON, axes};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, RS485_A};
use jointbus_mcu_bridge::engine::{Action, STORED_LENGTH, Settings};
use jointbus_protocol::time::Duration;

#[test]
fn unit_247_tells_about_the_bridge() {
    let mut world = World::new();
    world.nst(1, &READ, SOON);
    let expected = world.now.as_micros().to_be_bytes();
    let head = world.modbus(247, &[4, 0, 0, 0, 10], SOON);
    assert_eq!(head[2..10], [0, 1, 0, 1, 0, 2, 0, 3]);
    assert_eq!(head[10..18], expected);
    assert_eq!(head[18..], [0, 1, 0, 0], "power-on, healthy");
    let can = world.modbus(247, &[4, 0, 0x80, 0, 24], SOON);
    assert_eq!(can[2..10], [0, 0, 0, 3, 0, 0, 0, 1], "three frames received, one sent");
    let times = world.modbus(247, &[4, 2, 0, 0, 3], SOON);
    assert_eq!(times[2..], [0, 0, 0, 39, 0, 39], "three frames of 130 us");
    assert_eq!(world.modbus(247, &[4, 3, 0, 0, 1], SOON), [0x84, 2]);
    assert_eq!(world.modbus(247, &[6, 0, 0, 0xC1, 0xEA], SOON), [6, 0, 0, 0xC1, 0xEA]);
    assert_eq!(world.engine.counters(CAN).received, 0);
    assert_eq!(world.modbus(247, &[6, 0, 0, 0, 1], SOON), [0x86, 3], "no such command");
}

#[test]
fn unit_247_answers_diagnostics_and_tells_what_it_is() {
    let mut world = World::new();
    assert_eq!(world.modbus(247, &[8, 0, 0, 0xA5, 0x37], SOON), [8, 0, 0, 0xA5, 0x37], "loopback");
    assert_eq!(world.modbus(247, &[6, 0, 0, 0, 1], SOON), [0x86, 3]);
    let mut broken = modbus(247, &[4, 0, 0, 0, 1]);
    broken[3] ^= 1;
    world.exchange(&broken, SOON);
    for (what, count) in [(0x0B, 3), (0x0C, 1), (0x0D, 1), (0x0E, 6), (0x0F, 0), (0x12, 0)] {
        assert_eq!(world.modbus(247, &[8, 0, what, 0, 0], SOON), [8, 0, what, 0, count], "{what:#x}");
    }
    assert_eq!(world.modbus(247, &[8, 0, 0x0A, 0, 0], SOON), [8, 0, 0x0A, 0, 0]);
    assert_eq!(world.modbus(247, &[8, 0, 0x0C, 0, 0], SOON), [8, 0, 0x0C, 0, 0], "cleared");
    assert_eq!(world.modbus(247, &[8, 0, 0x01, 0, 0], SOON), [0x88, 1]);
    assert_eq!(world.modbus(247, &[17], SOON), b"\x11\x0A\xF7\xFFjointbus");
    let basic = world.modbus(247, &[0x2B, 0x0E, 1, 0], SOON);
    assert_eq!(basic[..7], [0x2B, 0x0E, 1, 0x82, 0, 0, 3]);
    assert!(basic.ends_with(env!("CARGO_PKG_VERSION").as_bytes()));
    assert_eq!(world.modbus(247, &[0x2B, 0x0E, 4, 4], SOON), b"\x2B\x0E\x04\x82\x00\x00\x01\x04\x08Jointbus");
    assert_eq!(world.modbus(247, &[1, 0, 0, 0, 1], SOON), [0x81, 1]);
}

#[test]
fn polling_slots_read_on_time_beside_the_host() {
    let mut world = World::new();
    // slot 0: unit 1 each 10 ms; slot 3: unit 16 each 20 ms
    let slots = [16, 0, 0x50, 0, 8, 16, 0, 1, 0, 100, 0, 0, 0, 0, 0, 0, 0, 0, 0, 16, 0, 200];
    assert_eq!(world.modbus(247, &slots, Duration::ZERO), [16, 0, 0x50, 0, 8]);
    world.pass(Duration::from_millis(100));
    assert_eq!(world.nst(1, &READ, Duration::from_millis(50)), axes(1), "the host is served as well");
    let sample = |factor: i32| SAMPLE.0.map(|axis| (axis * factor).to_be_bytes()).concat();
    let (start, slot) = (world.now, *world.engine.slot(0).unwrap());
    assert!((15..=16).contains(&slot.sequence), "{slot:?}");
    assert_eq!((slot.missed, slot.failures), (0, 0));
    assert!(start.saturating_duration_since(slot.timestamp) < Duration::from_millis(11));
    let block = world.modbus(247, &[4, 1, 0, 0, 24], Duration::ZERO);
    let fields = [
        &[4, 48, 0, 2, 0, 1][..],
        &slot.sequence.to_be_bytes(),
        &slot.timestamp.as_micros().to_be_bytes(),
        &[0; 8],
    ];
    assert_eq!(block, [fields.concat(), sample(1)].concat());
    let block = world.modbus(247, &[4, 1, 0x60, 0, 24], Duration::ZERO);
    assert_eq!(block[2..6], [0, 2, 0, 16]);
    assert_eq!(block[26..], sample(2));

    world.unplugged = vec![CAN];
    world.pass(Duration::from_millis(300));
    let slot = *world.engine.slot(0).unwrap();
    assert!(slot.failures >= 2 && slot.missed > 10, "{slot:?}");
    assert_eq!(world.modbus(247, &[4, 1, 0, 0, 1], Duration::ZERO), [4, 2, 0, 3], "stale");
    let before = world.engine.slot(3).unwrap().sequence;
    world.unplugged.clear();
    world.pass(Duration::from_millis(1100));
    assert_eq!(world.modbus(247, &[4, 1, 0, 0, 1], Duration::ZERO), [4, 2, 0, 2], "fresh after a probe");
    let after = world.engine.slot(3).unwrap();
    assert!((54..=56).contains(&(after.sequence - before)), "the other bus keeps its rate");
    assert_eq!((after.missed, after.failures), (0, 0));

    assert_eq!(world.modbus(247, &[6, 0, 0x51, 0, 0], Duration::ZERO), [6, 0, 0x51, 0, 0]);
    assert_eq!(world.modbus(247, &[4, 1, 0, 0, 4], SOON), [4, 8, 0, 0, 0, 1, 0, 0, 0, 0], "off");
}

#[test]
fn a_configuration_is_staged_applied_and_confirmed_or_rolled_back() {
    let mut world = World::new();
    let (timeout, apply, confirm) = ([6, 1, 0x15, 0x03, 0xE8], [6, 0, 0, 0xA9, 0x91], [6, 0, 0, 0xC0, 0xF1]);
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 4], SOON), [3, 8, 0, 50, 1, 0xF4, 0, 1, 0, 100]);
    assert_eq!(world.modbus(247, &timeout, SOON), timeout);
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0x03, 0xE8]);
    world.unplugged = vec![RS485_A];
    world.nst(16, &READ, LATER);
    assert_eq!(world.engine.counters(RS485_A).timeouts, 2, "staged is not live");
    assert_eq!(world.modbus(247, &apply, SOON), apply);
    assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0x10], "unconfirmed");
    world.nst(16, &READ, Duration::from_millis(900));
    assert_eq!(world.engine.counters(RS485_A).timeouts, 2, "a second has not passed");
    world.pass(Duration::from_millis(10_000));
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0, 50], "rolled back");
    for request in [timeout, apply, confirm] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    world.pass(Duration::from_millis(20_000));
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0x03, 0xE8], "confirmed");
}

#[test]
fn a_port_that_has_changed_is_told_once() {
    for (port, number) in BOARD.ports().zip(0..) {
        let mut world = World::new();
        let write = [6, 0, 0x13 + 8 * number, 0, 9];
        for request in [write, [6, 0, 0, 0xA9, 0x91]] {
            assert_eq!(world.take_actions(), []);
            assert_eq!(world.modbus(247, &request, SOON), request);
        }
        assert_eq!(world.take_actions(), [Action::Configure(port)]);
        assert_eq!(world.engine.port(port).unwrap().node, 9);
        assert_eq!(world.take_actions(), []);
    }
}

#[test]
fn what_is_confirmed_is_saved_and_restored() {
    let save = [6, 0, 0, 0x5A, 0x7E];
    let mut world = World::new();
    for request in [[6, 1, 0x15, 0, 77], [6, 0, 0, 0xA9, 0x91], [6, 0, 0, 0xC0, 0xF1], [6, 1, 0x15, 0, 88]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    assert_eq!(world.modbus(247, &[6, 0, 0x41, 0, 99], SOON), [6, 0, 0x41, 0, 99]);
    assert_eq!(world.modbus(247, &[6, 0, 0x55, 0, 5], SOON), [6, 0, 0x55, 0, 5]);
    assert_eq!(world.modbus(247, &save, SOON), [], "answered when it is done");
    assert_eq!(world.modbus(247, &save, SOON), [0x86, 6], "one at a time");
    assert_eq!(world.take_actions(), [Action::Store]);
    let mut stored = [0; STORED_LENGTH];
    world.engine.encode_settings(&mut stored);
    assert_eq!(world.take_actions(), [], "asked once");
    world.engine.saved(true);
    assert_eq!(world.exchange(&[], SOON), modbus(247, &save));

    let mut other = World::new();
    other.engine.restore(&Settings::decode(&stored, BOARD).unwrap(), other.now);
    assert_eq!(other.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0, 77], "confirmed, not staged");
    assert_eq!(other.modbus(247, &[3, 0, 0x41, 0, 1], SOON), [3, 2, 0, 99]);
    assert_eq!(other.modbus(247, &[3, 0, 0x55, 0, 1], SOON), [3, 2, 0, 5]);
    assert_eq!(other.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0]);
    assert_eq!(other.modbus(247, &save, SOON), []);
    assert_eq!(other.take_actions(), [Action::Store]);
    other.engine.saved(false);
    assert_eq!(other.exchange(&[], SOON), modbus(247, &[0x86, 4]), "the store failed");
}

#[test]
fn a_configuration_that_does_not_fit_is_refused() {
    let mut world = World::new();
    let apply = [6, 0, 0, 0xA9, 0x91];
    assert_eq!(world.modbus(247, &[16, 1, 0x50, 0, 2, 4, 0, 0, 0, 0], SOON), [16, 1, 0x50, 0, 2]);
    assert_eq!(world.modbus(247, &apply, SOON), [0x86, 3], "no route to the bridge itself");
    assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0]);
    assert_eq!(world.modbus(247, &[6, 0, 0, 0xDE, 0xFA], SOON), [6, 0, 0, 0xDE, 0xFA]);
    assert_eq!(world.modbus(247, &apply, SOON), apply);
    for (request, exception) in [
        (&[6, 1, 0x15, 0, 0][..], 3),
        (&[6, 1, 0x17, 0, 10], 3),
        (&[6, 1, 0x1B, 0, 0], 2),
        (&[6, 0, 0x60, 0, 1], 2),
        (&[6, 0, 0x50, 1, 0], 3),
        (&[16, 1, 0x15, 0, 2, 4, 0, 7, 0, 0], 3),
        (&[16, 1, 0x15, 0, 2, 2, 0, 7], 3),
    ] {
        assert_eq!(world.modbus(247, request, SOON), [request[0] | 0x80, exception], "{request:02x?}");
    }
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0, 50], "all or nothing");
}

#[test]
fn a_route_may_refuse_writes() {
    let mut world = World::new();
    for request in [[6, 1, 0x3A, 0, 1], [6, 1, 0x0A, 0, 1], [6, 0, 0, 0xA9, 0x91]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    assert_eq!(world.modbus(32, &[6, 0, 0x60, 6, 0], SOON), [0x86, 1]);
    assert_eq!(world.nst(1, &[0x12, 0x01, 0xA7, 24], SOON), []);
    assert_eq!(world.nst(1, &READ, SOON), axes(1));
    assert_eq!(world.engine.counters(Port::HOST).refused, 2);
}

#[test]
fn host_silence_switches_the_local_outputs_off() {
    let mut world = World::new();
    world.engine.units_mut().1.set_inputs(0, [0; 4]);
    let limit = [6, 0, 0x42, 0, 100];
    assert_eq!(world.modbus(247, &limit, SOON), limit);
    world.modbus(31, &[16, 0, 4, 0, 4, 8, 0, 0, 0x40, 0x20, 0, 1, 0, 0], SOON);
    let on = [5, 2, 0, 0xFF, 0];
    assert_eq!(world.modbus(40, &on, SOON), on);
    world.pass(Duration::from_millis(200));
    assert!(!world.engine.units().0.settings().channels[0].output);
    assert_eq!(world.engine.units().0.settings().channels[0].set_value, 2.5, "set values stay");
    assert_eq!(world.engine.units().1.digital_outputs(), 0);
    let on = world.modbus(31, &[16, 0, 6, 0, 2, 4, 0, 1, 0, 0], SOON);
    assert_eq!(on, [16, 0, 6, 0, 2], "only the host switches on again");
    assert!(world.engine.units().0.settings().channels[0].output);
}
