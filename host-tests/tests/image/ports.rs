//! Every port and unit of the board, in order and with parts of it missing.

use super::*;
use jointbus::bench::OUTPUTS_UNIT;
use jointbus::client::WordOrder;
use jointbus_mcu_bridge::registers;
use jointbus_protocol::nst::Sample;
use jointbus_protocol::time::Instant as Moment;
use std::time::Instant;

/// From the first to the last moment that a device could have told something.
const START: Moment = Moment::from_micros(0);
const END: Moment = Moment::from_micros(u64::MAX);

#[test]
fn every_device_is_read_and_written_through_the_image() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let about = bridge::about(&mut client).unwrap();
    assert_eq!((about.reset_cause, about.health), (1, 0), "power-on, crystal and CAN are there");
    for _ in 0..10 {
        let start = bench.clock().now();
        let on_can = client.nst(CAN_UNIT).sample().unwrap();
        let on_serial = client.nst(RS485_A_UNIT).sample().unwrap();
        let end = bench.clock().now();
        let mut can = bench.can.lock();
        assert!(can.sensor(1).unwrap().told().between(start, end).any(|(_, told)| *told == on_can));
        let mut serial = bench.rs485_a.lock();
        assert!(serial.sensor(1).unwrap().told().between(start, end).any(|(_, told)| *told == on_serial));
    }
    client.modbus(RS485_B_UNIT).write_registers(0x0060, &[1, 2, 3, 4]).unwrap();
    assert_eq!(bench.rs485_b.lock().module(0).unwrap().analog_outputs[..4], [1, 2, 3, 4]);
    client.modbus(OUTPUTS_UNIT).write_values(4, &[2.5f32.to_bits(), 1], WordOrder::LowFirst).unwrap();
    assert_eq!(
        client.modbus(OUTPUTS_UNIT).read_holding_values::<u32>(4, 2, WordOrder::LowFirst).unwrap(),
        [2.5f32.to_bits(), 1]
    );
    let counters = bridge::counters(&mut client, port::CAN).unwrap();
    assert_eq!((counters.received, counters.sent, counters.overruns), (30, 10, 0), "three frames a reply");
}

#[test]
fn the_clock_of_the_image_never_jumps() {
    let start = Instant::now();
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let mut last = 0;
    for _ in 0..3000 {
        let uptime = bridge::about(&mut client).unwrap().uptime_us;
        assert!(uptime > last, "{last} us, then {uptime} us");
        last = uptime;
    }
    assert!(u128::from(last) <= start.elapsed().as_micros(), "{last} us is more than has passed");
}

#[test]
fn reads_and_writes_longer_than_a_can_transfer_are_split() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    let matrix: Vec<u8> = (0..144).collect();
    client.nst(CAN_UNIT).write(0x00E3, &matrix).unwrap();
    assert_eq!(client.nst(CAN_UNIT).read(0x00E3, 144).unwrap(), matrix);
    let counters = bridge::counters(&mut client, port::CAN).unwrap();
    // 124 and 20 bytes written are 16 and 3 frames, two reads are one each; two acknowledgements, then 16 and 3 frames
    let expected = (16 + 3 + 2, 2 + 16 + 3);
    if counters.retries == 0 {
        assert_eq!((counters.sent, counters.received), expected);
    } else {
        // a host that is busy elsewhere may tear a reply apart, which is then asked for again
        assert!(counters.sent > expected.0 && counters.received >= expected.1, "{counters:?}");
    }
}

#[test]
fn a_polling_slot_is_read_as_one_block() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    // slot 2: the sensor on CAN, each 5 ms
    client.modbus(bridge::UNIT).write_registers(registers::SLOT_UNIT.at(2), &[CAN_UNIT.into(), 50]).unwrap();
    let mut last = 0;
    for _ in 0..50 {
        let block =
            client.modbus(bridge::UNIT).read_input_registers(registers::SLOT_STATE.at(2), 24).unwrap();
        let long = |at: usize| u32::from(block[at]) << 16 | u32::from(block[at + 1]);
        let (state, sequence) = (block[0], long(2));
        assert_eq!((block[1], long(10)), (CAN_UNIT.into(), 0), "unit and failures");
        if sequence == 0 {
            continue;
        }
        assert!((2..=3).contains(&state) && sequence >= last);
        last = sequence;
        let sample = Sample(std::array::from_fn(|axis| long(12 + 2 * axis) as i32));
        let told =
            bench.can.lock().sensor(1).unwrap().told().between(START, END).any(|(_, told)| *told == sample);
        assert!(told, "{sample:?} is none that the sensor told: torn");
    }
    until(|| {
        client.modbus(bridge::UNIT).read_input_registers(registers::SLOT_SEQUENCE.at(2) + 1, 1).unwrap()[0]
            > 50
    });
}

#[test]
fn without_a_crystal_the_image_runs_from_the_internal_oscillator() {
    let mut options = options();
    options.crystal = false;
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 1);
    client.nst(CAN_UNIT).sample().unwrap();
    client.nst(RS485_A_UNIT).sample().unwrap();
}

#[test]
fn without_a_can_controller_everything_else_works() {
    let mut bench = Bench::emulated(&Options { can_controller: false, ..options() }).unwrap();
    bench.set_limits(&Limits { time_to_live_ms: 50, ..Limits::GENEROUS }).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 1 << 1);
    client.set_timeout(Duration::from_secs(2));
    assert!(matches!(client.nst(CAN_UNIT).sample(), Err(Error::Timeout)), "NST: silence");
    client.set_timeout(PATIENCE);
    assert_eq!(bridge::counters(&mut client, port::CAN).unwrap().expired, 1);
    bench.set_limits(&Limits::GENEROUS).unwrap();
    bench.client().unwrap().nst(RS485_A_UNIT).sample().unwrap();
}
