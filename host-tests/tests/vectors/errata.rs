//! `errata.csv`: for each thing that a manual prints wrongly, the stack does the corrected thing.

use super::{bytes, daq, station};
use jointbus_protocol::checksum;
use jointbus_protocol::modbus::{AddressRange, ExceptionCode, Request, Response, rtu};
use jointbus_protocol::ndam9010::register::Area;
use jointbus_protocol::ndam9010::{CHANNELS_MAX, Layout, RamModule, Station, StationError, dispatch};
use jointbus_protocol::nst::can::{
    FRAMES_MAX, FrameType, Identifier, Outcome, Reassembler, TRANSFER_MAX, segment,
};
use jointbus_protocol::nst::register::{ADDRESS, DATA};
use jointbus_protocol::nst::{self, FunctionCode, serial};
use jointbus_protocol::time::{Duration, Instant};

#[test]
fn every_erratum_is_corrected() {
    let mut reader = csv::Reader::from_reader(include_bytes!("../../vectors/errata.csv").as_slice());
    let mut checked = 0;
    for record in reader.records() {
        let record = record.unwrap();
        println!("{} ({}): {}", &record[0], &record[2], &record[5]);
        match &record[0] {
            "nst-c-read-rep" => read_replies_have_code_03_and_10_is_a_quirk(),
            "nst-can-counter" => the_counter_has_four_bits(),
            "nst-crc-order" => the_low_byte_of_the_crc_comes_first(),
            "nst-address-count" => there_are_127_addresses(),
            "ndam-lrc" => the_lrc_of_the_corrected_bytes_is_fc(),
            "ndam-do-bit-rep" => the_reply_to_05_repeats_the_request(&record[3], &record[5]),
            "ndam-0f-reply-range" => the_reply_to_0f_has_the_bit_address(),
            "ndam-10-ao-range" => analog_outputs_are_written_at_0060(),
            "ndam-fc-table" => bits_have_codes_01_02_05_0f(),
            "ndam-3-12-data" => a_register_has_two_bytes(),
            "ndam-ao-range" => the_area_ends_at_007f_and_a_module_has_16(),
            "ndam-3-27" => four_registers_are_four_channels(),
            "ndam-slave-range" => units_end_at_247(),
            "ndam-3-11" => the_table_at_0060_is_analog_outputs(),
            other => panic!("{other} has no check"),
        }
        checked += 1;
    }
    assert_eq!(checked, 14);
}

/// What the module answers.
fn ask<'d>(module: &mut RamModule, request: &Request<'_>, data: &'d mut [u8]) -> Response<'d> {
    Response::decode(dispatch(module, request, data).expect("room")).expect("a response")
}

fn module() -> RamModule {
    station().modules()[0].clone()
}

fn refusal(request: &Request<'_>) -> Response<'static> {
    Response::exception(request.function(), ExceptionCode::IllegalDataAddress)
}

fn read_replies_have_code_03_and_10_is_a_quirk() {
    let read = nst::Request::read(DATA.first, 18);
    let mut data = [0; 18];
    let reply = daq(1).dispatch(&read, &mut data).unwrap();
    assert!(matches!(reply, nst::Response::Data { function: FunctionCode::Read, .. }));

    // as printed, with data of our own
    let mut body = vec![0x10, 0x12];
    body.extend(0..18);
    let mut reassembler = Reassembler::<1>::new(2, Duration::from_millis(10));
    let frames: Vec<_> = segment(1, 2, &body).unwrap().collect();
    let identifiers = [0x0001_0220, 0x0001_0241, 0x0001_0282];
    let mut joined = Vec::new();
    for (frame, identifier) in frames.iter().zip(identifiers) {
        assert_eq!(frame.id(), jointbus_protocol::can::Id::Extended(identifier));
        if let Some(Outcome::Complete { body, .. }) = reassembler.push(frame, Instant::default()).outcome {
            joined = body.to_vec();
        }
    }
    assert_eq!((frames.len(), &joined), (3, &body));
    let expected = serial::ExpectedResponse::new(1, &read);
    assert!(!expected.accepts_body(&joined) && expected.accepts_legacy_code(&joined));
    assert!(!expected.accepts_legacy_code(&joined[..19]), "the length decides");
    assert_eq!(
        nst::Response::decode(&joined),
        Ok(nst::Response::Data { function: FunctionCode::Write, data: &body[2..] })
    );
}

fn the_counter_has_four_bits() {
    let body = [7; TRANSFER_MAX];
    let frames: Vec<_> = segment(1, 2, &body).unwrap().collect();
    assert_eq!(frames.len(), FRAMES_MAX);
    let mut reassembler = Reassembler::<1>::new(2, Duration::from_millis(10));
    for (number, frame) in frames.iter().enumerate() {
        let jointbus_protocol::can::Id::Extended(raw) = frame.id() else { panic!("29 bits") };
        let identifier = Identifier::from_raw(raw).unwrap();
        assert_eq!(usize::from(identifier.counter), number);
        let place = match number {
            0 => FrameType::First,
            15 => FrameType::Last,
            _ => FrameType::Middle,
        };
        assert_eq!(identifier.frame_type, place, "bit 4 belongs to the type, also in the sixteenth frame");
        let outcome = reassembler.push(frame, Instant::default()).outcome;
        let whole = Outcome::Complete { source: 1, destination: 2, body: &body };
        assert_eq!(outcome, Some(if number == 15 { whole } else { Outcome::More }));
    }
}

fn the_low_byte_of_the_crc_comes_first() {
    let mut buffer = [0; 7];
    let frame = serial::encode_request(1, &nst::Request::read(DATA.first, 18), &mut buffer).unwrap();
    // printed in 4.3.1.10
    assert_eq!(frame, bytes("01 03 02 00 12 38 49"));
    assert!(serial::Frame::decode(&bytes("01 03 02 00 12 49 38")).is_none());
}

fn there_are_127_addresses() {
    let accepted = |address: &u8| {
        let write = nst::Request::Write { register: ADDRESS.first, data: &[*address] };
        let mut daq = daq(1);
        let stored = daq.dispatch(&write, &mut []).is_ok();
        daq.restart();
        assert_eq!(daq.address(), if stored { *address } else { 1 });
        stored
    };
    assert!((0..=u8::MAX).filter(accepted).eq(0x01..=0x7F));
}

fn the_lrc_of_the_corrected_bytes_is_fc() {
    assert_eq!(checksum::lrc(&bytes("02 01 00 00 00 01")), 0xFC);
    assert_eq!(checksum::lrc(&bytes("02 01 00 00 01")), 0xFC, "FA was never right");
}

fn the_reply_to_05_repeats_the_request(printed: &str, corrected: &str) {
    assert!(rtu::Frame::decode(&bytes(printed)).is_err());
    let corrected = bytes(corrected.rsplit(": ").next().unwrap());
    let (mut station, mut out) = (station(), [0xEE; 8]);
    assert_eq!(station.serve(&corrected, &mut out), Ok(corrected.as_slice()));
    assert_eq!(station.modules()[0].outputs, 1);
}

fn the_reply_to_0f_has_the_bit_address() {
    let range = AddressRange::new(0x0200, 10);
    let request = Request::WriteMultipleCoils { range, data: &[0xCD, 0x01] };
    let function = request.function();
    assert_eq!(ask(&mut module(), &request, &mut [0; 5]), Response::WriteMultiple { function, range });
    let request = Request::WriteMultipleCoils { range: AddressRange::new(0x0020, 10), data: &[0xCD, 0x01] };
    assert_eq!(ask(&mut module(), &request, &mut [0; 5]), refusal(&request), "there are inputs");
}

fn analog_outputs_are_written_at_0060() {
    let mut module = module();
    let write =
        |start| Request::WriteMultipleRegisters { range: AddressRange::new(start, 1), data: &[0x12, 0x34] };
    ask(&mut module, &write(0x0020), &mut [0; 5]);
    assert_eq!((module.outputs, module.analog_outputs[0]), (0x1234, 0), "digital outputs are at 0x0020");
    module.outputs = 0;
    ask(&mut module, &write(0x0060), &mut [0; 5]);
    assert_eq!((module.outputs, module.analog_outputs[0]), (0, 0x1234));
}

fn bits_have_codes_01_02_05_0f() {
    for (pdu, reply) in [
        ("01 02 00 00 01", "01 01 00"),
        ("02 02 00 00 01", "02 01 00"),
        ("05 02 00 FF 00", "05 02 00 FF 00"),
        ("0F 02 00 00 01 01 01", "0F 02 00 00 01"),
    ] {
        let (pdu, mut data, mut buffer) = (bytes(pdu), [0; 10], [0; 8]);
        let response = ask(&mut module(), &Request::decode(&pdu).unwrap(), &mut data);
        let mut writer = jointbus_protocol::wire::Writer::new(&mut buffer);
        response.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), bytes(reply));
    }
    // 15 as a hexadecimal number is another code, which nothing here has
    let request = Request::decode(&[0x15, 0, 0]).unwrap();
    let refused = Response::exception(request.function(), ExceptionCode::IllegalFunction);
    assert_eq!(ask(&mut module(), &request, &mut [0; 5]), refused);
}

fn a_register_has_two_bytes() {
    let mut module = module();
    module.inputs = 0x00A5;
    let request = Request::ReadInputRegisters(AddressRange::new(0, 1));
    let mut data = [0; 10];
    assert_eq!(
        ask(&mut module, &request, &mut data),
        Response::Read { function: request.function(), data: &[0x00, 0xA5] }
    );
}

fn the_area_ends_at_007f_and_a_module_has_16() {
    for address in 0x0060..=0x007F {
        assert_eq!(Area::of_register(address), Some(Area::AnalogOutput));
    }
    assert_eq!(Area::of_register(0x0080), None);
    let mut module = RamModule::new(Layout { analog_outputs: CHANNELS_MAX, ..Layout::default() });
    for address in 0x0060..=0x007F {
        let request = Request::WriteSingleRegister { address, value: 1 };
        let written = Response::WriteSingle { function: request.function(), address, value: 1 };
        let expected = if address < 0x0070 { written } else { refusal(&request) };
        assert_eq!(ask(&mut module, &request, &mut [0; 5]), expected, "{address:#06x}");
    }
    assert_eq!(module.analog_outputs, [1; 16]);
}

fn four_registers_are_four_channels() {
    let mut module = module();
    let data = [1u16, 2, 3, 4].map(u16::to_be_bytes).concat();
    let request = Request::WriteMultipleRegisters { range: AddressRange::new(0x0060, 4), data: &data };
    ask(&mut module, &request, &mut [0; 5]);
    assert_eq!(module.analog_outputs[..5], [1, 2, 3, 4, 0]);
    let short = Request::WriteMultipleRegisters { range: AddressRange::new(0x0060, 5), data: &data };
    let refused = Response::exception(short.function(), ExceptionCode::IllegalDataValue);
    assert_eq!(ask(&mut module, &short, &mut [0; 5]), refused);
}

fn units_end_at_247() {
    let make = |start| Station::new([RamModule::new(Layout::default())], start).err();
    for start in 0..=u8::MAX {
        let expected = if (1..=247).contains(&start) { None } else { Some(StationError::StartId) };
        assert_eq!(make(start), expected, "{start}");
    }
}

fn the_table_at_0060_is_analog_outputs() {
    let mut module = module();
    module.analog_outputs[0] = 0x0600;
    let request = Request::ReadHoldingRegisters(AddressRange::new(0x0060, 1));
    let mut data = [0; 10];
    assert_eq!(
        ask(&mut module, &request, &mut data),
        Response::Read { function: request.function(), data: &[0x06, 0x00] }
    );
}
