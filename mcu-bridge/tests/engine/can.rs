//! What only happens on the CAN bus.

use crate::world::{World, modbus};
use crate::{LATER, READ, SOON, axes};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::CAN;
use jointbus_mcu_bridge::engine::Action;
use jointbus_protocol::time::Duration;

#[test]
fn a_request_that_nobody_acknowledges_on_can_is_never_sent_late() {
    let mut world = World::new();
    world.acknowledge = false;
    assert_eq!(world.nst(1, &[0x12, 0x01, 0xA7, 24], Duration::from_millis(200)), []);
    let counters = world.engine.counters(CAN);
    assert_eq!((counters.expired, counters.timeouts, counters.sent), (1, 0, 0));
    world.acknowledge = true;
    assert_eq!(world.nst(1, &READ, SOON), axes(1), "the bus is usable again");
}

#[test]
fn after_bus_off_the_controller_returns_later_each_time() {
    let mut world = World::new();
    let mut waited = Vec::new();
    for round in 0..9 {
        let off = world.now;
        world.engine.set_bus_off(CAN, true, off);
        assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], Duration::ZERO), [4, 2, 0, 4], "bus-off now");
        let restart = world.engine.poll_at().unwrap();
        assert_eq!(world.take_actions(), []);
        world.now = restart;
        assert_eq!(world.take_actions(), [Action::RestartCan(CAN)]);
        assert_eq!(world.take_actions(), [], "once");
        waited.push(restart.saturating_duration_since(off).as_micros() / 1000);
        world.engine.set_bus_off(CAN, false, restart);
        if round == 7 {
            assert_eq!(world.nst(1, &READ, SOON), axes(1));
        }
    }
    assert_eq!(waited, [10, 20, 40, 80, 160, 320, 640, 1000, 10], "a frame that was sent ends the row");
    assert_eq!(world.engine.counters(CAN).bus_off, 9);
    assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0]);
}

#[test]
fn a_second_copy_of_a_reply_on_can_answers_nothing_that_is_still_being_sent() {
    let mut world = World::new();
    let reply = |world: &mut World| {
        let body = axes(1);
        for frame in jointbus_protocol::nst::can::segment(1, 127, &body).unwrap() {
            world.engine.receive_frame(CAN, &frame, world.now);
        }
        world.engine.output(Port::HOST).len()
    };
    let length = axes(1).len() + 3;
    for request in 1..=2 {
        world.engine.receive(Port::HOST, &modbus(1, &READ), world.now);
        assert!(world.engine.next_frame(CAN).is_some());
        assert_eq!(reply(&mut world), (request - 1) * length, "nobody has acknowledged the request");
        world.engine.frame_sent(CAN, world.now);
        assert_eq!(reply(&mut world), request * length);
    }
    assert_eq!(world.engine.counters(CAN).foreign_or_late, 2);
}

#[test]
fn a_second_copy_of_a_reply_that_ends_after_the_next_request_is_not_joined() {
    let mut world = World::new();
    let copy: Vec<_> = jointbus_protocol::nst::can::segment(1, 127, &axes(3)).unwrap().collect();
    world.engine.receive(Port::HOST, &modbus(1, &READ), world.now);
    assert!(world.engine.next_frame(CAN).is_some());
    world.engine.receive_frame(CAN, &copy[0], world.now);
    world.engine.frame_sent(CAN, world.now);
    copy[1..].iter().for_each(|frame| world.engine.receive_frame(CAN, frame, world.now));
    assert_eq!(world.engine.output(Port::HOST), []);
    for frame in jointbus_protocol::nst::can::segment(1, 127, &axes(1)).unwrap() {
        world.engine.receive_frame(CAN, &frame, world.now);
    }
    assert_eq!(world.engine.output(Port::HOST), modbus(1, &axes(1)));
}

#[test]
fn a_frame_that_is_acknowledged_while_it_is_given_up_holds_nothing_up() {
    for length in [4usize, 12] {
        let mut world = World::new();
        world.acknowledge = false;
        let data = vec![7; length - 4];
        let request = [&[0x10, 0, 0, data.len() as u8][..], &data].concat();
        world.engine.receive(Port::HOST, &modbus(1, &request), world.now);
        let mut frame = world.engine.next_frame(CAN);
        assert!(frame.take().is_some());
        world.now = world.now.saturating_add(Duration::from_millis(100));
        world.poll();
        assert!(world.aborting, "its time to live has passed");
        // the frame was on the wire, and the last attempt succeeded
        world.engine.frame_sent(CAN, world.now);
        world.acknowledge = true;
        world.pass(LATER);
        let counters = world.engine.counters(CAN);
        let (expired, timeouts) = if length > 8 { (1, 0) } else { (0, 1) };
        assert_eq!((counters.expired, counters.timeouts), (expired, timeouts), "of {length} bytes");
        assert_eq!(world.nst(1, &READ, SOON), axes(1), "the bus is usable again");
    }
}

#[test]
fn a_late_reply_to_a_part_is_given_to_no_other_split_request() {
    let mut world = World::new();
    world.unplugged = vec![CAN];
    // parts of 126 and 24 bytes; the first one is asked for twice
    assert_eq!(world.nst(1, &[0x03, 0, 0, 150], Duration::from_millis(120)), []);
    // the first part of the next one has the same length, and waits until three times the timeout have passed
    let sent = world.engine.counters(CAN).sent;
    assert_eq!(world.nst(1, &[0x03, 0, 0, 200], Duration::from_millis(50)), []);
    assert_eq!(world.engine.counters(CAN).sent, sent);
    world.pass(Duration::from_millis(45));
    assert_eq!(world.engine.counters(CAN).sent, sent + 1);
}

#[test]
fn a_write_whose_later_part_fails_is_silent_and_counted() {
    let mut world = World::new();
    let data = [7; 200];
    let request = [&[0x10, 0, 0, 200][..], &data].concat();
    world.engine.receive(Port::HOST, &modbus(1, &request), world.now);
    let mut frames = 0;
    while world.engine.next_frame(CAN).is_some() {
        world.engine.frame_sent(CAN, world.now);
        frames += 1;
    }
    assert_eq!(frames, 16, "the first part fills a transfer");
    // its acknowledgement
    for frame in jointbus_protocol::nst::can::segment(1, 127, &[0x10, 124]).unwrap() {
        world.engine.receive_frame(CAN, &frame, world.now);
    }
    assert!(world.engine.next_frame(CAN).is_some(), "the second part follows");
    world.engine.frame_sent(CAN, world.now);
    world.unplugged = vec![CAN];
    assert_eq!(world.exchange(&[], LATER), []);
    let counters = world.engine.counters(CAN);
    assert_eq!((counters.timeouts, counters.retries, counters.expired), (1, 0, 0));
}
