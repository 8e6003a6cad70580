//! What becomes of a request that a device does not answer, or answers too late.

use super::*;

#[test]
fn an_unplugged_device_is_told_in_time_and_comes_back() {
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    let limits = Limits { read_ms: 50, write_ms: 50, late_response_window_ms: 50, ..Limits::GENEROUS };
    bench.set_limits(&limits).unwrap();
    let mut client = bench.client().unwrap();
    bench.can.lock().sensor(1).unwrap().set_plugged(false);
    bench.rs485_a.lock().sensor(1).unwrap().set_plugged(false);
    bench.rs485_b.lock().set_plugged(false);

    let refused = client.modbus(RS485_B_UNIT).read_coils(0x0200, 8);
    let expected = ExceptionCode::GatewayTargetDeviceFailedToRespond;
    assert!(matches!(refused, Err(Error::Exception(code)) if code == expected), "{refused:?}");
    client.set_timeout(Duration::from_secs(2));
    assert!(matches!(client.nst(CAN_UNIT).sample(), Err(Error::Timeout)), "NST: silence");
    assert!(matches!(client.nst(RS485_A_UNIT).sample(), Err(Error::Timeout)), "NST: silence");
    for port in [port::CAN, port::RS485_A, port::RS485_B] {
        let counters = bridge::counters(&mut client, port).unwrap();
        assert_eq!((counters.timeouts, counters.retries), (2, 1), "port {port}");
    }

    bench.can.lock().sensor(1).unwrap().set_plugged(true);
    bench.rs485_a.lock().sensor(1).unwrap().set_plugged(true);
    bench.rs485_b.lock().set_plugged(true);
    // an attempt may come too late for so short a limit, so it is tried until it is not
    until(|| client.nst(CAN_UNIT).sample().is_ok());
    until(|| client.nst(RS485_A_UNIT).sample().is_ok());
    until(|| client.modbus(RS485_B_UNIT).read_coils(0x0200, 8).is_ok());
}

#[test]
fn addresses_are_rewritten_on_the_way_out_and_back() {
    let mut bare = Bare::start(&Limits::GENEROUS);
    let (mut rs485_a, mut rs485_b) = (bare.device(Port::Usart2), bare.device(Port::Usart3));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // unit 34 is the station's unit 3
            assert_eq!(take::<8>(&mut rs485_b), frame(&[3, 4, 0, 0x40, 0, 1])[..]);
            rs485_b.write_all(&frame(&[3, 4, 2, 0x12, 0x34])).unwrap();
            // unit 17 is the sensor with address 2
            assert_eq!(take::<7>(&mut rs485_a), frame(&[2, 3, 2, 0, 2])[..]);
            rs485_a.write_all(&frame(&[2, 3, 2, 0xAB, 0xCD])).unwrap();
        });
        let client = &mut bare.client;
        assert_eq!(client.modbus(34).read_input_registers(0x0040, 1).unwrap(), [0x1234]);
        assert_eq!(client.nst(17).read(0x0200, 2).unwrap(), [0xAB, 0xCD]);
    });
    let mut can = bare.device(Port::Can);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // unit 5 is node 5; the bridge is node 127, 0x7F
            assert_eq!(&take::<19>(&mut can), b"T007F0510403020002\r");
            can.write_all(b"T00057F1040302BEEF\r").unwrap();
        });
        assert_eq!(bare.client.nst(5).read(0x0200, 2).unwrap(), [0xBE, 0xEF]);
    });
}

#[test]
fn a_late_reply_is_given_to_no_other_request() {
    // the first attempt runs out, then its reply is owed for longer than this test takes
    let limits = Limits { read_ms: 200, retries: 0, late_response_window_ms: 60_000, ..Limits::GENEROUS };
    let mut bare = Bare::start(&limits);
    let mut device = bare.device(Port::Usart3);
    let refused = bare.client.modbus(RS485_B_UNIT).read_input_registers(0x0040, 1);
    let expected = ExceptionCode::GatewayTargetDeviceFailedToRespond;
    assert!(matches!(refused, Err(Error::Exception(code)) if code == expected), "{refused:?}");
    assert_eq!(take::<8>(&mut device), frame(&[1, 4, 0, 0x40, 0, 1])[..]);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // the late reply to the first request would fit the second one, which waits for it
            device.write_all(&frame(&[1, 4, 2, 0x11, 0x11])).unwrap();
            assert_eq!(take::<8>(&mut device), frame(&[1, 4, 0, 0x41, 0, 1])[..]);
            device.write_all(&frame(&[1, 4, 2, 0x22, 0x22])).unwrap();
        });
        let answer = bare.client.modbus(RS485_B_UNIT).read_input_registers(0x0041, 1).unwrap();
        assert_eq!(answer, [0x2222]);
    });
    let counters = bridge::counters(&mut bare.client, port::RS485_B).unwrap();
    assert_eq!((counters.foreign_or_late, counters.timeouts), (1, 1));
}

#[test]
fn a_device_in_quarantine_is_refused_at_once_and_returns_with_its_first_answer() {
    /// Quarantined units of the route to the station, the first in bit 0.
    const QUARANTINED: u16 = 0x020C;
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().modbus(RS485_B_UNIT).read_coils(0x0200, 8).unwrap();
    bench
        .set_limits(&Limits { read_ms: 300, retries: 0, late_response_window_ms: 1, ..Limits::GENEROUS })
        .unwrap();
    let mut client = bench.client().unwrap();
    bench.rs485_b.lock().set_plugged(false);
    let mut refusals = 0;
    until(|| {
        let refused = client.modbus(RS485_B_UNIT).read_coils(0x0200, 8);
        assert!(matches!(refused, Err(Error::Exception(_))), "{refused:?}");
        refusals += 1;
        client.modbus(bridge::UNIT).read_input_registers(QUARANTINED, 1).unwrap() == [1]
    });
    assert_eq!(refusals, 3, "three in a row");
    let before = bridge::counters(&mut client, port::HOST).unwrap().refused;
    until(|| {
        let refused = client.modbus(RS485_B_UNIT).read_coils(0x0200, 8);
        assert!(refused.is_err(), "{refused:?}");
        bridge::counters(&mut client, port::HOST).unwrap().refused > before
    });
    bench.rs485_b.lock().set_plugged(true);
    until(|| client.modbus(RS485_B_UNIT).read_coils(0x0200, 8).is_ok());
    assert_eq!(client.modbus(bridge::UNIT).read_input_registers(QUARANTINED, 1).unwrap(), [0]);
}

#[test]
fn a_reply_with_a_broken_character_is_not_taken_and_each_such_character_is_counted() {
    let limits = Limits { read_ms: 500, retries: 1, late_response_window_ms: 1, ..Limits::GENEROUS };
    let mut bare = Bare::start(&limits);
    let mut station = bare.device(Port::Usart3);
    let reply = frame(&[3, 4, 2, 0x12, 0x34]);
    let Bare { emulator, client } = &mut bare;
    // what is wrong with the first character of a reply, errors and overruns, and whether it is asked for once more
    for (flaw, errors, overruns, again) in
        [("parity", 1, 0, true), ("framing", 1, 0, true), ("noise", 1, 0, false), ("overrun", 0, 1, true)]
    {
        let before = bridge::counters(client, port::RS485_B).unwrap();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for attempt in 0..if again { 2 } else { 1 } {
                    assert_eq!(take::<8>(&mut station), frame(&[3, 4, 0, 0x40, 0, 1])[..]);
                    if attempt == 0 {
                        emulator.fault(&format!("flaw 3 {flaw}")).unwrap();
                    }
                    station.write_all(&reply).unwrap();
                }
            });
            assert_eq!(client.modbus(34).read_input_registers(0x0040, 1).unwrap(), [0x1234], "{flaw}");
        });
        let after = bridge::counters(client, port::RS485_B).unwrap();
        assert_eq!(after.checksum_errors - before.checksum_errors, errors, "{flaw}");
        assert_eq!(after.overruns - before.overruns, overruns, "{flaw}");
        assert_eq!(after.retries - before.retries, u32::from(again), "{flaw}");
    }
}
