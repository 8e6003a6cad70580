//! RequestFraming and the devices that they reach.

use crate::world::{World, modbus};
use crate::{LATER, READ, SOON, axes};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{CAN, RS485_B};

#[test]
fn two_sensors_with_the_same_address_are_told_apart() {
    let mut world = World::new();
    assert_eq!(world.nst(1, &READ, SOON), axes(1), "node 1 on CAN");
    assert_eq!(world.nst(16, &READ, SOON), axes(2), "address 1 on rs485-a");
}

#[test]
fn a_read_reply_with_function_code_0x10_is_taken_and_counted() {
    let mut world = World::new();
    world.quirk = true;
    assert_eq!(world.nst(1, &READ, SOON), axes(1));
    assert_eq!(world.engine.legacy_codes(), 1);
}

#[test]
fn long_reads_over_can_are_split_and_joined() {
    let mut world = World::new();
    let system: Vec<u8> = (0..0xE3).collect();
    world.can_daq.hardware().settings.write(0, &system).unwrap();
    for length in [126, 127, 200, 249] {
        let reply = world.nst(1, &[0x03, 0, 0, length], SOON);
        assert_eq!(reply[..2], [0x03, length]);
        assert_eq!(
            reply[2..],
            world.can_daq.hardware().settings.as_bytes()[..length.into()],
            "{length} bytes"
        );
    }
    assert_eq!(world.engine.counters(CAN).sent, 1 + 3 * 2, "a frame a part");
}

#[test]
fn long_writes_over_can_are_split() {
    let mut world = World::new();
    for length in [124u8, 125, 249] {
        let data: Vec<u8> = (0..length).map(|index| index ^ length).collect();
        let first = 0x00E3 - 0x00E0;
        let body = [&[0x10, 0, first, length][..], &data].concat();
        assert_eq!(world.nst(1, &body, SOON), [0x10, length]);
        let start = usize::from(first);
        assert_eq!(world.can_daq.hardware().settings.as_bytes()[start..start + data.len()], data);
    }
}

#[test]
fn commands_pass_to_both_buses() {
    let mut world = World::new();
    assert_eq!(world.nst(1, &[0x12, 0x01, 0xA7, 24], SOON), [0x12, 24]);
    assert_eq!(world.nst(16, &[0x19, 0x01, 0xA7, 24], SOON), [0x19, 24]);
    assert_eq!(world.nst(1, &[0x18, 0, 0, 1], SOON), [0x18, 1]);
    assert_eq!(world.can_daq.sample().0, [0; 6], "zeroed by the sample of that moment");
}

#[test]
fn the_station_is_read_and_written() {
    let mut world = World::new();
    world.station.modules()[0].analog_inputs[1] = 0x1234;
    assert_eq!(world.modbus(32, &[4, 0, 0x40, 0, 2], SOON), [4, 4, 0, 0, 0x12, 0x34]);
    assert_eq!(world.modbus(32, &[5, 2, 3, 0xFF, 0], SOON), [5, 2, 3, 0xFF, 0]);
    assert_eq!(world.station.modules()[0].outputs, 8);
    assert_eq!(world.modbus(32, &[6, 0, 0x60, 6, 0], SOON), [6, 0, 0x60, 6, 0]);
    assert_eq!(world.modbus(32, &[3, 0, 0x99, 0, 1], SOON), [0x83, 2], "the station's own exception");
}

#[test]
fn an_unknown_function_code_is_delimited_by_silence_and_forwarded() {
    let mut world = World::new();
    assert_eq!(world.modbus(32, &[0x41, 1, 2, 3], LATER), [0xC1, 1]);
    assert_eq!(world.sent[0].2, modbus(1, &[0x41, 1, 2, 3]));
}

#[test]
fn noise_in_place_of_an_open_reply_wakes_the_bridge_once() {
    let mut world = World::new();
    world.unplugged = vec![RS485_B];
    assert_eq!(world.modbus(32, &[0x41, 1, 2, 3], SOON), []);
    assert_eq!(world.sent.len(), 1);
    world.engine.receive(RS485_B, &[0xDE; 13], world.now);
    let pause = world.engine.poll_at().expect("silence ends it");
    world.now = pause;
    world.poll();
    let next = world.engine.poll_at().expect("the timeout");
    assert!(next > pause, "due at {pause:?}, and at {next:?} again");
    assert_eq!(world.engine.counters(RS485_B).foreign_or_late, 1);
    assert_eq!(world.exchange(&[], LATER), modbus(32, &[0xC1, 0x0B]));
}

#[test]
fn the_boards_own_units_answer() {
    let mut world = World::new();
    assert_eq!(world.modbus(31, &[16, 0, 4, 0, 4, 8, 0, 0, 0x40, 0x20, 0, 1, 0, 0], SOON), [16, 0, 4, 0, 4]);
    assert_eq!(world.modbus(31, &[3, 0, 4, 0, 4], SOON), [3, 8, 0, 0, 0x40, 0x20, 0, 1, 0, 0]);
    assert_eq!(world.engine.units().0.settings().channels[0].set_value, 2.5);
    assert!(world.engine.units().0.settings().channels[0].output);
    assert_eq!(world.modbus(40, &[4, 0, 0, 0, 1], SOON), [0x84, 4], "not measured yet");
    world.engine.units_mut().1.set_inputs(0x00A5, [1, 2, 3, 4]);
    assert_eq!(world.modbus(40, &[4, 0, 0, 0, 1], SOON), [4, 2, 0, 0xA5]);
    assert_eq!(world.modbus(40, &[4, 0, 0x43, 0, 1], SOON), [4, 2, 0, 4]);
    assert_eq!(world.modbus(40, &[5, 2, 0, 0xFF, 0], SOON), [5, 2, 0, 0xFF, 0]);
    assert_eq!(world.engine.units().1.digital_outputs(), 1);
    world.engine.units_mut().1.set_inputs(0x005A, None);
    assert_eq!(world.modbus(40, &[4, 0, 0x40, 0, 1], SOON), [0x84, 4], "not measured any more");
    assert_eq!(world.modbus(40, &[4, 0, 0, 0, 1], SOON), [4, 2, 0, 0x5A]);
}

#[test]
fn broadcasts_reach_their_buses_and_are_never_answered() {
    let mut world = World::new();
    world.engine.units_mut().1.set_inputs(0, [0; 4]);
    assert_eq!(world.exchange(&modbus(0, &[5, 2, 0, 0xFF, 0]), SOON), []);
    assert_eq!(world.station.modules()[0].outputs, 1);
    assert_eq!(world.engine.units().1.digital_outputs(), 1);
    assert_eq!(world.exchange(&modbus(0, &[3, 0, 0, 0, 1]), SOON), []);
    assert_eq!(world.engine.counters(Port::HOST).refused, 1, "reads are no broadcasts");
    assert_eq!(world.exchange(&modbus(255, &[0x12, 0x01, 0xA7, 24]), SOON), []);
    assert_eq!(world.sent.last().unwrap().2, modbus(255, &[0x12, 0x01, 0xA7, 24]));
    world.serial_daq.restart();
    assert_eq!(world.serial_daq.sample().0, [0; 6]);
    assert_eq!(world.exchange(&modbus(255, &[16, 0, 6, 0, 2, 4, 0, 1, 0, 0]), SOON), []);
    assert!(world.engine.units().0.settings().channels[0].output);
}

#[test]
fn unknown_units_and_broken_frames_end_with_silence() {
    let mut world = World::new();
    assert_eq!(world.exchange(&modbus(99, &[3, 0, 0, 0, 1]), SOON), []);
    assert_eq!(world.engine.counters(Port::HOST).refused, 1);
    let mut broken = modbus(32, &[4, 0, 0x40, 0, 1]);
    broken[3] ^= 1;
    let good = modbus(32, &[4, 0, 0x40, 0, 1]);
    assert_eq!(world.exchange(&[broken, good.clone()].concat(), SOON), [], "not without silence");
    let counters = world.engine.counters(Port::HOST);
    assert_eq!((counters.checksum_errors, counters.dropped_bursts, counters.refused), (1, 1, 1));
    assert_eq!(
        world.exchange(&[&[0x20][..], &good].concat(), SOON),
        modbus(32, &[4, 2, 0, 0]),
        "a stray byte"
    );
    assert_eq!(world.exchange(&modbus(16, &[0x04, 0, 0, 1]), SOON), [], "no function code of NST");
    assert!(world.sent.iter().all(|(_, port, _)| *port == RS485_B));
}

#[test]
fn an_unknown_function_code_counts_as_a_write() {
    let mut world = World::new();
    world.unplugged = vec![RS485_B];
    assert_eq!(world.modbus(32, &[0x41, 1, 2, 3], LATER), [0xC1, 0x0B]);
    assert_eq!(world.sent.len(), 1, "it is not retried");
    for request in [[6, 1, 0x3A, 0, 1], [6, 0, 0, 0xA9, 0x91]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    assert_eq!(world.modbus(32, &[0x41, 1, 2, 3], LATER), [0xC1, 1], "and refused where writes are");
}

#[test]
fn requests_to_a_bus_are_forwarded_unjudged() {
    let mut world = World::new();
    for pdu in [
        &[4, 0, 0x40, 0, 0][..],
        &[3, 0xFF, 0xFF, 0xFF, 0xFF],
        &[5, 2, 0, 0x12, 0x34],
        &[8, 0, 0, 0xA5, 0x37],
        &[16, 0, 0x60, 0, 9, 2, 1, 2],
    ] {
        let answer = world.modbus(32, pdu, SOON);
        assert_eq!(answer[0], pdu[0] | 0x80, "the station judges {pdu:02x?}");
        assert_eq!(world.sent.last().unwrap().2, modbus(1, pdu));
    }
    assert_eq!(world.sent.len(), 5);
    // no NST register has these addresses, and the sensor says so with silence
    let nowhere = [0x03, 0xFF, 0x00, 0x02];
    assert_eq!(world.nst(16, &nowhere, SOON), []);
    assert_eq!(world.sent.last().unwrap().2, modbus(1, &nowhere));
}
