//! The configuration that the bridge starts with, and what becomes of what waits when it changes.

use crate::world::{World, modbus};
use crate::{LATER, READ, SOON, axes};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::RS485_A;
use jointbus_mcu_bridge::engine::Action;
use jointbus_protocol::time::Duration;

const APPLY: [u8; 5] = [6, 0, 0, 0xA9, 0x91];
const CONFIRM: [u8; 5] = [6, 0, 0, 0xC0, 0xF1];

/// Holding registers from `first` on.
fn registers(world: &mut World, first: u16, count: u8) -> Vec<u16> {
    let [high, low] = first.to_be_bytes();
    let response = world.modbus(247, &[3, high, low, 0, count], SOON);
    assert_eq!(response[..2], [3, 2 * count]);
    response[2..].chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

#[test]
fn the_bridge_starts_as_the_contract_says() {
    let mut world = World::new();
    // baud / 100 or kbit/s, format, gap, node, flags
    assert_eq!(registers(&mut world, 0x10, 5), [9216, 0x0100, 0, 0, 0], "host: 921600 8N1");
    assert_eq!(registers(&mut world, 0x18, 5), [1152, 0x0100, 0, 0, 0], "rs485-a: 115200 8N1");
    assert_eq!(registers(&mut world, 0x20, 5), [192, 0x0100, 110, 0, 0], "rs485-b: 19200 8N1, 11 ms");
    assert_eq!(registers(&mut world, 0x28, 5), [1000, 0x0100, 0, 127, 0], "CAN: 1 Mbit/s, node 127");
    assert_eq!(registers(&mut world, 0x40, 4), [3, 1000, 0, 200], "quarantine, probes, host silence, burst");
    assert_eq!(registers(&mut world, 0x50, 16), [0; 16], "no slot is on");
    // units, bus, protocol, remote address, timeouts, retries, time to live, hold-off, flags
    for (row, expected) in [
        [1, 15, 3, 3, 1, 50, 500, 1, 100, 0, 0],
        [16, 30, 1, 2, 1, 50, 500, 1, 100, 0, 0],
        [31, 31, 4, 0, 31, 200, 500, 1, 1000, 0, 0],
        [32, 39, 2, 0, 1, 200, 500, 1, 1000, 0, 0],
        [40, 40, 5, 0, 40, 200, 500, 1, 1000, 0, 0],
        [247, 247, 6, 0, 247, 200, 500, 1, 1000, 0, 0],
    ]
    .into_iter()
    .enumerate()
    {
        assert_eq!(registers(&mut world, 0x100 + 0x10 * row as u16, 11), expected, "route {row}");
    }
    for row in 6..16 {
        assert_eq!(registers(&mut world, 0x100 + 0x10 * row, 5), [0; 5], "route {row} is unused");
    }
}

#[test]
fn the_first_route_that_matches_wins() {
    let mut world = World::new();
    // route 6 leads unit 16 to CAN node 1: the second row has it already
    let row = [16, 1, 0x60, 0, 5, 10, 0, 16, 0, 16, 0, 3, 0, 3, 0, 1];
    for request in [&row[..], &APPLY, &CONFIRM] {
        world.modbus(247, request, SOON);
    }
    assert_eq!(world.nst(16, &READ, SOON), axes(2), "by the second row");
    // the same in the first row
    let row = [16, 1, 0x00, 0, 5, 10, 0, 16, 0, 16, 0, 3, 0, 3, 0, 1];
    for request in [&row[..], &APPLY, &CONFIRM] {
        world.modbus(247, request, SOON);
    }
    assert_eq!(world.nst(16, &READ, SOON), axes(1), "by the first row");
    assert_eq!(world.nst(1, &READ, SOON), [], "nobody leads there any more");
}

#[test]
fn applying_again_starts_the_ten_seconds_again_and_leads_back_to_what_was_confirmed() {
    let mut world = World::new();
    let timeout = |millis: u8| [6, 1, 0x15, 0, millis];
    for millis in [70, 80] {
        assert_eq!(world.modbus(247, &timeout(millis), SOON), timeout(millis));
        assert_eq!(world.modbus(247, &APPLY, Duration::from_millis(6000)), APPLY);
    }
    assert_eq!(registers(&mut world, 0x115, 1), [80], "twelve seconds after the first one");
    world.pass(Duration::from_millis(4500));
    assert_eq!(registers(&mut world, 0x115, 1), [50], "as it was confirmed, live and staged");
    world.unplugged = vec![RS485_A];
    world.nst(16, &READ, Duration::from_millis(103));
    assert_eq!(world.engine.counters(RS485_A).timeouts, 1);
}

#[test]
fn a_row_that_is_not_used_touches_no_bus() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    world.engine.receive(Port::HOST, &modbus(16, &READ), world.now);
    world.pass(Duration::from_millis(20));
    // its target is the bus on which the read is in flight
    let target = [6, 1, 0xA2, 0, 1];
    assert_eq!(world.modbus(247, &target, Duration::ZERO), target);
    assert_eq!(world.exchange(&modbus(247, &APPLY), Duration::ZERO), modbus(247, &APPLY));
    let (port, reply) = world.held_back.take().unwrap().remove(0);
    world.engine.receive(port, &reply, world.now);
    assert_eq!(world.exchange(&[], SOON), modbus(16, &axes(2)));
}

#[test]
fn what_waits_on_a_route_that_changes_is_told_and_the_other_buses_go_on() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    let reads =
        |first: u8| (0..3).flat_map(|index| modbus(32, &[4, 0, first + index, 0, 1])).collect::<Vec<_>>();
    world.engine.receive(Port::HOST, &reads(0x40), world.now);
    world.engine.receive(Port::HOST, &modbus(16, &READ), world.now);
    world.pass(Duration::from_millis(20));
    assert_eq!(world.modbus(247, &[6, 1, 0x35, 0, 99], Duration::ZERO), [6, 1, 0x35, 0, 99]);
    let told = world.exchange(&modbus(247, &APPLY), Duration::ZERO);
    let refused = modbus(32, &[0x84, 0x0B]).repeat(3);
    assert_eq!(told, [modbus(247, &APPLY), refused].concat(), "one in flight, two that waited");
    // the sensor's answer comes, and belongs to its request as ever
    let mut held_back = world.held_back.take().unwrap().into_iter();
    let (port, reply) = held_back.find(|(port, _)| *port == RS485_A).unwrap();
    world.engine.receive(port, &reply, world.now);
    assert_eq!(world.exchange(&[], SOON), modbus(16, &axes(2)));
}

#[test]
fn a_route_that_changes_is_out_of_quarantine() {
    let mut world = World::new();
    world.unplugged = vec![RS485_A];
    for _ in 0..3 {
        world.nst(16, &READ, LATER);
    }
    assert_eq!(world.modbus(247, &[4, 2, 4, 0, 1], SOON), [4, 2, 0, 1]);
    for request in [[6, 1, 0x15, 0, 99], APPLY, CONFIRM] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    assert_eq!(world.modbus(247, &[4, 2, 4, 0, 1], SOON), [4, 2, 0, 0]);
}

#[test]
fn defaults_are_staged_and_what_needs_no_apply_acts_at_once() {
    let mut world = World::new();
    for request in [[6, 1, 0x15, 0, 77], APPLY, CONFIRM, [6, 0, 0x41, 0, 99], [6, 0, 0x51, 0, 50]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    let defaults = [6, 0, 0, 0xDE, 0xFA];
    assert_eq!(world.modbus(247, &defaults, SOON), defaults);
    assert_eq!(registers(&mut world, 0x115, 1), [50], "staged");
    assert_eq!((registers(&mut world, 0x41, 1)[0], registers(&mut world, 0x51, 1)[0]), (1000, 0));
    world.unplugged = vec![RS485_A];
    world.nst(16, &READ, Duration::from_millis(70));
    assert_eq!(world.engine.counters(RS485_A).timeouts, 0, "live are still the 77 ms");
    world.pass(LATER);
    assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0], "nothing waits for confirmation");
}

#[test]
fn the_reboot_command_is_answered_and_handed_to_the_firmware_once() {
    let mut world = World::new();
    let reboot = [6, 0, 0, 0xB0, 0x07];
    assert_eq!(world.modbus(247, &reboot, SOON), reboot);
    assert_eq!(world.take_actions(), [Action::Reboot]);
    assert_eq!(world.take_actions(), []);
}
