//! The rings of a port, from both ends.

use super::*;
use crate::boards::stm32f405::Engine;
use crate::engine::{Identity, ResetCause};

#[test]
fn stamps_are_recent() {
    let at = |now: u64, micros: u32| extend_timestamp(Instant::from_micros(now), micros).as_micros();
    assert_eq!(at(1000, 990), 990);
    assert_eq!(at(1000, 1005), 1000, "not after now");
    assert_eq!(at(0x1_0000_0005, 0xFFFF_FFFE), 0xFFFF_FFFE);
    assert_eq!(at(0x5_0000_0005, 0xFFFF_FFFE), 0x4_FFFF_FFFE);
}

#[test]
fn a_request_passes_and_its_answer_comes_back() {
    let now = Instant::from_micros(5);
    let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
    let mut engine = Engine::new(identity, now);
    let mut queues = UartBuffers::<RX_CAPACITY>::new();
    let (mut interrupt, mut main) = queues.split();
    let request = jointbus_protocol::modbus::Request::ReadInputRegisters(
        jointbus_protocol::modbus::AddressRange::new(0, 120),
    );
    let mut buffer = [0; 16];
    for byte in rtu::encode_request(247, &request, &mut buffer).unwrap() {
        interrupt.received(*byte, 5);
    }
    assert!(!main.is_idle());
    main.drain_rx(&mut engine, Port::HOST, now);
    assert!(main.is_idle());
    assert!(main.fill_tx(&mut engine, Port::HOST));
    let sent: std::vec::Vec<u8> = core::iter::from_fn(|| interrupt.transmitter().next_byte()).collect();
    assert_eq!(sent.len(), 245);
    assert!(rtu::Frame::decode(&sent).is_ok());
    assert!(interrupt.transmitter().is_drained());
}

#[test]
fn a_transmitter_that_takes_nothing_stands_still() {
    let now = Instant::from_micros(0);
    let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
    let mut engine = Engine::new(identity, now);
    let mut queues = UartBuffers::<RX_CAPACITY>::new();
    let (mut interrupt, mut main) = queues.split();
    assert!(main.made_progress(), "there is nothing to send");
    let request = jointbus_protocol::modbus::Request::ReadInputRegisters(
        jointbus_protocol::modbus::AddressRange::new(0, 1),
    );
    engine.receive(Port::HOST, rtu::encode_request(247, &request, &mut [0; 16]).unwrap(), now);
    assert!(main.fill_tx(&mut engine, Port::HOST));
    assert!(!main.made_progress());
    assert!(interrupt.transmitter().next_byte().is_some());
    assert!(main.made_progress());
    assert!(!main.made_progress());
    while interrupt.transmitter().next_byte().is_some() {}
    assert!(main.made_progress());
    assert!(!main.made_progress(), "the last byte does not leave");
    interrupt.transmitter().transmitted(0);
    assert!(main.made_progress());
    assert!(main.made_progress(), "there is nothing to send");
}

#[test]
fn a_frame_with_a_broken_character_is_never_taken_and_the_character_is_counted() {
    let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
    let request = jointbus_protocol::modbus::Request::ReadInputRegisters(
        jointbus_protocol::modbus::AddressRange::new(0, 1),
    );
    let mut buffer = [0; 16];
    let frame = rtu::encode_request(247, &request, &mut buffer).unwrap();
    for broken in 0..frame.len() {
        let mut now = Instant::from_micros(0);
        let mut engine = Engine::new(identity, now);
        let mut queues = UartBuffers::<RX_CAPACITY>::new();
        let (mut interrupt, mut main) = queues.split();
        for (index, byte) in frame.iter().enumerate() {
            // what is wrong may be the parity or stop bit alone
            let byte = if index == broken { interrupt.transmitter().framing_error(*byte) } else { *byte };
            interrupt.received(byte, 0);
        }
        main.drain_rx(&mut engine, Port::HOST, now);
        assert!(!main.fill_tx(&mut engine, Port::HOST), "taken with byte {broken} broken");
        assert!(engine.counters(Port::HOST).checksum_errors >= 1);
        now = Instant::from_micros(1_000_000);
        while engine.poll(now).is_some() {}
        frame.iter().for_each(|byte| interrupt.received(*byte, 1_000_000));
        main.drain_rx(&mut engine, Port::HOST, now);
        assert!(main.fill_tx(&mut engine, Port::HOST), "the next one is");
    }
}

#[test]
fn the_end_of_a_transmission_keeps_its_place_among_the_bytes() {
    let mut queues = UartBuffers::<RX_CAPACITY_RESPONSES>::new();
    let (mut interrupt, main) = queues.split();
    assert!(main.is_idle());
    (0..3).for_each(|_| interrupt.received(0x55, 0));
    interrupt.transmitter().transmitted(0);
    interrupt.received(0xAA, 0);
    let (ended_at, put) = (&main.shared.ended_at, &main.ends.put);
    assert_eq!((ended_at.load(Ordering::Relaxed), put.load(Ordering::Relaxed)), (3, 4));
    assert!(!main.is_idle());
}

#[test]
fn a_ring_goes_round() {
    let ring = Ring::<4>::new();
    for first in 0..100 {
        assert!((first..first + 4).all(|byte| ring.put(byte)) && !ring.put(0));
        assert!((first..first + 4).all(|byte| ring.take() == Some(byte)) && ring.take().is_none());
    }
}

#[test]
fn lost_bytes_are_counted() {
    let now = Instant::from_micros(0);
    let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
    let mut engine = Engine::new(identity, now);
    let mut queues = UartBuffers::<RX_CAPACITY>::new();
    let (mut interrupt, mut main) = queues.split();
    for _ in 0..RX_CAPACITY + 1 {
        interrupt.received(0x55, 0);
    }
    main.drain_rx(&mut engine, Port::HOST, now);
    assert_eq!(engine.counters(Port::HOST).overruns, 1);
}
