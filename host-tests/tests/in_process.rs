//! The bench with the engine in this process: every kind of question through the bridge to a device and back, the
//! share, and devices that come and go.

use jointbus::bench::{Bench, CAN_UNIT, OUTPUTS_UNIT, RS485_A_UNIT, RS485_B_UNIT};
use jointbus::bridge::{self, Limits, port};
use jointbus::client::{self, Client, Error, WordOrder};
use jointbus_protocol::modbus::ExceptionCode;
use jointbus_protocol::nst::Sample;
use std::io::{Read, Write};
use std::time::Duration;

/// Only a hang reaches it.
const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn every_device_answers_through_the_bridge() {
    let bench = Bench::in_process().unwrap();
    let mut client = bench.client().unwrap();
    for _ in 0..20 {
        let start = bench.clock().now();
        let on_can = client.nst(CAN_UNIT).sample().unwrap();
        let on_serial = client.nst(RS485_A_UNIT).sample().unwrap();
        let end = bench.clock().now();
        let told = |log: &jointbus::devices::Log<Sample>, sample| {
            log.between(start, end).any(|(_, told)| *told == sample)
        };
        assert!(told(bench.can.lock().sensor(1).unwrap().told(), on_can));
        assert!(told(bench.rs485_a.lock().sensor(1).unwrap().told(), on_serial));
    }
    client.modbus(RS485_B_UNIT).write_registers(0x0060, &[1, 2, 3, 4]).unwrap();
    assert_eq!(bench.rs485_b.lock().module(0).unwrap().analog_outputs[..4], [1, 2, 3, 4]);
    client.modbus(OUTPUTS_UNIT).write_values(4, &[2.5f32.to_bits(), 1], WordOrder::LowFirst).unwrap();
    assert_eq!(
        client.modbus(OUTPUTS_UNIT).read_holding_values::<u32>(4, 2, WordOrder::LowFirst).unwrap(),
        [2.5f32.to_bits(), 1]
    );
    let about = bridge::about(&mut client).unwrap();
    assert_eq!((about.map_version, about.version), (bridge::MAP_VERSION, jointbus::version()));
    let on_can = bridge::counters(&mut client, port::CAN).unwrap();
    assert!(on_can.received >= 20 && on_can.timeouts == 0, "{on_can:?}");
}

#[test]
fn a_device_without_its_plug_times_out_and_returns() {
    let mut bench = Bench::in_process().unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    bench
        .set_limits(&Limits { read_ms: 20, write_ms: 20, late_response_window_ms: 20, ..Limits::GENEROUS })
        .unwrap();
    let mut client = bench.client().unwrap();
    bench.can.lock().sensor(1).unwrap().set_plugged(false);
    bench.rs485_b.lock().set_plugged(false);
    let refused = client.modbus(RS485_B_UNIT).read_coils(0x0200, 8);
    let expected = ExceptionCode::GatewayTargetDeviceFailedToRespond;
    assert!(matches!(refused, Err(Error::Exception(code)) if code == expected), "{refused:?}");
    client.set_timeout(Duration::from_millis(500));
    assert!(matches!(client.nst(CAN_UNIT).sample(), Err(Error::Timeout)));
    bench.can.lock().sensor(1).unwrap().set_plugged(true);
    bench.rs485_b.lock().set_plugged(true);
    // an attempt may come too late for so short a limit, so it is tried until it is not
    let deadline = std::time::Instant::now() + PATIENCE;
    while client.nst(CAN_UNIT).sample().is_err() || client.modbus(RS485_B_UNIT).read_coils(0x0200, 8).is_err()
    {
        assert!(std::time::Instant::now() < deadline, "the devices have not returned");
    }
}

#[test]
fn hosts_take_turns() {
    let bench = Bench::in_process().unwrap();
    let share = bench.share().unwrap();
    let address = share.listen().unwrap();
    let others: Vec<_> = (0..3)
        .map(|_| {
            std::thread::spawn(move || {
                let mut client = Client::new(client::connect(address).unwrap(), PATIENCE);
                for _ in 0..10 {
                    client.nst(CAN_UNIT).sample().unwrap();
                    client.modbus(RS485_B_UNIT).read_input_registers(0x0040, 8).unwrap();
                }
            })
        })
        .collect();
    for _ in 0..30 {
        Client::new(share.turn(), PATIENCE).nst(RS485_A_UNIT).sample().unwrap();
    }
    for other in others {
        other.join().unwrap();
    }
    // a busy machine may have the bridge ask again
    assert!(bench.can.lock().sensor(1).unwrap().told().total() >= 30);
}

#[cfg(unix)]
#[test]
fn a_program_on_the_pseudo_terminal_is_served() {
    let bench = Bench::in_process().unwrap();
    let share = bench.share().unwrap();
    let path = share.terminal().unwrap();
    for _ in 0..2 {
        let mut port = std::fs::OpenOptions::new().read(true).write(true).open(&path).unwrap();
        // unit 247, input register 0
        port.write_all(&[0xF7, 0x04, 0x00, 0x00, 0x00, 0x01, 0x25, 0x5C]).unwrap();
        let mut reply = [0; 7];
        port.read_exact(&mut reply).unwrap();
        assert_eq!(reply[..5], [0xF7, 0x04, 0x02, 0x00, 0x01]);
    }
}

#[test]
fn a_client_that_leaves_without_its_reply_disturbs_nobody() {
    let bench = Bench::in_process().unwrap();
    let share = bench.share().unwrap();
    let address = share.listen().unwrap();
    for _ in 0..5 {
        let mut stream = client::connect(address).unwrap();
        stream.write_all(&[0xF7, 0x04, 0x00, 0x00, 0x00, 0x01, 0x25, 0x5C]).unwrap();
        drop(stream);
        Client::new(share.turn(), PATIENCE).nst(CAN_UNIT).sample().unwrap();
    }
}
