//! Faults of the CAN bus.

use super::*;
use jointbus::client;

#[test]
fn a_can_frame_that_nobody_acknowledges_is_given_up_and_not_sent_later() {
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    bench.set_limits(&Limits { time_to_live_ms: 100, ..Limits::GENEROUS }).unwrap();
    let mut client = bench.client().unwrap();
    emulator(&bench).fault("ack 0").unwrap();
    client.set_timeout(Duration::from_secs(2));
    assert!(matches!(client.nst(CAN_UNIT).set_zero(), Err(Error::Timeout)));
    let counters = bridge::counters(&mut client, port::CAN).unwrap();
    assert_eq!((counters.expired, counters.timeouts), (1, 0));
    assert!(counters.transmit_errors > 0, "{counters:?}");
    emulator(&bench).fault("ack 1").unwrap();
    bench.set_limits(&Limits::GENEROUS).unwrap();
    let mut client = bench.client().unwrap();
    let zero = client.nst(CAN_UNIT).read(0x01A7, 24).unwrap();
    assert_eq!(zero, [0; 24], "the command was never carried out");
}

#[test]
fn the_image_goes_bus_off_and_returns() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    client.nst(CAN_UNIT).sample().unwrap();
    // 32 errors in a row, eight counts each, are one too many
    emulator(&bench).fault("err 32").unwrap();
    client.nst(CAN_UNIT).sample().unwrap();
    let counters = bridge::counters(&mut client, port::CAN).unwrap();
    assert_eq!(counters.bus_off, 1, "{counters:?}");
    assert!(counters.transmit_errors > 0, "{counters:?}");
    assert_eq!(bridge::about(&mut client).unwrap().health, 0, "it is back");
}

#[test]
fn a_frame_with_a_data_length_code_above_8_is_eight_bytes_and_no_panic() {
    let emulator = Emulator::launch(&options()).unwrap();
    let mut stranger = emulator.connect(Port::Can).unwrap();
    let stream = emulator.connect(Port::Usart1).unwrap();
    client::prepare(&stream).unwrap();
    let mut client = Client::new(stream, Duration::from_millis(500));
    bridge::wait(&mut client, PATIENCE).unwrap();
    // to the bridge's node, data length code 15
    stranger.write_all(b"T00057F10F0102030405060708\r").unwrap();
    until(|| bridge::counters(&mut client, port::CAN).is_ok_and(|counters| counters.received > 0));
    let counters = bridge::counters(&mut client, port::CAN).unwrap();
    assert_eq!((counters.received, counters.foreign_or_late), (1, 1));
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1, "no reset came between");
}

#[test]
fn can_frames_that_are_not_fetched_in_time_are_counted() {
    const NVIC_ISER0: u32 = 0xE000_E100;
    const NVIC_ICER0: u32 = 0xE000_E180;
    const CAN1_RX0: u32 = 1 << 20;
    let (options, debugger) = debuggable(options());
    let emulator = Emulator::launch(&options).unwrap();
    let mut stranger = emulator.connect(Port::Can).unwrap();
    stranger.set_read_timeout(Some(PATIENCE)).unwrap();
    let stream = emulator.connect(Port::Usart1).unwrap();
    client::prepare(&stream).unwrap();
    let mut client = Client::new(stream, Duration::from_millis(500));
    bridge::wait(&mut client, PATIENCE).unwrap();
    client.set_timeout(PATIENCE);
    emulator.fault("room 0").unwrap();
    resets::store(&debugger, NVIC_ICER0, CAN1_RX0);
    // five to the bridge's node, and the FIFO has room for three
    stranger.write_all(&b"T00057F10100\r".repeat(5)).unwrap();
    assert_eq!(take(&mut stranger), *b"Z\rZ\rZ\rZ\rZ\r", "all have been on the bus");
    resets::store(&debugger, NVIC_ISER0, CAN1_RX0);
    until(|| bridge::counters(&mut client, port::CAN).unwrap().received > 0);
    let counters = bridge::counters(&mut client, port::CAN).unwrap();
    assert_eq!((counters.received, counters.overruns), (3, 1), "{counters:?}");
}

#[test]
fn after_ten_seconds_without_acknowledgement_no_old_command_is_carried_out() {
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    bench.set_limits(&Limits { time_to_live_ms: 100, ..Limits::GENEROUS }).unwrap();
    let mut client = bench.client().unwrap();
    emulator(&bench).fault("ack 0").unwrap();
    client.set_timeout(Duration::from_millis(500));
    let start = bridge::wait(&mut client, PATIENCE).unwrap().uptime_us;
    let mut commands = 0;
    until(|| {
        assert!(matches!(client.nst(CAN_UNIT).set_zero(), Err(Error::Timeout)), "NST: silence");
        commands += 1;
        bridge::wait(&mut client, PATIENCE).unwrap().uptime_us > start + 10_000_000
    });
    client.set_timeout(PATIENCE);
    assert_eq!(bridge::counters(&mut client, port::CAN).unwrap().expired, commands);
    emulator(&bench).fault("ack 1").unwrap();
    bench.set_limits(&Limits::GENEROUS).unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    assert!(bench.can.lock().sensor(1).unwrap().orders().newest().is_none(), "an old command came through");
}

#[test]
fn while_the_bus_is_stuck_dominant_the_other_ports_work_and_nothing_is_sent_afterwards() {
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    bench.set_limits(&Limits { time_to_live_ms: 100, ..Limits::GENEROUS }).unwrap();
    let mut client = bench.client().unwrap();
    emulator(&bench).fault("bus 0").unwrap();
    client.set_timeout(Duration::from_secs(2));
    assert!(matches!(client.nst(CAN_UNIT).set_zero(), Err(Error::Timeout)), "NST: silence");
    client.set_timeout(PATIENCE);
    assert_eq!(bridge::counters(&mut client, port::CAN).unwrap().expired, 1);
    emulator(&bench).fault("bus 1").unwrap();
    bench.set_limits(&Limits::GENEROUS).unwrap();
    let mut client = bench.client().unwrap();
    client.nst(RS485_A_UNIT).sample().unwrap();
    until(|| client.nst(CAN_UNIT).sample().is_ok());
    assert!(bench.can.lock().sensor(1).unwrap().orders().newest().is_none(), "an old command came through");
}
