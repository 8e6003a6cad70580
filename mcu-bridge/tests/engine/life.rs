//! A request's life: queue, time to live, timeout, whose reply it is, quarantine.

use crate::world::{World, modbus};
use crate::{LATER, READ, SOON, axes};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{CAN, RS485_A, RS485_B};
use jointbus_protocol::modbus::rtu;
use jointbus_protocol::time::Duration;

#[test]
fn the_station_gets_its_silence_between_frames() {
    let mut world = World::new();
    let read = modbus(32, &[4, 0, 0x40, 0, 2]);
    let replies = world.exchange(&[read.clone(), read].concat(), LATER);
    assert_eq!(replies.len(), 2 * 9);
    let [(first, ..), (second, _, frame)] = &world.sent[..] else { panic!("{:?}", world.sent) };
    let quiet = second.saturating_duration_since(*first).as_micros() - 9 * 87 - frame.len() as u64 * 87;
    assert!(quiet >= 11_000, "{quiet} us");
}

#[test]
fn an_unplugged_device_is_told_in_time_and_comes_back() {
    let mut world = World::new();
    world.unplugged = vec![RS485_A, RS485_B, CAN];
    let read = [4, 0, 0x40, 0, 1];
    assert_eq!(world.modbus(32, &read, Duration::from_millis(390)), []);
    world.pass(Duration::from_millis(100));
    assert_eq!(world.exchange(&[], Duration::ZERO), modbus(32, &[0x84, 0x0B]), "after the retry");
    assert_eq!(world.nst(16, &READ, LATER), []);
    assert_eq!(world.nst(1, &READ, LATER), []);
    for (port, timeouts) in [(RS485_A, 2), (RS485_B, 2), (CAN, 2)] {
        let counters = world.engine.counters(port);
        assert_eq!((counters.timeouts, counters.retries), (timeouts, 1), "{port:?}");
    }
    world.unplugged.clear();
    assert_eq!(world.modbus(32, &read, LATER), [4, 2, 0, 0]);
    assert_eq!(world.nst(16, &READ, LATER), axes(2));
    assert_eq!(world.nst(1, &READ, LATER), axes(1));
}

#[test]
fn a_dead_device_is_refused_at_once_and_probed_until_it_answers() {
    let mut world = World::new();
    world.unplugged = vec![RS485_B];
    let read = [4, 0, 0x40, 0, 1];
    for _ in 0..3 {
        assert_eq!(world.modbus(32, &read, LATER), [0x84, 0x0B]);
    }
    assert_eq!(world.modbus(247, &[4, 2, 12, 0, 1], SOON), [4, 2, 0, 1], "bit 0: the route's first unit");
    world.pass(LATER);
    let sent = world.sent.len();
    assert_eq!(world.modbus(32, &read, Duration::from_millis(900)), [0x84, 0x0B], "the probe");
    assert_eq!(world.sent.len(), sent + 1, "without retry");
    world.engine.receive(Port::HOST, &modbus(32, &read), world.now);
    assert_eq!(world.engine.output(Port::HOST), modbus(32, &[0x84, 0x0B]), "at once");
    world.exchange(&[], Duration::from_millis(200));
    assert_eq!(world.sent.len(), sent + 1);
    world.unplugged.clear();
    assert_eq!(world.modbus(32, &read, SOON), [4, 2, 0, 0], "a second later the next one is let through");
    assert_eq!(world.modbus(247, &[4, 2, 12, 0, 1], SOON), [4, 2, 0, 0]);
    assert_eq!(world.modbus(32, &[3, 0, 0x60, 0, 1], SOON), [3, 2, 0, 0], "and all the others");
}

#[test]
fn a_write_as_a_probe_holds_its_bus_no_longer_than_a_read() {
    let mut world = World::new();
    world.unplugged = vec![RS485_A];
    for _ in 0..3 {
        assert_eq!(world.nst(16, &READ, LATER), []);
    }
    world.pass(LATER);
    world.unplugged.clear();
    world.held_back = Some(Vec::new());
    let write = [0x12, 0x01, 0xA7, 24];
    world.engine.receive(Port::HOST, &modbus(16, &write), world.now);
    world.pass(Duration::from_millis(60));
    let (port, late) = world.held_back.take().unwrap().remove(0);
    let quarantined = |world: &mut World| world.modbus(247, &[4, 2, 4, 0, 1], SOON)[3] != 0;
    assert!(quarantined(&mut world));
    assert_eq!(world.nst(17, &READ, Duration::from_millis(30)), [], "no such sensor, but it was asked");
    assert_eq!(world.engine.counters(port).sent, 8, "two for each read of three, the probe, this one");
    world.pass(Duration::from_millis(100));
    world.engine.receive(port, &late, world.now);
    assert!(!quarantined(&mut world), "within its write timeout that is an answer");
    assert_eq!(world.exchange(&[], SOON), [], "and yet given to nobody");
    assert_eq!(world.nst(16, &READ, SOON), axes(2));
}

#[test]
fn writes_are_never_sent_twice() {
    let mut world = World::new();
    world.unplugged = vec![RS485_B];
    assert_eq!(world.modbus(32, &[6, 0, 0x60, 6, 0], LATER), [0x86, 0x0B]);
    assert_eq!(world.sent.len(), 1);
}

#[test]
fn a_late_reply_is_given_to_no_other_request() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    world.station.modules()[0].analog_inputs = [0x1111; 16];
    assert_eq!(world.modbus(32, &[4, 0, 0x40, 0, 1], Duration::from_millis(500)), [0x84, 0x0B]);
    let late = world.held_back.take().unwrap();
    assert_eq!(late.len(), 2, "the read and its retry are owed");
    // the same function code has to wait for what is owed, another one need not
    world.station.modules()[0].analog_inputs = [0x2222; 16];
    world.engine.receive(Port::HOST, &modbus(32, &[4, 0, 0x41, 0, 1]), world.now);
    assert_eq!(world.modbus(33, &[3, 0, 0x60, 0, 1], Duration::from_millis(30)), [], "no such module");
    assert_eq!(world.sent.len(), 3);
    for (port, reply) in late {
        world.engine.receive(port, &reply, world.now);
    }
    world.pass(LATER);
    let replies = world.exchange(&[], Duration::ZERO);
    assert!(replies.ends_with(&modbus(32, &[4, 2, 0x22, 0x22])), "{replies:02x?}");
    assert!(!replies.windows(2).any(|pair| pair == [0x11, 0x11]));
    assert_eq!(world.engine.counters(RS485_B).foreign_or_late, 2);
}

#[test]
fn a_reply_half_received_when_a_hold_off_ends_is_not_lost() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    assert_eq!(world.nst(16, &READ, Duration::from_millis(180)), []);
    assert_eq!(world.held_back.replace(Vec::new()).map(|late| late.len()), Some(2));
    // another length need not wait; its reply is half there when the hold-off of the first ones ends, after some 205 ms
    assert_eq!(world.nst(16, &[0x03, 0x02, 0x00, 0x03], Duration::from_millis(10)), []);
    let (port, reply) = world.held_back.take().unwrap().remove(0);
    let (first, second) = reply.split_at(4);
    world.engine.receive(port, first, world.now);
    world.pass(Duration::from_millis(30));
    world.engine.receive(port, second, world.now);
    assert_eq!(world.exchange(&[], SOON).len(), 8, "three bytes of data, and what is around them");
    assert_eq!(world.engine.counters(port).timeouts, 2);
}

#[test]
fn a_reply_is_owed_even_if_the_retry_was_never_sent() {
    // on the serial line, which babbles until the time to live has passed
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    assert_eq!(world.nst(16, &READ, Duration::from_millis(40)), []);
    for _ in 0..400 {
        world.engine.receive(RS485_A, &[0x55], world.now);
        world.pass(Duration::from_micros(200));
    }
    let counters = world.engine.counters(RS485_A);
    assert_eq!((counters.timeouts, counters.retries, counters.expired), (1, 0, 0));
    assert_eq!(world.sent.len(), 1);
    world.held_back = None;
    assert_eq!(world.nst(16, &READ, Duration::from_millis(20)), [], "the first reply may still come");
    assert_eq!(world.sent.len(), 1);
    world.pass(Duration::from_millis(20));
    assert_eq!(world.sent.len(), 2, "three times the timeout have passed");

    // on CAN, where nobody acknowledges the retry
    let mut world = World::new();
    world.unplugged = vec![CAN];
    assert_eq!(world.nst(1, &READ, Duration::from_millis(40)), []);
    world.acknowledge = false;
    assert_eq!(world.nst(1, &[0x03, 0, 0, 1], Duration::from_millis(61)), []);
    let counters = world.engine.counters(CAN);
    assert_eq!(
        (counters.sent, counters.timeouts, counters.retries),
        (1, 2, 1),
        "no later than its time to live"
    );
    world.acknowledge = true;
    world.pass(Duration::from_millis(10));
    let sent = world.engine.counters(CAN).sent;
    world.unplugged.clear();
    assert_eq!(world.nst(1, &READ, Duration::from_millis(30)), [], "the first reply may still come");
    assert_eq!(world.engine.counters(CAN).sent, sent);
    world.pass(Duration::from_millis(30));
    assert_eq!(world.engine.counters(CAN).sent, sent + 1);
}

#[test]
fn a_port_that_hears_itself_drops_its_echo_and_counts_collisions() {
    let mut world = World::new();
    let request = [5, 2, 3, 0xFF, 0];
    for request in [[6, 0, 0x24, 0, 1], [6, 0, 0, 0xA9, 0x91], [6, 0, 0, 0xC0, 0xF1]] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    // the echo of this write is what its response would be
    world.echo = Some(Vec::new());
    world.unplugged = vec![RS485_B];
    assert_eq!(world.modbus(32, &request, LATER), [0x85, 0x0B], "an echo is no answer");
    world.unplugged.clear();
    assert_eq!(world.modbus(32, &request, LATER), request);
    assert_eq!(world.engine.counters(RS485_B).transmit_errors, 0);
    world.echo = Some(vec![0x55; 8]);
    assert_eq!(world.modbus(32, &request, LATER), request, "answered in spite of it");
    world.unplugged = vec![RS485_B];
    world.modbus(32, &request, LATER);
    assert_eq!(world.engine.counters(RS485_B).transmit_errors, 1, "another was heard");
    world.echo = None;
    world.modbus(32, &request, LATER);
    assert_eq!(world.engine.counters(RS485_B).transmit_errors, 2, "nothing was heard");
}

#[test]
fn noise_before_a_reply_is_slid_over() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    world.engine.receive(Port::HOST, &modbus(16, &READ), world.now);
    world.pass(Duration::from_millis(5));
    let (port, reply) = world.held_back.take().unwrap().remove(0);
    world.engine.receive(port, &[&[0x01, 0x03, 0x12, 0x55][..], &reply].concat(), world.now);
    let relayed = world.exchange(&[], SOON);
    assert_eq!(relayed, modbus(16, &axes(2)));
}

#[test]
fn a_full_queue_is_told() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    let requests: Vec<u8> = (0..6).flat_map(|index| modbus(32, &[4, 0, 0x40 + index, 0, 1])).collect();
    world.engine.receive(Port::HOST, &requests, world.now);
    assert_eq!(world.engine.output(Port::HOST), modbus(32, &[0x84, 0x06]), "one in flight, four wait");
    assert_eq!(world.engine.counters(Port::HOST).refused, 1);
}

#[test]
fn a_request_that_finds_no_silence_is_never_sent_late() {
    let mut world = World::new();
    let write = modbus(32, &[6, 0, 0x60, 6, 0]);
    world.engine.receive(RS485_B, &[0x55], world.now);
    world.engine.receive(Port::HOST, &write, world.now);
    let mut told = Vec::new();
    for _ in 0..250 {
        told.extend(world.exchange(&[], Duration::from_millis(5)));
        // somebody babbles
        world.engine.receive(RS485_B, &[0x55], world.now);
    }
    assert_eq!(told, modbus(32, &[0x86, 0x0B]));
    let counters = world.engine.counters(RS485_B);
    assert_eq!((counters.expired, counters.timeouts, counters.sent), (1, 0, 0));
    assert_eq!(world.exchange(&[], LATER), [], "nor afterwards");
    assert_eq!(world.exchange(&write, SOON), write, "the line is silent again");
}

#[test]
fn a_full_queue_of_nst_is_silent_and_counted() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    let requests: Vec<u8> = (0..7).flat_map(|index| modbus(16, &[3, 2, 0, 1 + index])).collect();
    world.engine.receive(Port::HOST, &requests, world.now);
    assert_eq!(world.engine.output(Port::HOST), []);
    assert_eq!(world.engine.counters(Port::HOST).refused, 2, "one in flight, four wait");
}

#[test]
fn what_expired_does_not_count_towards_quarantine() {
    let mut world = World::new();
    world.acknowledge = false;
    for _ in 0..5 {
        assert_eq!(world.nst(1, &READ, Duration::from_millis(150)), []);
    }
    assert_eq!(world.engine.counters(CAN).expired, 5);
    assert_eq!(world.modbus(247, &[4, 2, 0, 0, 1], SOON), [4, 2, 0, 0]);
    world.acknowledge = true;
    assert_eq!(world.nst(1, &READ, SOON), axes(1), "the device was never to blame");
}

#[test]
fn the_silence_that_ends_a_burst_can_be_set() {
    let mut world = World::new();
    let frame = modbus(32, &[4, 0, 0x40, 0, 1]);
    let (first, rest) = frame.split_at(3);
    // 20 ms at first: a pause of 15 ms is inside the frame
    world.exchange(first, Duration::from_millis(15));
    assert_eq!(world.exchange(rest, SOON), modbus(32, &[4, 2, 0, 0]));
    assert_eq!(world.modbus(247, &[6, 0, 0x43, 0, 100], SOON), [6, 0, 0x43, 0, 100]);
    world.exchange(first, Duration::from_millis(15));
    assert_eq!(world.exchange(rest, SOON), []);
    let counters = world.engine.counters(Port::HOST);
    assert_eq!((counters.dropped_bursts, counters.refused), (1, 1), "the second half starts like unit 64");
}

#[test]
fn a_slow_host_link_loses_no_reply() {
    let mut world = World::new();
    // nobody fetches replies: requests are held back before room runs out
    for _ in 0..40 {
        world.engine.receive(Port::HOST, &modbus(247, &[4, 0, 0, 0, 125]), world.now);
    }
    let length = world.engine.output(Port::HOST).len();
    let (mut rest, mut full, mut busy) = (world.engine.output(Port::HOST), 0, 0);
    while !rest.is_empty() {
        let size = if rest[1] == 4 { 255 } else { 5 };
        assert!(rtu::Frame::decode(&rest[..size]).is_ok());
        *(if size == 255 { &mut full } else { &mut busy }) += 1;
        rest = &rest[size..];
    }
    assert_eq!(full + busy, 40, "{length} bytes");
    assert_eq!(world.engine.counters(Port::HOST).refused, busy);
}

#[test]
fn each_attempt_owes_a_reply_of_its_own() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    assert_eq!(world.nst(16, &READ, Duration::from_millis(120)), []);
    let late = world.held_back.take().unwrap();
    assert_eq!(world.nst(16, &READ, Duration::from_millis(5)), []);
    for (port, reply) in &late {
        assert_eq!(world.sent.len(), 2, "a reply may still come");
        world.engine.receive(*port, reply, world.now);
        world.pass(Duration::from_millis(5));
    }
    assert_eq!((late.len(), world.sent.len()), (2, 3));
}

#[test]
fn a_copy_of_a_late_reply_settles_nothing_that_another_attempt_owes() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    // the first attempt's reply comes while the second one waits for its own: twice
    world.engine.receive(Port::HOST, &modbus(16, &READ), world.now);
    world.pass(Duration::from_millis(70));
    let (port, reply) = world.held_back.replace(Vec::new()).unwrap().remove(0);
    world.engine.receive(port, &reply.repeat(2), world.now);
    assert_eq!(world.exchange(&[], Duration::from_millis(1)), modbus(16, &axes(2)));
    // so the next read of this form waits for what the second attempt owes
    let other = [0x03, 0x02, 0x03, 0x12];
    let sent = world.sent.len();
    assert_eq!(world.nst(16, &other, Duration::from_millis(20)), []);
    assert_eq!(world.sent.len(), sent);
    world.engine.receive(port, &reply, world.now);
    world.pass(Duration::from_millis(5));
    assert_eq!(world.sent.len(), sent + 1);
}
