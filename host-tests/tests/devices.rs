//! The simulated devices and the client against each other, in memory and in virtual time.

use jointbus::client::{Client, Error};
use jointbus::devices::loopback::{Loopback, transfer};
use jointbus::devices::{Motion, NdamLine, NstCan, NstSerial, PROMPT, SerialLine, motion};
use jointbus_protocol::modbus::{ExceptionCode, FunctionCode, Request, Response};
use jointbus_protocol::ndam9010::Layout;
use jointbus_protocol::nst::register::{ADDRESS, DATA, MODEL};
use jointbus_protocol::nst::{self, SAMPLE_LENGTH, Sample, SignEncoding, serial};
use jointbus_protocol::time::{Duration as Span, Instant};
use std::time::Duration;

/// Nothing here waits: an answer is there at once or never.
const NO_TIME: Duration = Duration::ZERO;

fn nst_client(addresses: &[u8]) -> Client<Loopback<NstSerial>> {
    let line = addresses.iter().fold(NstSerial::new(PROMPT), |line, address| line.with_sensor(*address));
    Client::new(Loopback::new(line), NO_TIME)
}

fn ndam_client() -> Client<Loopback<NdamLine<2>>> {
    let layout = Layout { digital_inputs: 14, digital_outputs: 10, analog_inputs: 8, analog_outputs: 4 };
    Client::new(Loopback::new(NdamLine::new(layout, 5, PROMPT).unwrap()), NO_TIME)
}

#[test]
fn each_sensor_of_a_line_tells_its_own_motion() {
    let mut client = nst_client(&[1, 2, 127]);
    for step in 0..50u64 {
        client.stream().advance(Span::from_micros(123_457));
        let address = [1, 2, 127][(step % 3) as usize];
        let sample = client.nst(address).sample().unwrap();
        let now = client.stream().now();
        assert_eq!(sample, Motion::new(address).sample(now));
        let sensor = client.stream().line.sensor(address).unwrap();
        assert_eq!(sensor.told().newest(), Some(&(now, sample)));
    }
}

#[test]
fn a_sensor_without_its_plug_is_silent_and_returns() {
    let mut client = nst_client(&[1, 2]);
    client.stream().line.sensor(1).unwrap().set_plugged(false);
    assert!(matches!(client.nst(1).sample(), Err(Error::Timeout)));
    client.nst(2).sample().unwrap();
    client.stream().line.sensor(1).unwrap().set_plugged(true);
    client.nst(1).sample().unwrap();
    assert_eq!(client.stream().line.sensor(1).unwrap().told().total(), 1);
}

#[test]
fn settings_are_read_by_their_names() {
    let mut client = nst_client(&[7]);
    let settings = client.nst(7).settings().unwrap();
    assert_eq!((settings.address(), settings.uart1_baud(), settings.can_rate()), (7, 115_200, 1000));
    let model = client.nst(7).read_register(MODEL).unwrap();
    assert_eq!(model, settings.model());
    client.nst(7).write(ADDRESS.first, &[9]).unwrap();
    assert_eq!(client.nst(7).settings().unwrap().address(), 9);
}

#[test]
fn zero_points_and_addresses_act_after_a_restart() {
    let mut client = nst_client(&[1]);
    let zero = client.nst(1).sample().unwrap();
    client.nst(1).set_zero().unwrap();
    assert_eq!(client.nst(1).sample().unwrap(), zero);
    client.nst(1).write(ADDRESS.first, &[9]).unwrap();
    client.nst(1).restart().unwrap();
    assert!(matches!(client.nst(1).sample(), Err(Error::Timeout)));
    // that took the client a while of virtual time, so the motion has gone on
    let sample = client.nst(9).sample().unwrap();
    let moved = Motion::new(1).sample(client.stream().now());
    assert_eq!(sample, Sample(std::array::from_fn(|axis| moved.0[axis] - zero.0[axis])));
    client.nst(9).clear_zero().unwrap();
    client.nst(9).restart().unwrap();
    assert_eq!(client.nst(9).sample().unwrap(), Motion::new(1).sample(client.stream().now()));
}

#[test]
fn other_questions_to_a_sensor() {
    let mut client = nst_client(&[3]);
    let model = client.nst(3).read(MODEL.first, 16).unwrap();
    assert!(model.starts_with(b"NST-SIM"));
    assert_eq!(client.nst(3).search().unwrap(), ([0; 4], 0));
    assert!(matches!(client.nst(3).write(DATA.first, &[0]), Err(Error::Timeout)), "refused by silence");
    assert!(matches!(client.nst(3).write(0, &[0; 250]), Err(Error::Question)));
    client.nst(nst::BROADCAST).write(ADDRESS.first, &[4]).unwrap();
    client.nst(nst::BROADCAST).restart().unwrap();
    client.nst(4).sample().unwrap();
}

#[test]
fn noise_before_a_reply_is_skipped() {
    let mut client = nst_client(&[1]);
    client.stream().disturb(&[1, 3, 18, 0, 0xFF]);
    client.nst(1).sample().unwrap();
}

#[test]
fn a_late_reply_is_not_taken_for_the_next_one() {
    let mut client = nst_client(&[1, 2]);
    client.stream().line.sensor(1).unwrap().set_plugged(false);
    assert!(client.nst(1).sample().is_err());
    let mut late = [0; serial::RESPONSE_MAX];
    let data = [0x55; SAMPLE_LENGTH];
    let reply = nst::Response::Data { function: nst::FunctionCode::Read, data: &data };
    let late = serial::encode_reply(1, &reply, &mut late).unwrap().to_vec();
    client.stream().disturb(&late);
    client.stream().line.sensor(1).unwrap().set_plugged(true);
    let sample = client.nst(1).sample().unwrap();
    assert_ne!(sample, Sample::decode(&data, SignEncoding::TwosComplement));
}

#[test]
fn silence_ends_a_cut_request() {
    let mut line = NstSerial::new(PROMPT).with_sensor(1);
    let request = [0x01, 0x03, 0x02, 0x00, 0x12, 0x38, 0x49];
    assert!(line.receive(&request[..5], Instant::default()).is_empty());
    let end = line.deadline().unwrap();
    assert_eq!(end, Instant::default().saturating_add(PROMPT));
    assert!(line.poll(end).is_empty());
    assert_eq!(line.deadline(), None);
    assert_eq!(line.receive(&request, end).len(), 5 + SAMPLE_LENGTH);
}

#[test]
fn sensors_on_can_answer_the_node_that_asked() {
    let mut bus = NstCan::new(PROMPT).with_sensor(1).with_sensor(2);
    let read = [0x03, 0x02, 0x00, SAMPLE_LENGTH as u8];
    for (node, host, micros) in [(1, 127, 1_000_000), (2, 99, 3_000_000), (1, 126, 4_000_000)] {
        let now = Instant::from_micros(micros);
        let body = transfer(&mut bus, host, node, &read, now).unwrap();
        assert_eq!(body[..2], [0x03, SAMPLE_LENGTH as u8]);
        let sample = Sample::decode(body[2..].as_array().unwrap(), SignEncoding::TwosComplement);
        assert_eq!(sample, Motion::new(node).sample(now));
        assert_eq!(bus.sensor(node).unwrap().told().newest(), Some(&(now, sample)));
    }
    assert_eq!(transfer(&mut bus, 127, 3, &read, Instant::default()), None);
    bus.sensor(2).unwrap().set_plugged(false);
    assert_eq!(transfer(&mut bus, 127, 2, &read, Instant::default()), None);
}

#[test]
fn long_transfers_and_a_changed_node() {
    let mut bus = NstCan::new(PROMPT).with_sensor(1);
    let matrix: Vec<u8> = (0..124).collect();
    let write = [&[0x10, 0x00, 0xE3, 124], matrix.as_slice()].concat();
    let now = Instant::default();
    assert_eq!(transfer(&mut bus, 127, 1, &write, now).unwrap(), [0x10, 124]);
    let body = transfer(&mut bus, 127, 1, &[0x03, 0x00, 0xE3, 126], now).unwrap();
    assert_eq!(body[2..126], matrix);
    assert_eq!(transfer(&mut bus, 127, 1, &[0x03, 0x00, 0xE3, 127], now), None, "fits no transfer");
    assert_eq!(transfer(&mut bus, 127, 1, &[0x10, 0x01, 0x93, 1, 8], now).unwrap(), [0x10, 1]);
    assert_eq!(transfer(&mut bus, 127, 1, &[0x18, 0, 0, 1], now).unwrap(), [0x18, 1]);
    assert_eq!(transfer(&mut bus, 127, 1, &[0x03, 0x02, 0x00, 18], now), None);
    assert!(transfer(&mut bus, 127, 8, &[0x03, 0x02, 0x00, 18], now).is_some());
    assert_eq!(transfer(&mut bus, 127, 0xFF, &[0x19, 0x01, 0xA7, 24], now), None, "a broadcast");
}

#[test]
fn inputs_of_a_station_follow_their_functions() {
    let mut client = ndam_client();
    for step in 0..40 {
        client.stream().advance(Span::from_micros(250_000));
        let (unit, index) = if step % 2 == 0 { (5, 0) } else { (6, 1) };
        let now = client.stream().now();
        let inputs = client.modbus(unit).read_discrete_inputs(0, 14).unwrap();
        let digital = motion::digital_inputs(index, now);
        assert!(inputs.iter().enumerate().all(|(bit, on)| *on == (digital >> bit & 1 == 1)));
        let analog = client.modbus(unit).read_input_registers(0x0040, 8).unwrap();
        assert_eq!(analog, motion::analog_inputs(index, now)[..8]);
        let (at, told) = client.stream().line.told().newest().unwrap();
        assert_eq!((*at, told.unit, told.digital), (now, unit, digital));
    }
}

#[test]
fn outputs_of_a_station_are_set_and_read_back() {
    let mut client = ndam_client();
    let pattern = [true, false, true, true, false, false, true, false, true, true];
    client.modbus(5).write_coils(0x0200, &pattern).unwrap();
    assert_eq!(client.modbus(5).read_coils(0x0200, 10).unwrap(), pattern);
    client.modbus(5).write_coil(0x0201, true).unwrap();
    assert_eq!(client.stream().line.module(0).unwrap().outputs, 0b11_0100_1111);
    client.modbus(6).write_registers(0x0060, &[1, 2, 3]).unwrap();
    client.modbus(6).write_register(0x0063, 4).unwrap();
    assert_eq!(client.modbus(6).read_holding_registers(0x0060, 4).unwrap(), [1, 2, 3, 4]);
    assert_eq!(client.stream().line.module(1).unwrap().analog_outputs[..4], [1, 2, 3, 4]);
    client.modbus(0).write_registers(0x0020, &[0]).unwrap();
    assert!([0, 1].iter().all(|index| client.stream().line.module(*index).unwrap().outputs == 0));
}

#[test]
fn refusals_and_silence_of_a_station() {
    let mut client = ndam_client();
    let refused = client.modbus(5).read_input_registers(0x0048, 1);
    assert!(matches!(refused, Err(Error::Exception(ExceptionCode::IllegalDataAddress))));
    let other = Request::Other { function: FunctionCode::from_code(0x41), data: &[1, 2] };
    assert!(matches!(
        client.modbus(5).request(&other),
        Err(Error::Exception(ExceptionCode::IllegalFunction))
    ));
    assert!(matches!(client.modbus(7).read_coils(0x0200, 1), Err(Error::Timeout)));
    client.stream().line.set_plugged(false);
    assert!(matches!(client.modbus(5).read_coils(0x0200, 1), Err(Error::Timeout)));
    client.stream().line.set_plugged(true);
    client.modbus(5).read_coils(0x0200, 1).unwrap();
}

/// A server that echoes what only silence ends.
struct Echo;

impl SerialLine for Echo {
    fn receive(&mut self, bytes: &[u8], _: Instant) -> Vec<u8> {
        bytes.to_vec()
    }

    fn poll(&mut self, _: Instant) -> Vec<u8> {
        Vec::new()
    }

    fn deadline(&self) -> Option<Instant> {
        None
    }
}

#[test]
fn silence_ends_a_reply_of_unknown_length() {
    let mut client = Client::new(Loopback::new(Echo), Duration::from_secs(60));
    let function = FunctionCode::from_code(0x41);
    let pdu = client.modbus(1).request(&Request::Other { function, data: &[1, 2, 3] }).unwrap();
    assert_eq!(Response::decode(&pdu), Ok(Response::Other { function, data: &[1, 2, 3] }));
}
