//! The firmware's image on the emulated STM32F405, with simulated devices on its ports.

#![cfg(unix)]

mod common;

use jointbus_host_tests::bench::{Bench, Bridge, CAN_UNIT, OUTPUTS_UNIT, RS485_A_UNIT, RS485_B_UNIT};
use jointbus_host_tests::bridge::{self, Limits, port};
use jointbus_host_tests::client::{self, Client, Error};
use jointbus_host_tests::emulator::{Emulator, Options, Port};
use jointbus_protocol::modbus::{ExceptionCode, Request, rtu};
use jointbus_protocol::nst::Sample;
use jointbus_protocol::time::Instant as Moment;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// From the first to the last moment that a device could have told something.
const START: Moment = Moment::from_micros(0);
const END: Moment = Moment::from_micros(u64::MAX);

/// Only a hang reaches it.
const PATIENCE: Duration = Duration::from_secs(120);

fn options() -> Options {
    Options::new(common::image(), common::plugin())
}

fn emulator(bench: &Bench) -> &Emulator {
    match &bench.bridge {
        Bridge::Emulated(emulator) => emulator,
        Bridge::InProcess(_) => unreachable!("these tests run the image"),
    }
}

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
    client.modbus(OUTPUTS_UNIT).write_values(4, &[2.5f32.to_bits(), 1]).unwrap();
    assert_eq!(client.modbus(OUTPUTS_UNIT).read_values(4, 2).unwrap(), [2.5f32.to_bits(), 1]);
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
    assert_eq!((counters.sent, counters.received), (16 + 3 + 2, 2 + 16 + 3));
}

#[test]
fn a_polling_slot_is_read_as_one_block() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    // slot 2: the sensor on CAN, each 5 ms
    client.modbus(bridge::UNIT).write_registers(0x0054, &[CAN_UNIT.into(), 50]).unwrap();
    let mut last = 0;
    for _ in 0..50 {
        let block = client.modbus(bridge::UNIT).read_input_registers(0x0140, 24).unwrap();
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
    until(|| client.modbus(bridge::UNIT).read_input_registers(0x0143, 1).unwrap()[0] > 50);
}

#[test]
fn an_unplugged_device_is_told_in_time_and_comes_back() {
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().nst(CAN_UNIT).sample().unwrap();
    let limits = Limits { read_ms: 50, write_ms: 50, hold_off_ms: 50, ..Limits::GENEROUS };
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
    assert_eq!((counters.received, counters.foreign), (1, 1));
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1, "no reset came between");
}

/// Probe period in ms, which the tests of the store change and look for.
const PROBE_PERIOD: u16 = 0x0041;
const SAVE: u16 = 0x5A7E;

/// A file for the flash, gone when it is dropped.
struct FlashFile(PathBuf);

impl FlashFile {
    fn new(name: &str) -> Self {
        Self(std::env::temp_dir().join(format!("jointbus-{name}-{}", std::process::id())))
    }

    fn options(&self) -> Options {
        Options { flash: Some(self.0.clone()), ..options() }
    }
}

impl Drop for FlashFile {
    fn drop(&mut self) {
        // it may never have been made
        let _ = std::fs::remove_file(&self.0);
    }
}

#[test]
fn saved_settings_outlive_the_power() {
    let file = FlashFile::new("saved");
    let bench = Bench::emulated(&file.options()).unwrap();
    let mut client = bench.client().unwrap();
    client.modbus(bridge::UNIT).write_register(PROBE_PERIOD, 777).unwrap();
    client.modbus(bridge::UNIT).write_register(0, SAVE).unwrap();
    drop(bench);
    let bench = Bench::emulated(&file.options()).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 0);
    assert_eq!(client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap(), [777]);
    client.nst(CAN_UNIT).sample().unwrap();
}

#[test]
fn a_power_cut_while_settings_are_saved_leaves_the_former_or_the_new_ones() {
    let file = FlashFile::new("cut");
    let mut known = 1000;
    for round in 1..=8u16 {
        let bench = Bench::emulated(&file.options()).unwrap();
        let mut client = bench.client().unwrap();
        assert_eq!(bridge::about(&mut client).unwrap().health, 0, "the store is readable");
        let found = client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap()[0];
        assert!(found == known || found == known + 1, "{found} is neither {known} nor the next");
        if round == 1 {
            client.modbus(bridge::UNIT).write_register(0, SAVE).unwrap();
        }
        known = found;
        client.modbus(bridge::UNIT).write_register(PROBE_PERIOD, known + 1).unwrap();
        let save = Request::WriteSingleRegister { address: 0, value: SAVE };
        let mut frame = [0; 8];
        client.send(rtu::encode_request(bridge::UNIT, &save, &mut frame).unwrap()).unwrap();
        // the moment of the cut is left to chance and spread a little
        std::thread::sleep(Duration::from_micros(u64::from(round) * 700));
        drop(bench);
    }
}

#[test]
fn an_unreadable_store_gives_the_defaults_and_says_so() {
    let file = FlashFile::new("unreadable");
    std::fs::write(&file.0, [0x5A; 2 * 128 * 1024]).unwrap();
    let bench = Bench::emulated(&file.options()).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 1 << 3);
    assert_eq!(client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap(), [1000]);
    client.modbus(bridge::UNIT).write_register(0, SAVE).unwrap();
    drop(bench);
    let bench = Bench::emulated(&file.options()).unwrap();
    assert_eq!(bridge::about(&mut bench.client().unwrap()).unwrap().health, 0);
}

#[test]
fn the_reboot_command_is_answered_and_then_carried_out() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    client.modbus(bridge::UNIT).write_register(0, 0xB007).unwrap();
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 3));
}

#[test]
fn a_hard_fault_leads_to_a_reset_whose_cause_is_told() {
    let debugger = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut options = options();
    options.arguments = vec!["-gdb".into(), format!("tcp:{debugger}").into()];
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1);
    jump(debugger, 0xF000_0000);
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 5));
    client.modbus(bridge::UNIT).write_register(0, 0xB007).unwrap();
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 3));
}

#[test]
fn a_main_loop_that_stands_still_is_reset_by_the_watchdog() {
    let debugger = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let arguments = vec!["-gdb".into(), format!("tcp:{debugger}").into()];
    let options = Options { watchdog: true, icount: Some(3), arguments, ..options() };
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1, "it was fed all the time");
    jump(debugger, standstill());
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 4));
}

/// An address in the image at which the processor jumps to where it is.
fn standstill() -> u32 {
    const BRANCH_TO_ITSELF: [u8; 2] = [0xFE, 0xE7];
    const FLASH: u32 = 0x0800_0000;
    let binary = std::fs::read(common::image().with_extension("bin")).unwrap();
    let place = binary.as_chunks::<2>().0.iter().position(|code| *code == BRANCH_TO_ITSELF);
    FLASH + 2 * u32::try_from(place.expect("every image has such an instruction")).unwrap()
}

/// Sends the processor to an address, with the debugger's remote protocol.
fn jump(debugger: SocketAddr, address: u32) {
    /// Sends a packet and waits for the `reply` to it.
    fn packet(stream: &mut TcpStream, content: &str, reply: &str) {
        let sum = content.bytes().fold(0u8, u8::wrapping_add);
        write!(stream, "${content}#{sum:02x}").unwrap();
        let mut seen = Vec::new();
        while !String::from_utf8_lossy(&seen).contains(reply) {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            seen.extend(byte);
        }
        stream.write_all(b"+").unwrap();
    }
    let mut stream = TcpStream::connect(debugger).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    // connecting stops the processor; registers can be written once their description was read
    packet(&mut stream, "qXfer:features:read:target.xml:0,fff", "</target>");
    // register 15 is the program counter, its value in memory order
    packet(&mut stream, &format!("Pf={:08x}", address.swap_bytes()), "$OK#");
    packet(&mut stream, "D", "$OK#");
}

fn until(mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !reached() {
        assert!(Instant::now() < deadline, "not reached in {PATIENCE:?}");
    }
}
