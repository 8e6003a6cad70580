//! What a port received and the end of what it sent, handed over in every order: their times decide.

use crate::world::{World, modbus};
use crate::{READ, axes};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{CAN, RS485_A};
use jointbus_protocol::nst::can::segment;
use jointbus_protocol::time::{Duration, Instant};

/// A character at 115200 baud, rounded down: bytes come no closer.
const CHARACTER: u64 = 86;

/// Bytes or frames, and when the last of them ended.
type Piece = (Vec<u8>, Instant);

fn micros(span: u64) -> Duration {
    Duration::from_micros(span)
}

/// An engine whose RS485 port has taken a read of the axes; and when its last stop bit leaves.
fn asked_serial() -> (World, Instant) {
    let mut world = World::new();
    // the line has been silent for a gap
    world.pass(micros(10_000));
    world.engine.receive(Port::HOST, &modbus(16, &READ), world.now);
    let taken = world.engine.output(RS485_A).len();
    assert_eq!(taken, 7);
    world.engine.advance(RS485_A, taken);
    let complete = world.now.saturating_add(micros(700));
    (world, complete)
}

/// The reply of the sensor in pieces of these lengths, the first byte of which begins at `start`.
fn pieces(lengths: &[usize], start: Instant) -> Vec<Piece> {
    let reply = modbus(1, &axes(2));
    let (mut pieces, mut from) = (Vec::new(), 0);
    for length in lengths.iter().copied().chain([reply.len()]) {
        let to = (from + length).min(reply.len());
        if to > from {
            // each byte a little slower than the baud rate has it
            let end = start.saturating_add(micros(to as u64 * (CHARACTER + 1)));
            pieces.push((reply[from..to].to_vec(), end));
        }
        from = to;
    }
    pieces
}

#[test]
fn a_reply_on_rs485_is_taken_wherever_the_end_of_its_request_comes_among_its_bytes() {
    for lengths in [&[][..], &[1], &[3, 1, 7], &[22]] {
        for gap in [0, 30, 400, 5000] {
            for place in 0..=lengths.len() + 1 {
                let (mut world, complete) = asked_serial();
                let pieces = pieces(lengths, complete.saturating_add(micros(gap)));
                for (index, (bytes, end)) in pieces.iter().enumerate() {
                    if index == place {
                        world.engine.transmit_complete(RS485_A, complete);
                    }
                    world.engine.receive(RS485_A, bytes, *end);
                }
                if place >= pieces.len() {
                    world.engine.transmit_complete(RS485_A, complete);
                }
                let expected = modbus(16, &axes(2));
                assert_eq!(world.engine.output(Port::HOST), expected, "{lengths:?} {gap} {place}");
            }
        }
    }
}

#[test]
fn what_ended_before_the_request_did_is_no_reply_in_either_order() {
    for early in [true, false] {
        let (mut world, complete) = asked_serial();
        let copy = (modbus(1, &axes(3)), Instant::from_micros(complete.as_micros() - 100));
        if early {
            world.engine.receive(RS485_A, &copy.0, copy.1);
        }
        world.engine.transmit_complete(RS485_A, complete);
        if !early {
            world.engine.receive(RS485_A, &copy.0, copy.1);
        }
        assert_eq!(world.engine.output(Port::HOST), [], "early: {early}");
        for (bytes, end) in pieces(&[5], complete.saturating_add(micros(300))) {
            world.engine.receive(RS485_A, &bytes, end);
        }
        assert_eq!(world.engine.output(Port::HOST), modbus(16, &axes(2)), "early: {early}");
    }
}

#[test]
fn noise_and_a_reply_in_one_piece_before_the_end_of_the_request_is_told() {
    let (mut world, complete) = asked_serial();
    let reply = pieces(&[], complete.saturating_add(micros(200)));
    let bytes = [&[0x55, 16, 3, 0, 1][..], &reply[0].0].concat();
    world.engine.receive(RS485_A, &bytes, reply[0].1);
    world.engine.transmit_complete(RS485_A, complete);
    assert_eq!(world.engine.output(Port::HOST), modbus(16, &axes(2)));
}

#[test]
fn a_reply_on_can_is_taken_wherever_the_acknowledgement_of_its_request_comes_among_its_frames() {
    let frames: Vec<_> = segment(1, 127, &axes(1)).unwrap().collect();
    for place in 0..=frames.len() {
        let mut world = World::new();
        world.engine.receive(Port::HOST, &modbus(1, &READ), world.now);
        assert!(world.engine.next_frame(CAN).is_some());
        let sent = world.now.saturating_add(micros(130));
        for (index, frame) in frames.iter().enumerate() {
            if index == place {
                world.engine.frame_sent(CAN, sent);
            }
            let end = sent.saturating_add(micros(130 * (index as u64 + 1)));
            world.engine.receive_frame(CAN, frame, end);
        }
        if place == frames.len() {
            world.engine.frame_sent(CAN, sent);
        }
        assert_eq!(world.engine.output(Port::HOST), modbus(1, &axes(1)), "{place}");
    }
}

#[test]
fn a_transfer_that_ended_before_the_request_on_can_is_no_reply_in_either_order() {
    let copy: Vec<_> = segment(1, 127, &axes(3)).unwrap().collect();
    let frames: Vec<_> = segment(1, 127, &axes(1)).unwrap().collect();
    for early in [true, false] {
        let mut world = World::new();
        world.engine.receive(Port::HOST, &modbus(1, &READ), world.now);
        assert!(world.engine.next_frame(CAN).is_some());
        let (before, sent) = (world.now.saturating_add(micros(100)), world.now.saturating_add(micros(500)));
        if !early {
            world.engine.frame_sent(CAN, sent);
        }
        copy.iter().for_each(|frame| world.engine.receive_frame(CAN, frame, before));
        if early {
            world.engine.frame_sent(CAN, sent);
        }
        assert_eq!(world.engine.output(Port::HOST), [], "early: {early}");
        let after = sent.saturating_add(micros(130));
        frames.iter().for_each(|frame| world.engine.receive_frame(CAN, frame, after));
        assert_eq!(world.engine.output(Port::HOST), modbus(1, &axes(1)), "early: {early}");
    }
}

#[test]
fn bytes_that_find_no_room_before_the_end_of_the_request_is_told_are_counted() {
    let (mut world, complete) = asked_serial();
    world.engine.receive(RS485_A, &[0x55; 300], complete.saturating_add(micros(30_000)));
    assert_eq!(world.engine.counters(RS485_A).overruns, 1);
}
