//! The bridge as a host sees it, against simulated devices in virtual time.

mod world;

use jointbus_mcu_bridge::engine::Settings;
use jointbus_mcu_bridge::engine::config::Port;
use jointbus_protocol::modbus::rtu;
use jointbus_protocol::nst::SignEncoding;
use jointbus_protocol::time::Duration;
use world::{SAMPLE, World, modbus};

const SOON: Duration = Duration::from_millis(40);
const LATER: Duration = Duration::from_millis(2000);

/// Reads the six axes.
const READ: [u8; 4] = [0x03, 0x02, 0x00, 0x12];

fn axes(factor: i32) -> Vec<u8> {
    let sample = jointbus_protocol::nst::Sample(SAMPLE.0.map(|axis| axis * factor));
    [&[0x03, 0x12][..], &sample.encode(SignEncoding::TwosComplement)].concat()
}

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
    assert_eq!(world.engine.quirks(), 1);
}

#[test]
fn long_reads_over_can_are_split_and_joined() {
    let mut world = World::new();
    world.can_daq.hardware().settings[..0xE3]
        .iter_mut()
        .enumerate()
        .for_each(|(index, byte)| *byte = index as u8);
    for length in [126, 127, 200, 249] {
        let reply = world.nst(1, &[0x03, 0, 0, length], SOON);
        assert_eq!(reply[..2], [0x03, length]);
        assert_eq!(reply[2..], world.can_daq.hardware().settings[..length.into()], "{length} bytes");
    }
    assert_eq!(world.engine.counters(Port::Can).sent, 1 + 3 * 2, "a frame a part");
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
        assert_eq!(world.can_daq.hardware().settings[start..start + data.len()], data);
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
fn the_station_gets_its_silence_between_frames() {
    let mut world = World::new();
    let read = modbus(32, &[4, 0, 0x40, 0, 2]);
    let replies = world.exchange(&[read.clone(), read].concat(), LATER);
    assert_eq!(replies.len(), 2 * 9);
    let [(first, ..), (second, _, frame)] = &world.sent[..] else { panic!("{:?}", world.sent) };
    let quiet = second.since(*first).as_micros() - 9 * 87 - frame.len() as u64 * 87;
    assert!(quiet >= 11_000, "{quiet} us");
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
    world.unplugged = vec![Port::Rs485B];
    assert_eq!(world.modbus(32, &[0x41, 1, 2, 3], SOON), []);
    assert_eq!(world.sent.len(), 1);
    world.engine.receive(Port::Rs485B, &[0xDE; 13], world.now);
    let pause = world.engine.deadline().expect("silence ends it");
    world.engine.poll(pause);
    let next = world.engine.deadline().expect("the timeout");
    assert!(next > pause, "due at {pause:?}, and at {next:?} again");
    assert_eq!(world.engine.counters(Port::Rs485B).foreign_or_late, 1);
    assert_eq!(world.exchange(&[], LATER), modbus(32, &[0xC1, 0x0B]));
}

#[test]
fn the_boards_own_units_answer() {
    let mut world = World::new();
    assert_eq!(world.modbus(31, &[16, 0, 4, 0, 4, 8, 0, 0, 0x40, 0x20, 0, 1, 0, 0], SOON), [16, 0, 4, 0, 4]);
    assert_eq!(world.modbus(31, &[3, 0, 4, 0, 4], SOON), [3, 8, 0, 0, 0x40, 0x20, 0, 1, 0, 0]);
    assert_eq!(world.engine.analog_outputs().channels[0].set_value, 2.5);
    assert!(world.engine.analog_outputs().channels[0].output);
    assert_eq!(world.modbus(40, &[4, 0, 0, 0, 1], SOON), [0x84, 4], "not measured yet");
    world.engine.set_inputs(0x00A5, [1, 2, 3, 4]);
    assert_eq!(world.modbus(40, &[4, 0, 0, 0, 1], SOON), [4, 2, 0, 0xA5]);
    assert_eq!(world.modbus(40, &[4, 0, 0x43, 0, 1], SOON), [4, 2, 0, 4]);
    assert_eq!(world.modbus(40, &[5, 2, 0, 0xFF, 0], SOON), [5, 2, 0, 0xFF, 0]);
    assert_eq!(world.engine.digital_outputs(), 1);
}

#[test]
fn an_unplugged_device_is_told_in_time_and_comes_back() {
    let mut world = World::new();
    world.unplugged = vec![Port::Rs485A, Port::Rs485B, Port::Can];
    let read = [4, 0, 0x40, 0, 1];
    assert_eq!(world.modbus(32, &read, Duration::from_millis(390)), []);
    world.pass(Duration::from_millis(100));
    assert_eq!(world.exchange(&[], Duration::ZERO), modbus(32, &[0x84, 0x0B]), "after the retry");
    assert_eq!(world.nst(16, &READ, LATER), []);
    assert_eq!(world.nst(1, &READ, LATER), []);
    for (port, timeouts) in [(Port::Rs485A, 2), (Port::Rs485B, 2), (Port::Can, 2)] {
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
    world.unplugged = vec![Port::Rs485B];
    let read = [4, 0, 0x40, 0, 1];
    for _ in 0..3 {
        assert_eq!(world.modbus(32, &read, LATER), [0x84, 0x0B]);
    }
    assert_eq!(world.modbus(247, &[4, 2, 12, 0, 1], SOON), [4, 2, 0, 1], "bit 0: the route's first unit");
    world.pass(LATER);
    let sent = world.sent.len();
    assert_eq!(world.modbus(32, &read, Duration::from_millis(900)), [0x84, 0x0B], "the probe");
    assert_eq!(world.sent.len(), sent + 1, "without retry");
    world.engine.receive(Port::Host, &modbus(32, &read), world.now);
    assert_eq!(world.engine.output(Port::Host), modbus(32, &[0x84, 0x0B]), "at once");
    world.exchange(&[], Duration::from_millis(200));
    assert_eq!(world.sent.len(), sent + 1);
    world.unplugged.clear();
    assert_eq!(world.modbus(32, &read, SOON), [4, 2, 0, 0], "a second later the next one is let through");
    assert_eq!(world.modbus(247, &[4, 2, 12, 0, 1], SOON), [4, 2, 0, 0]);
    assert_eq!(world.modbus(32, &[3, 0, 0x60, 0, 1], SOON), [3, 2, 0, 0], "and all the others");
}

#[test]
fn writes_are_never_sent_twice() {
    let mut world = World::new();
    world.unplugged = vec![Port::Rs485B];
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
    world.engine.receive(Port::Host, &modbus(32, &[4, 0, 0x41, 0, 1]), world.now);
    assert_eq!(world.modbus(33, &[3, 0, 0x60, 0, 1], Duration::from_millis(30)), [], "no such module");
    assert_eq!(world.sent.len(), 3);
    for (port, reply) in late {
        world.engine.receive(port, &reply, world.now);
    }
    world.pass(LATER);
    let replies = world.exchange(&[], Duration::ZERO);
    assert!(replies.ends_with(&modbus(32, &[4, 2, 0x22, 0x22])), "{replies:02x?}");
    assert!(!replies.windows(2).any(|pair| pair == [0x11, 0x11]));
    assert_eq!(world.engine.counters(Port::Rs485B).foreign_or_late, 2);
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
fn a_late_reply_to_a_part_is_given_to_no_other_split_request() {
    let mut world = World::new();
    world.unplugged = vec![Port::Can];
    // parts of 126 and 24 bytes; the first one is asked for twice
    assert_eq!(world.nst(1, &[0x03, 0, 0, 150], Duration::from_millis(120)), []);
    // the first part of the next one has the same length, and waits until three times the timeout have passed
    let sent = world.engine.counters(Port::Can).sent;
    assert_eq!(world.nst(1, &[0x03, 0, 0, 200], Duration::from_millis(50)), []);
    assert_eq!(world.engine.counters(Port::Can).sent, sent);
    world.pass(Duration::from_millis(45));
    assert_eq!(world.engine.counters(Port::Can).sent, sent + 1);
}

#[test]
fn a_reply_is_owed_even_if_the_retry_was_never_sent() {
    // on the serial line, which babbles until the time to live has passed
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    assert_eq!(world.nst(16, &READ, Duration::from_millis(40)), []);
    for _ in 0..400 {
        world.engine.receive(Port::Rs485A, &[0x55], world.now);
        world.pass(Duration::from_micros(200));
    }
    let counters = world.engine.counters(Port::Rs485A);
    assert_eq!((counters.timeouts, counters.retries, counters.expired), (1, 0, 0));
    assert_eq!(world.sent.len(), 1);
    world.held_back = None;
    assert_eq!(world.nst(16, &READ, Duration::from_millis(20)), [], "the first reply may still come");
    assert_eq!(world.sent.len(), 1);
    world.pass(Duration::from_millis(20));
    assert_eq!(world.sent.len(), 2, "three times the timeout have passed");

    // on CAN, where nobody acknowledges the retry
    let mut world = World::new();
    world.unplugged = vec![Port::Can];
    assert_eq!(world.nst(1, &READ, Duration::from_millis(40)), []);
    world.acknowledge = false;
    assert_eq!(world.nst(1, &[0x03, 0, 0, 1], Duration::from_millis(61)), []);
    let counters = world.engine.counters(Port::Can);
    assert_eq!(
        (counters.sent, counters.timeouts, counters.retries),
        (1, 2, 1),
        "no later than its time to live"
    );
    world.acknowledge = true;
    world.pass(Duration::from_millis(10));
    let sent = world.engine.counters(Port::Can).sent;
    world.unplugged.clear();
    assert_eq!(world.nst(1, &READ, Duration::from_millis(30)), [], "the first reply may still come");
    assert_eq!(world.engine.counters(Port::Can).sent, sent);
    world.pass(Duration::from_millis(30));
    assert_eq!(world.engine.counters(Port::Can).sent, sent + 1);
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
    world.unplugged = vec![Port::Rs485B];
    assert_eq!(world.modbus(32, &request, LATER), [0x85, 0x0B], "an echo is no answer");
    world.unplugged.clear();
    assert_eq!(world.modbus(32, &request, LATER), request);
    assert_eq!(world.engine.counters(Port::Rs485B).transmit_errors, 0);
    world.echo = Some(vec![0x55; 8]);
    assert_eq!(world.modbus(32, &request, LATER), request, "answered in spite of it");
    world.unplugged = vec![Port::Rs485B];
    world.modbus(32, &request, LATER);
    assert_eq!(world.engine.counters(Port::Rs485B).transmit_errors, 1, "another was heard");
    world.echo = None;
    world.modbus(32, &request, LATER);
    assert_eq!(world.engine.counters(Port::Rs485B).transmit_errors, 2, "nothing was heard");
}

#[test]
fn noise_before_a_reply_is_slid_over() {
    let mut world = World::new();
    world.held_back = Some(Vec::new());
    world.engine.receive(Port::Host, &modbus(16, &READ), world.now);
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
    world.engine.receive(Port::Host, &requests, world.now);
    assert_eq!(world.engine.output(Port::Host), modbus(32, &[0x84, 0x06]), "one in flight, four wait");
    assert_eq!(world.engine.counters(Port::Host).refused, 1);
}

#[test]
fn a_request_that_nobody_acknowledges_on_can_is_never_sent_late() {
    let mut world = World::new();
    world.acknowledge = false;
    assert_eq!(world.nst(1, &[0x12, 0x01, 0xA7, 24], Duration::from_millis(200)), []);
    let counters = world.engine.counters(Port::Can);
    assert_eq!((counters.expired, counters.timeouts, counters.sent), (1, 0, 0));
    world.acknowledge = true;
    assert_eq!(world.nst(1, &READ, SOON), axes(1), "the bus is usable again");
}

#[test]
fn a_request_that_finds_no_silence_is_never_sent_late() {
    let mut world = World::new();
    let write = modbus(32, &[6, 0, 0x60, 6, 0]);
    world.engine.receive(Port::Rs485B, &[0x55], world.now);
    world.engine.receive(Port::Host, &write, world.now);
    let mut told = Vec::new();
    for _ in 0..250 {
        told.extend(world.exchange(&[], Duration::from_millis(5)));
        // somebody babbles
        world.engine.receive(Port::Rs485B, &[0x55], world.now);
    }
    assert_eq!(told, modbus(32, &[0x86, 0x0B]));
    let counters = world.engine.counters(Port::Rs485B);
    assert_eq!((counters.expired, counters.timeouts, counters.sent), (1, 0, 0));
    assert_eq!(world.exchange(&[], LATER), [], "nor afterwards");
    assert_eq!(world.exchange(&write, SOON), write, "the line is silent again");
}

#[test]
fn after_bus_off_the_controller_returns_later_each_time() {
    let mut world = World::new();
    let mut waited = Vec::new();
    for round in 0..9 {
        let off = world.now;
        world.engine.set_bus_off(true, off);
        assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], Duration::ZERO), [4, 2, 0, 4], "bus-off now");
        let restart = world.engine.deadline().unwrap();
        assert!(!world.engine.take_can_restart(off));
        world.now = restart;
        assert!(world.engine.take_can_restart(restart) && !world.engine.take_can_restart(restart), "once");
        waited.push(restart.since(off).as_micros() / 1000);
        world.engine.set_bus_off(false, restart);
        if round == 7 {
            assert_eq!(world.nst(1, &READ, SOON), axes(1));
        }
    }
    assert_eq!(waited, [10, 20, 40, 80, 160, 320, 640, 1000, 10], "a frame that was sent ends the row");
    assert_eq!(world.engine.counters(Port::Can).bus_off, 9);
    assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0]);
}

#[test]
fn a_second_copy_of_a_reply_on_can_answers_nothing_that_is_still_being_sent() {
    let mut world = World::new();
    let reply = |world: &mut World| {
        let body = axes(1);
        for frame in jointbus_protocol::nst::can::segment(1, 127, &body).unwrap() {
            world.engine.receive_frame(&frame, world.now);
        }
        world.engine.output(Port::Host).len()
    };
    let length = axes(1).len() + 3;
    for request in 1..=2 {
        world.engine.receive(Port::Host, &modbus(1, &READ), world.now);
        assert!(world.engine.next_frame().is_some());
        assert_eq!(reply(&mut world), (request - 1) * length, "nobody has acknowledged the request");
        world.engine.frame_sent(world.now);
        assert_eq!(reply(&mut world), request * length);
    }
    assert_eq!(world.engine.counters(Port::Can).foreign_or_late, 2);
}

#[test]
fn a_frame_that_is_acknowledged_while_it_is_given_up_holds_nothing_up() {
    for length in [4usize, 12] {
        let mut world = World::new();
        world.acknowledge = false;
        let data = vec![7; length - 4];
        let request = [&[0x10, 0, 0, data.len() as u8][..], &data].concat();
        world.engine.receive(Port::Host, &modbus(1, &request), world.now);
        let mut frame = world.engine.next_frame();
        assert!(frame.take().is_some());
        world.now = world.now.after(Duration::from_millis(100));
        world.engine.poll(world.now);
        assert!(world.engine.wants_abort(), "its time to live has passed");
        // the frame was on the wire, and the last attempt succeeded
        world.engine.frame_sent(world.now);
        assert!(!world.engine.wants_abort());
        world.acknowledge = true;
        world.pass(LATER);
        let counters = world.engine.counters(Port::Can);
        let (expired, timeouts) = if length > 8 { (1, 0) } else { (0, 1) };
        assert_eq!((counters.expired, counters.timeouts), (expired, timeouts), "of {length} bytes");
        assert_eq!(world.nst(1, &READ, SOON), axes(1), "the bus is usable again");
    }
}

#[test]
fn unknown_units_and_broken_frames_end_with_silence() {
    let mut world = World::new();
    assert_eq!(world.exchange(&modbus(99, &[3, 0, 0, 0, 1]), SOON), []);
    assert_eq!(world.engine.counters(Port::Host).refused, 1);
    let mut broken = modbus(32, &[4, 0, 0x40, 0, 1]);
    broken[3] ^= 1;
    let good = modbus(32, &[4, 0, 0x40, 0, 1]);
    assert_eq!(world.exchange(&[broken, good.clone()].concat(), SOON), [], "not without silence");
    let counters = world.engine.counters(Port::Host);
    assert_eq!((counters.checksum_errors, counters.dropped_bursts, counters.refused), (1, 1, 1));
    assert_eq!(
        world.exchange(&[&[0x20][..], &good].concat(), SOON),
        modbus(32, &[4, 2, 0, 0]),
        "a stray byte"
    );
    assert_eq!(world.exchange(&modbus(16, &[0x04, 0, 0, 1]), SOON), [], "no function code of NST");
    assert!(world.sent.iter().all(|(_, port, _)| *port == Port::Rs485B));
}

#[test]
fn broadcasts_reach_their_buses_and_are_never_answered() {
    let mut world = World::new();
    world.engine.set_inputs(0, [0; 4]);
    assert_eq!(world.exchange(&modbus(0, &[5, 2, 0, 0xFF, 0]), SOON), []);
    assert_eq!(world.station.modules()[0].outputs, 1);
    assert_eq!(world.engine.digital_outputs(), 1);
    assert_eq!(world.exchange(&modbus(0, &[3, 0, 0, 0, 1]), SOON), []);
    assert_eq!(world.engine.counters(Port::Host).refused, 1, "reads are no broadcasts");
    assert_eq!(world.exchange(&modbus(255, &[0x12, 0x01, 0xA7, 24]), SOON), []);
    assert_eq!(world.sent.last().unwrap().2, modbus(255, &[0x12, 0x01, 0xA7, 24]));
    world.serial_daq.restart();
    assert_eq!(world.serial_daq.sample().0, [0; 6]);
    assert_eq!(world.exchange(&modbus(255, &[16, 0, 6, 0, 2, 4, 0, 1, 0, 0]), SOON), []);
    assert!(world.engine.analog_outputs().channels[0].output);
}

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
    assert_eq!(world.engine.counters(Port::Can).received, 0);
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
    assert!(start.since(slot.stamp) < Duration::from_millis(11));
    let block = world.modbus(247, &[4, 1, 0, 0, 24], Duration::ZERO);
    let fields = [
        &[4, 48, 0, 2, 0, 1][..],
        &slot.sequence.to_be_bytes(),
        &slot.stamp.as_micros().to_be_bytes(),
        &[0; 8],
    ];
    assert_eq!(block, [fields.concat(), sample(1)].concat());
    let block = world.modbus(247, &[4, 1, 0x60, 0, 24], Duration::ZERO);
    assert_eq!(block[2..6], [0, 2, 0, 16]);
    assert_eq!(block[26..], sample(2));

    world.unplugged = vec![Port::Can];
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
    world.unplugged = vec![Port::Rs485A];
    world.nst(16, &READ, LATER);
    assert_eq!(world.engine.counters(Port::Rs485A).timeouts, 2, "staged is not live");
    assert_eq!(world.modbus(247, &apply, SOON), apply);
    assert_eq!(world.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0x10], "unconfirmed");
    world.nst(16, &READ, Duration::from_millis(900));
    assert_eq!(world.engine.counters(Port::Rs485A).timeouts, 2, "a second has not passed");
    world.pass(Duration::from_millis(10_000));
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0, 50], "rolled back");
    for request in [timeout, apply, confirm] {
        assert_eq!(world.modbus(247, &request, SOON), request);
    }
    world.pass(Duration::from_millis(20_000));
    assert_eq!(world.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0x03, 0xE8], "confirmed");
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
    let stored = world.engine.take_save().unwrap();
    assert!(world.engine.take_save().is_none());
    world.engine.saved(true);
    assert_eq!(world.exchange(&[], SOON), modbus(247, &save));

    let mut other = World::new();
    other.engine.restore(&Settings::decode(&stored).unwrap(), other.now);
    assert_eq!(other.modbus(247, &[3, 1, 0x15, 0, 1], SOON), [3, 2, 0, 77], "confirmed, not staged");
    assert_eq!(other.modbus(247, &[3, 0, 0x41, 0, 1], SOON), [3, 2, 0, 99]);
    assert_eq!(other.modbus(247, &[3, 0, 0x55, 0, 1], SOON), [3, 2, 0, 5]);
    assert_eq!(other.modbus(247, &[4, 0, 9, 0, 1], SOON), [4, 2, 0, 0]);
    assert_eq!(other.modbus(247, &save, SOON), []);
    other.engine.take_save().unwrap();
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
    assert_eq!(world.engine.counters(Port::Host).refused, 2);
}

#[test]
fn host_silence_switches_the_local_outputs_off() {
    let mut world = World::new();
    world.engine.set_inputs(0, [0; 4]);
    let limit = [6, 0, 0x42, 0, 100];
    assert_eq!(world.modbus(247, &limit, SOON), limit);
    world.modbus(31, &[16, 0, 4, 0, 4, 8, 0, 0, 0x40, 0x20, 0, 1, 0, 0], SOON);
    let on = [5, 2, 0, 0xFF, 0];
    assert_eq!(world.modbus(40, &on, SOON), on);
    world.pass(Duration::from_millis(200));
    assert!(!world.engine.analog_outputs().channels[0].output);
    assert_eq!(world.engine.analog_outputs().channels[0].set_value, 2.5, "set values stay");
    assert_eq!(world.engine.digital_outputs(), 0);
    let on = world.modbus(31, &[16, 0, 6, 0, 2, 4, 0, 1, 0, 0], SOON);
    assert_eq!(on, [16, 0, 6, 0, 2], "only the host switches on again");
    assert!(world.engine.analog_outputs().channels[0].output);
}

#[test]
fn a_slow_host_link_loses_no_reply() {
    let mut world = World::new();
    // nobody fetches replies: requests are held back before room runs out
    for _ in 0..40 {
        world.engine.receive(Port::Host, &modbus(247, &[4, 0, 0, 0, 125]), world.now);
    }
    let length = world.engine.output(Port::Host).len();
    let (mut rest, mut full, mut busy) = (world.engine.output(Port::Host), 0, 0);
    while !rest.is_empty() {
        let size = if rest[1] == 4 { 255 } else { 5 };
        assert!(rtu::Frame::decode(&rest[..size]).is_ok());
        *(if size == 255 { &mut full } else { &mut busy }) += 1;
        rest = &rest[size..];
    }
    assert_eq!(full + busy, 40, "{length} bytes");
    assert_eq!(world.engine.counters(Port::Host).refused, busy);
}
