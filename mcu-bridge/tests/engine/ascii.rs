//! A route that speaks Modbus ASCII, while the host goes on in RTU.

use crate::world::{World, modbus};
use crate::{LATER, SOON};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::RS485_B;
use jointbus_protocol::modbus::ascii;
use jointbus_protocol::time::Duration;

/// A bridge whose route 3, units 32 to 39, speaks ASCII.
fn world() -> World {
    let mut world = World::new();
    for request in [[6, 1, 0x33, 0, 1], [6, 0, 0, 0xA9, 0x91], [6, 0, 0, 0xC0, 0xF1]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    world
}

#[test]
fn the_station_is_read_and_written_in_ascii() {
    let mut world = world();
    world.station.modules()[0].analog_inputs = [0xAB12; 16];
    assert_eq!(world.modbus(32, &[4, 0, 0x40, 0, 2], SOON), [4, 4, 0xAB, 0x12, 0xAB, 0x12]);
    assert_eq!(world.sent[0].2, b":010400400002B9\r\n");
    assert_eq!(world.modbus(32, &[5, 2, 3, 0xFF, 0], SOON), [5, 2, 3, 0xFF, 0]);
    assert_eq!(world.modbus(32, &[4, 0xFF, 0, 0, 2], SOON), [0x84, 2], "an exception");
    let long = [&[16, 0, 0, 0, 123, 246][..], &[0x5A; 246]].concat();
    assert_eq!(world.modbus(32, &long, SOON), [0x90, 3], "longer than what is spelt out at once");
    assert_eq!(world.sent[3].2.len(), ascii::FRAME_MAX - 2);
    let counters = world.engine.counters(RS485_B);
    assert_eq!((counters.sent, counters.received, counters.foreign_or_late), (4, 4, 0));
}

#[test]
fn an_unknown_function_code_needs_no_silence_in_ascii() {
    let mut world = world();
    assert_eq!(world.modbus(32, &[0x41, 1, 2, 3], SOON), [0xC1, 1]);
    assert_eq!(world.sent[0].2, b":0141010203B8\r\n");
}

#[test]
fn broadcasts_go_out_in_ascii() {
    let mut world = world();
    assert_eq!(world.exchange(&modbus(0, &[5, 2, 3, 0xFF, 0]), SOON), []);
    let on_port =
        |port| world.sent.iter().find(|(_, other, _)| *other == port).map(|(_, _, frame)| &frame[..]);
    assert_eq!(on_port(RS485_B), Some(&b":00050203FF00F7\r\n"[..]));
    assert!(world.station.modules()[0].outputs & 0b1000 != 0);
}

#[test]
fn what_is_no_reply_in_ascii_is_counted_and_the_wait_goes_on() {
    let mut world = world();
    world.held_back = Some(Vec::new());
    world.engine.receive(Port::HOST, &modbus(32, &[4, 0, 0x40, 0, 1]), world.now);
    world.pass(Duration::from_millis(20));
    let (port, reply) = world.held_back.take().unwrap().remove(0);
    let others: [&[u8]; 5] =
        [b"noise", b":0204021234B2\r\n", b":010402123\r\n", b":0104021234B2\r\n", &reply[..7]];
    for other in others {
        world.engine.receive(port, other, world.now);
        assert_eq!(world.engine.output(Port::HOST), []);
    }
    world.engine.receive(port, &reply, world.now);
    assert_eq!(world.exchange(&[], SOON), modbus(32, &[4, 2, 0, 0]));
    let counters = world.engine.counters(RS485_B);
    assert_eq!(counters.foreign_or_late, 4, "unit, length, LRC, and one that began twice");
    assert_eq!((counters.received, counters.timeouts), (2, 0));
}

#[test]
fn a_late_reply_in_ascii_is_given_to_no_other_request() {
    let mut world = world();
    world.held_back = Some(Vec::new());
    world.station.modules()[0].analog_inputs = [0x1111; 16];
    assert_eq!(world.modbus(32, &[4, 0, 0x40, 0, 1], Duration::from_millis(600)), [0x84, 0x0B]);
    let late = world.held_back.take().unwrap();
    world.station.modules()[0].analog_inputs = [0x2222; 16];
    world.engine.receive(Port::HOST, &modbus(32, &[4, 0, 0x41, 0, 1]), world.now);
    for (port, reply) in late {
        world.pass(Duration::from_millis(15));
        world.engine.receive(port, &reply, world.now);
    }
    assert_eq!(world.exchange(&[], SOON), modbus(32, &[4, 2, 0x22, 0x22]));
}

#[test]
fn a_port_that_hears_itself_drops_its_echo_in_ascii() {
    let mut world = world();
    for request in [[6, 0, 0x24, 0, 1], [6, 0, 0, 0xA9, 0x91], [6, 0, 0, 0xC0, 0xF1]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    let request = [5, 2, 3, 0xFF, 0];
    world.echo = Some(Vec::new());
    assert_eq!(world.modbus(32, &request, SOON), request);
    world.unplugged = vec![RS485_B];
    assert_eq!(world.modbus(32, &request, LATER), [0x85, 0x0B], "an echo is no answer");
    assert_eq!(world.engine.counters(RS485_B).transmit_errors, 0);
    world.echo = Some(vec![0x55; 17]);
    world.modbus(32, &request, LATER);
    assert_eq!(world.engine.counters(RS485_B).transmit_errors, 1);
}
