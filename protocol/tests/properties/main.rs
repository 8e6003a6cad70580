//! Properties that hold for any input: round trips in every framing, no panic, bounded output, a good request after
//! any garbage is answered, and a response always fits its request.

mod values;

use jointbus_protocol::can::{Frame as CanFrame, Id};
use jointbus_protocol::checksum;
use jointbus_protocol::decode::{Event, FrameDecoder, FrameEvent, Match, ResponseMatcher, STRAY_MAX};
use jointbus_protocol::modbus::identification::Objects;
use jointbus_protocol::modbus::line::{self, MultidropDecoder};
use jointbus_protocol::modbus::rtu::{ExpectedResponse, FRAME_MAX};
use jointbus_protocol::modbus::server::{self, RamTables};
use jointbus_protocol::modbus::{AddressRange, PDU_MAX, Request, Response, ascii, rtu, tcp};
use jointbus_protocol::ndam9010::{self, Layout, RamModule, Station};
use jointbus_protocol::nst::{self, Daq, RamHardware, SignEncoding};
use jointbus_protocol::nxi6201::{self, Card, Settings};
use jointbus_protocol::slcan;
use jointbus_protocol::time::{Duration, Instant};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::FileFailurePersistence;
use values::{any_objects, any_request, any_response, nst_request, response, right_request};

const SILENCE: Duration = Duration::from_millis(5);
const START: Instant = Instant::from_micros(0);

type Tables = RamTables<32, 32, 300, 300>;

fn sealed(content: &[u8]) -> Vec<u8> {
    [content, &checksum::crc16(content).to_le_bytes()].concat()
}

fn station() -> Station<RamModule, 2> {
    let layout = Layout { digital_inputs: 16, digital_outputs: 10, analog_inputs: 8, analog_outputs: 4 };
    Station::new([RamModule::new(layout), RamModule::new(layout)], 5).unwrap()
}

fn card() -> Card<nxi6201::RamHardware> {
    Card::power_up(nxi6201::RamHardware::default(), &Settings::default()).unwrap()
}

fn daq() -> Daq<RamHardware> {
    Daq::new(RamHardware::new(5), SignEncoding::default())
}

/// Failing cases are kept beside this file.
fn config() -> ProptestConfig {
    let failure_persistence = FileFailurePersistence::WithSource("regressions");
    ProptestConfig { failure_persistence: Some(Box::new(failure_persistence)), ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn requests_survive_every_framing(request in any_request(), unit: u8, transaction: u16) {
        let request = request.value();
        let mut buffer = [0xEE; ascii::FRAME_MAX];

        let frame = rtu::encode_request(unit, &request, &mut buffer).unwrap();
        prop_assert!(frame.len() <= rtu::FRAME_MAX);
        let decoded = rtu::Frame::decode(frame).unwrap();
        prop_assert_eq!((decoded.unit, Request::decode(decoded.pdu)), (unit, Ok(request)));

        let mut frame = ascii::encode_request(unit, &request, &mut buffer).unwrap();
        let mut decoder = ascii::Decoder::new();
        let Some(Event::Frame(decoded)) = decoder.feed(&mut frame, START) else { panic!("a frame") };
        prop_assert_eq!((decoded.unit, Request::decode(decoded.pdu)), (unit, Ok(request)));

        let mut frame = tcp::encode_request(transaction, unit, &request, &mut buffer).unwrap();
        let mut decoder = tcp::Decoder::new();
        let Some(Event::Frame(decoded)) = decoder.feed(&mut frame, START) else { panic!("a frame") };
        prop_assert_eq!((decoded.transaction, decoded.unit), (transaction, unit));
        prop_assert_eq!(Request::decode(decoded.pdu), Ok(request));
    }

    #[test]
    fn responses_survive_every_framing(any in any_response(), objects in any_objects(), unit: u8) {
        let response = response(&any, &objects);
        let mut buffer = [0xEE; ascii::FRAME_MAX];

        let frame = rtu::encode_response(unit, &response, &mut buffer).unwrap();
        let decoded = rtu::Frame::decode(frame).unwrap();
        prop_assert_eq!((decoded.unit, Response::decode(decoded.pdu)), (unit, Ok(response)));

        let mut content = [0; ascii::CONTENT_MAX + 1];
        let frame = ascii::encode_response(unit, &response, &mut buffer).unwrap();
        let decoded = ascii::Frame::decode(frame, &mut content).unwrap();
        prop_assert_eq!((decoded.unit, Response::decode(decoded.pdu)), (unit, Ok(response)));

        let mut frame = tcp::encode_response(1, unit, &response, &mut buffer).unwrap();
        let mut decoder = tcp::Decoder::new();
        let Some(Event::Frame(decoded)) = decoder.feed(&mut frame, START) else { panic!("a frame") };
        prop_assert_eq!((decoded.unit, Response::decode(decoded.pdu)), (unit, Ok(response)));
    }

    #[test]
    fn nst_bodies_survive_every_framing(
        kind in 0..8u8,
        register: u16,
        length: u8,
        address: u8,
        data in vec(any::<u8>(), 0..=nst::WRITE_DATA_MAX),
    ) {
        let request = nst_request(kind, register, length, &data);
        let mut buffer = [0xEE; nst::serial::REQUEST_MAX];
        let frame = nst::serial::encode_request(address, &request, &mut buffer).unwrap().to_vec();
        let decoded = nst::serial::Frame::decode(&frame).unwrap();
        prop_assert_eq!(decoded.address, address);
        prop_assert_eq!(nst::Request::decode(decoded.body), Ok(request));

        let stream = nst::stream::encode_request(address, &request, &mut buffer).unwrap();
        prop_assert_eq!(nst::stream::split(stream), Some((address, decoded.body)));

        match nst::can::segment(1, address, decoded.body) {
            Ok(frames) => {
                let mut reassembler = nst::can::Reassembler::<2>::new(address, SILENCE);
                let mut body = None;
                for frame in frames {
                    prop_assert!(body.is_none());
                    if let Some(nst::can::Outcome::Complete { body: joined, .. }) =
                        reassembler.push(&frame, START).outcome
                    {
                        body = Some(joined.to_vec());
                    }
                }
                prop_assert_eq!(body.as_deref(), Some(decoded.body));
            }
            Err(_) => prop_assert!(decoded.body.len() > nst::can::TRANSFER_MAX),
        }
    }

    #[test]
    fn nst_replies_survive(kind in 0..7u8, length: u8, data in vec(any::<u8>(), 1..=nst::REPLY_DATA_MAX)) {
        let function =
            nst::FunctionCode::from_code([0x03, 0x15, 0x10, 0x12, 0x13, 0x18, 0x19][usize::from(kind)]);
        let reply = match kind {
            0 | 1 => nst::Response::Data { function, data: &data },
            _ => nst::Response::Acknowledge { function, length },
        };
        let mut buffer = [0xEE; nst::serial::RESPONSE_MAX];
        let frame = nst::serial::encode_reply(9, &reply, &mut buffer).unwrap();
        prop_assert_eq!(nst::Response::decode(nst::serial::Frame::decode(frame).unwrap().body), Ok(reply));
    }

    #[test]
    fn whatever_decodes_encodes_to_the_same(pdu in vec(any::<u8>(), 0..=PDU_MAX)) {
        let mut buffer = [0xEE; PDU_MAX];
        if let Ok(request) = Request::decode(&pdu) {
            let mut writer = jointbus_protocol::wire::Writer::new(&mut buffer);
            request.encode(&mut writer).unwrap();
            prop_assert_eq!(writer.finish(), &pdu);
        }
        match Response::decode(&pdu) {
            // "more follows" and the next object have more spellings than one
            Err(_) | Ok(Response::DeviceIdentification(_)) => {}
            Ok(response) => {
                let mut writer = jointbus_protocol::wire::Writer::new(&mut buffer);
                response.encode(&mut writer).unwrap();
                prop_assert_eq!(writer.finish(), &pdu);
            }
        }
    }

    #[test]
    fn no_bytes_break_a_parser_a_deframer_or_a_dispatcher(
        bytes in vec(any::<u8>(), 0..600),
        piece in 1..300usize,
        correct: bool,
    ) {
        let frame = if correct { sealed(&bytes) } else { bytes.clone() };
        let mut out = [0xEE; 600];
        let mut tables = Tables::new();
        for unit in [frame.first().copied().unwrap_or(0), 5] {
            if let Ok(answer) = server::rtu(&mut tables, unit, &frame, &mut out) {
                prop_assert!(answer.len() <= FRAME_MAX);
                prop_assert!(rtu::Frame::decode(answer).is_ok());
            }
        }
        if let Ok(answer) = server::respond(&mut tables, &bytes, &mut out) {
            prop_assert!(answer.len() <= PDU_MAX && Response::decode(answer).is_ok());
        }
        let _ = station().serve(&frame, &mut out);
        let _ = card().serve(31, &frame, &mut out);
        let mut sensor = daq();
        let _ = sensor.serve_serial(&frame, &mut out);
        let _ = sensor.serve_stream(&bytes, &mut out);
        let _ = nst::Response::decode(&bytes);
        let _ = (Request::decode(&bytes), Response::decode(&bytes), Objects::new(&bytes).map(Iterator::count));
        let _ = ascii::Frame::decode(&bytes, &mut out).is_ok();
        let mut station_store = [0; ndam9010::settings::STORED_LENGTH];
        let mut card_store = [0; nxi6201::STORED_LENGTH];
        for store in [&mut station_store[..], &mut card_store] {
            let content = bytes.iter().copied().chain(std::iter::repeat(0)).take(store.len() - 2);
            store.copy_from_slice(&sealed(&content.collect::<Vec<_>>()));
        }
        let _ = (ndam9010::Settings::decode(&station_store), Settings::decode(&card_store));
        let _ = (rtu::request_length(&bytes), nst::serial::request_length(&bytes));

        let mut burst = FrameDecoder::<{ FRAME_MAX + STRAY_MAX }>::new(SILENCE);
        let mut nst_burst = FrameDecoder::<{ FRAME_MAX + STRAY_MAX }>::new(SILENCE);
        let mut line = MultidropDecoder::new(4..=5, SILENCE);
        let mut nst_line = nst::line::MultidropDecoder::new(4..=5, SILENCE);
        let (mut characters, mut connection) = (ascii::Decoder::new(), tcp::Decoder::new());
        let mut lines = slcan::LineReader::<40>::new();
        let expected = ExpectedResponse::new(1, &Request::ReadCoils(AddressRange::new(0, 9)));
        let mut search = ResponseMatcher::<300, 2>::default();
        for chunk in frame.chunks(piece) {
            // each event takes at least one byte, so this ends
            let mut rest = chunk;
            while burst.feed(&rtu::RequestFraming, &mut rest, START).is_some() {}
            rest = chunk;
            while nst_burst.feed(&nst::serial::RequestFraming, &mut rest, START).is_some() {}
            rest = chunk;
            while line.feed(&mut rest, START).is_some() {}
            rest = chunk;
            while characters.feed(&mut rest, START).is_some() {}
            rest = chunk;
            while connection.feed(&mut rest, START).is_some() {}
            rest = chunk;
            while search.feed(&expected, &mut rest).is_some() {}
            rest = chunk;
            while let Some(event) = lines.feed(&mut rest, START) {
                if let Event::Frame(line) = event {
                    let _ = slcan::Command::decode(line);
                }
            }
            rest = chunk;
            while nst_line.feed(&mut rest, START).is_some() {}
        }
        let later = START.saturating_add(SILENCE);
        let _ = burst.poll(&rtu::RequestFraming, later);
        let _ = nst_burst.poll(&nst::serial::RequestFraming, later);
        let _ = (line.poll(later).is_some(), nst_line.poll(later));
    }

    #[test]
    fn no_can_frames_break_the_reassembler(
        frames in vec((any::<bool>(), 0..4u32, 0..3u32, any::<u8>(), vec(any::<u8>(), 0..=8), 0..8u64), 0..60)
    ) {
        let mut reassembler = nst::can::Reassembler::<2>::new(2, SILENCE);
        let mut now = START;
        for (remote, source, destination, format, data, pause) in frames {
            now = now.saturating_add(Duration::from_millis(pause));
            let id = Id::Extended(source << 16 | destination << 8 | u32::from(format));
            let mut bytes = [0; 8];
            bytes[..data.len()].copy_from_slice(&data);
            let frame = CanFrame::from_parts(id, remote, data.len() as u8, bytes).unwrap();
            if let Some(nst::can::Outcome::Complete { body, .. }) = reassembler.push(&frame, now).outcome {
                prop_assert!(!body.is_empty() && body.len() <= nst::can::TRANSFER_MAX);
            }
        }
        // and it still joins a transfer
        let later = now.saturating_add(SILENCE).saturating_add(SILENCE);
        let mut joined = None;
        for frame in nst::can::segment(3, 2, &[7; 20]).unwrap() {
            if let Some(nst::can::Outcome::Complete { body, .. }) = reassembler.push(&frame, later).outcome {
                joined = Some(body.to_vec());
            }
        }
        prop_assert_eq!(joined, Some(vec![7; 20]));
    }

    #[test]
    fn a_valid_request_after_garbage_and_silence_is_taken(
        garbage in vec(any::<u8>(), 0..600),
        request in any_request(),
        unit in 4..=5u8,
    ) {
        let request = request.value();
        let mut buffer = [0; ascii::FRAME_MAX];
        let frame = rtu::encode_request(unit, &request, &mut buffer).unwrap().to_vec();
        // a byte count may belie the frame's own length; then the line can't know where it ends
        prop_assume!(Request::decode(&frame[1..frame.len() - 2]).is_ok());
        let regular = !matches!(request, Request::Diagnostics { data, .. } if data.len() != 2);
        let (quiet, done) = (START.saturating_add(SILENCE), START.saturating_add(SILENCE).saturating_add(SILENCE));

        let mut burst = FrameDecoder::<{ FRAME_MAX + STRAY_MAX }>::new(SILENCE);
        let mut rest = &garbage[..];
        while burst.feed(&rtu::RequestFraming, &mut rest, START).is_some() {}
        let _ = burst.poll(&rtu::RequestFraming, quiet);
        let mut rest = &frame[..];
        let event = burst.feed(&rtu::RequestFraming, &mut rest, quiet).is_some();
        if regular {
            let event = if event { Some(FrameEvent::Frame(&frame)) } else { burst.poll(&rtu::RequestFraming, done) };
            prop_assert_eq!(event, Some(FrameEvent::Frame(&frame)));
        }

        let mut line = MultidropDecoder::new(4..=5, SILENCE);
        let mut rest = &garbage[..];
        while line.feed(&mut rest, START).is_some() {}
        let _ = line.poll(quiet);
        let mut rest = &frame[..];
        let heard = line.feed(&mut rest, quiet).is_some();
        if regular {
            let expected = Some(line::Event::Frame(rtu::Frame::decode(&frame).unwrap()));
            let heard = if heard { expected } else { line.poll(done) };
            prop_assert_eq!(heard, expected);
        }

        let mut characters = ascii::Decoder::new();
        let mut rest = &garbage[..];
        while characters.feed(&mut rest, START).is_some() {}
        let mut rest = ascii::encode_request(unit, &request, &mut buffer).unwrap();
        let mut taken = false;
        while let Some(event) = characters.feed(&mut rest, START) {
            taken |= matches!(event, Event::Frame(frame) if Request::decode(frame.pdu) == Ok(request));
        }
        prop_assert!(taken);
    }

    #[test]
    fn what_the_general_server_answers_fits_the_request(
        request in prop_oneof![any_request(), right_request()],
        transaction: u16,
    ) {
        let request = request.value();
        let (mut tables, mut buffer, mut out) = (Tables::new(), [0; ascii::FRAME_MAX], [0; ascii::FRAME_MAX]);
        let expected = ExpectedResponse::new(5, &request);
        let refused_only = expected.lengths() == [0, 5] && !expected.is_open();

        let frame = rtu::encode_request(5, &request, &mut buffer).unwrap();
        let answer = server::rtu(&mut tables, 5, frame, &mut out).unwrap();
        prop_assert!(expected.accepts(answer), "{:x?} -> {:x?}", frame, answer);
        prop_assert!(!refused_only || answer[1] & 0x80 != 0);
        let mut again = [0xEE; FRAME_MAX];
        let small = server::rtu_with(checksum::crc16_small, &mut tables, 5, frame, &mut again)
            .unwrap();
        prop_assert_eq!(small, answer);
        let answer = Response::decode(&answer[1..answer.len() - 2]).unwrap().function();
        prop_assert_eq!(answer, request.function());

        let (mut decoder, mut connection) = (ascii::Decoder::new(), tcp::Decoder::new());
        let mut frame = ascii::encode_request(5, &request, &mut buffer).unwrap();
        let Some(Event::Frame(frame)) = decoder.feed(&mut frame, START) else { panic!("a frame") };
        let answer = server::ascii(&mut tables, 5, &frame, &mut out).unwrap();
        let mut content = [0; ascii::CONTENT_MAX + 1];
        prop_assert!(expected.accepts_pdu(ascii::Frame::decode(answer, &mut content).unwrap().pdu));

        let mut frame = tcp::encode_request(transaction, 5, &request, &mut buffer).unwrap();
        let Some(Event::Frame(frame)) = connection.feed(&mut frame, START) else { panic!("a frame") };
        let mut answer = server::tcp(&mut tables, &frame, &mut out).unwrap();
        let mut back = tcp::Decoder::new();
        let Some(Event::Frame(answer)) = back.feed(&mut answer, START) else { panic!("a frame") };
        prop_assert_eq!((answer.transaction, answer.unit), (transaction, 5));
        prop_assert!(expected.accepts_pdu(answer.pdu));
    }

    #[test]
    fn what_the_devices_answer_fits_the_request(request in prop_oneof![any_request(), right_request()]) {
        let request = request.value();
        let (mut buffer, mut out) = ([0; FRAME_MAX], [0; FRAME_MAX]);
        let expected = ExpectedResponse::new(6, &request);
        let frame = rtu::encode_request(6, &request, &mut buffer).unwrap();
        prop_assert!(expected.accepts(station().serve(frame, &mut out).unwrap()));
        let in_ascii = ascii::Frame { unit: 6, pdu: &frame[1..frame.len() - 2] };
        let (mut characters, mut content) = ([0; ascii::FRAME_MAX], [0; ascii::CONTENT_MAX + 1]);
        let answer = station().serve_ascii(&in_ascii, &mut characters).unwrap().to_vec();
        prop_assert!(expected.accepts_pdu(ascii::Frame::decode(&answer, &mut content).unwrap().pdu));
        prop_assert!(expected.accepts(card().serve(6, frame, &mut out).unwrap()));
    }

    #[test]
    fn what_the_sensor_answers_fits_the_request(
        kind in 0..8u8,
        register in prop_oneof![0..0x310u16, any::<u16>()],
        length: u8,
        data in vec(any::<u8>(), 0..=60),
    ) {
        let request = nst_request(kind, register, length, &data);
        let (mut buffer, mut out) = ([0; FRAME_MAX], [0; FRAME_MAX]);
        let frame = nst::serial::encode_request(5, &request, &mut buffer).unwrap();
        if let Ok(reply) = daq().serve_serial(frame, &mut out) {
            prop_assert!(nst::serial::ExpectedResponse::new(5, &request).accepts(reply));
        }
    }

    #[test]
    fn a_reply_is_found_behind_any_noise(noise in vec(any::<u8>(), 0..700), quantity in 1..=125u16) {
        let request = Request::ReadInputRegisters(AddressRange::new(0, quantity));
        let expected = ExpectedResponse::new(9, &request);
        let data = vec![3; 2 * usize::from(quantity)];
        let mut buffer = [0; FRAME_MAX];
        let reply = Response::Read { function: request.function(), data: &data };
        let frame = rtu::encode_response(9, &reply, &mut buffer).unwrap();
        let mut search = ResponseMatcher::<{ FRAME_MAX + 1 }, 2>::default();
        let mut rest = &noise[..];
        // noise that is a reply by itself is none of this test's business
        prop_assume!(search.feed(&expected, &mut rest).is_none());
        let mut rest = frame;
        prop_assert!(search.feed(&expected, &mut rest).is_some());
    }
}
