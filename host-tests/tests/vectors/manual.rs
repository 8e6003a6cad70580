//! `manual.csv`: each frame is decoded, encoded again, cut at every length, and answered where the answer is printed.

use super::{bytes, daq, station};
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::decode::{Event, FrameDecoder, Framing, ResponseMatcher};
use jointbus_protocol::modbus::rtu::{self, ExpectedResponse};
use jointbus_protocol::modbus::{self, AddressRange};
use jointbus_protocol::nst::can::{Identifier, Outcome, Reassembler, segment};
use jointbus_protocol::nst::{self, serial};
use jointbus_protocol::nxi6201;
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::Writer;
use std::collections::HashMap;

/// Dirt in buffers that are written into.
const DIRT: u8 = 0xEE;
const PAUSE: Duration = Duration::from_millis(10);

struct Row {
    id: String,
    device: String,
    link: String,
    is_request: bool,
    hex: String,
    meaning: String,
}

fn rows() -> Vec<Row> {
    let mut reader = csv::Reader::from_reader(include_bytes!("../../vectors/manual.csv").as_slice());
    assert_eq!(
        reader.headers().unwrap(),
        ["id", "device", "link", "direction", "hex", "meaning", "source"].as_slice()
    );
    let rows: Vec<Row> = reader
        .records()
        .map(|record| {
            let record = record.unwrap();
            Row {
                id: record[0].into(),
                device: record[1].into(),
                link: record[2].into(),
                is_request: match &record[3] {
                    "request" => true,
                    "reply" => false,
                    other => panic!("direction {other}"),
                },
                hex: record[4].into(),
                meaning: record[5].into(),
            }
        })
        .collect();
    assert!(!rows.is_empty());
    rows
}

impl Row {
    fn is_nst(&self) -> bool {
        match self.device.as_str() {
            "nst" => true,
            "nxi6201" | "ndam9010" => false,
            other => panic!("device {other}"),
        }
    }

    fn is_can(&self) -> bool {
        match self.link.as_str() {
            "can" => true,
            "serial" => false,
            other => panic!("link {other}"),
        }
    }

    /// The frame of a CAN row.
    fn can_frame(&self) -> Frame {
        let (identifier, data) = self.hex.split_once('#').unwrap();
        let identifier = u32::from_str_radix(identifier, 16).unwrap();
        Frame::data_frame(Id::Extended(identifier), &bytes(data)).unwrap()
    }
}

/// The bytes of an encoding into a dirty buffer.
fn dirty(encode: impl FnOnce(&mut [u8]) -> usize) -> Vec<u8> {
    let mut buffer = [DIRT; 300];
    let length = encode(&mut buffer);
    assert!(buffer[length..].iter().all(|byte| *byte == DIRT), "nothing is written past the frame");
    buffer[..length].to_vec()
}

/// A slave's decoder takes the whole frame, and no cut of it, silence or not.
fn decoded_as_a_whole_only(format: &impl Framing, frame: &[u8]) {
    for cut in 0..=frame.len() {
        let mut decoder = FrameDecoder::<300>::new(PAUSE);
        let mut rest = &frame[..cut];
        let fed = matches!(decoder.feed(format, &mut rest, Instant::default()),
            Some(Event::Frame(taken)) if taken == frame);
        let polled = decoder.poll(format, Instant::default().saturating_add(PAUSE));
        assert!(!matches!(polled, Some(Event::Frame(_))), "cut at {cut}");
        assert_eq!(fed, cut == frame.len(), "cut at {cut}");
    }
}

fn nst_request(frame: &[u8]) {
    let decode = |frame| serial::Frame::decode(frame).map(|it| (it.address, nst::Request::decode(it.body)));
    let (address, request) = decode(frame).unwrap();
    let request = request.unwrap();
    let again = dirty(|buffer| serial::encode_request(address, &request, buffer).unwrap().len());
    assert_eq!(again, frame);
    for cut in 0..frame.len() {
        assert!(decode(&frame[..cut]).is_none_or(|(_, request)| request.is_err()), "cut at {cut}");
    }
    decoded_as_a_whole_only(&serial::RequestFraming, frame);
}

fn nst_reply(frame: &[u8]) {
    let decode = |frame| serial::Frame::decode(frame).map(|it| (it.address, nst::Response::decode(it.body)));
    let (address, reply) = decode(frame).unwrap();
    let reply = reply.unwrap();
    let again = dirty(|buffer| serial::encode_reply(address, &reply, buffer).unwrap().len());
    assert_eq!(again, frame);
    for cut in 0..frame.len() {
        assert!(decode(&frame[..cut]).is_none_or(|(_, reply)| reply.is_err()), "cut at {cut}");
    }
}

fn modbus_request(frame: &[u8]) {
    let decode = |frame| rtu::Frame::decode(frame).map(|it| (it.unit, modbus::Request::decode(it.pdu)));
    let (unit, request) = decode(frame).unwrap();
    let request = request.unwrap();
    let again = dirty(|buffer| rtu::encode_request(unit, &request, buffer).unwrap().len());
    assert_eq!(again, frame);
    for cut in 0..frame.len() {
        assert!(!decode(&frame[..cut]).is_ok_and(|(_, request)| request.is_ok()), "cut at {cut}");
    }
    decoded_as_a_whole_only(&rtu::RequestFraming, frame);
}

fn modbus_reply(frame: &[u8]) {
    let decode = |frame| rtu::Frame::decode(frame).map(|it| (it.unit, modbus::Response::decode(it.pdu)));
    let (unit, response) = decode(frame).unwrap();
    let response = response.unwrap();
    let again = dirty(|buffer| rtu::encode_response(unit, &response, buffer).unwrap().len());
    assert_eq!(again, frame);
    for cut in 0..frame.len() {
        assert!(!decode(&frame[..cut]).is_ok_and(|(_, response)| response.is_ok()), "cut at {cut}");
    }
}

/// A CAN frame is a transfer of its own: identifier, segmentation, reassembly, body.
fn can_row(row: &Row) {
    let frame = row.can_frame();
    let Id::Extended(raw) = frame.id() else { panic!("29 bits") };
    let identifier = Identifier::from_raw(raw).unwrap();
    assert_eq!(identifier.to_raw(), raw);
    let Identifier { source, destination, .. } = identifier;
    let mut reassembler = Reassembler::<1>::new(destination, PAUSE);
    let report = reassembler.push(&frame, Instant::default());
    assert_eq!(report.outcome, Some(Outcome::Complete { source, destination, body: frame.data() }));
    assert_eq!(report.error, None);
    assert_eq!(segment(source, destination, frame.data()).unwrap().collect::<Vec<_>>(), [frame]);
    let encoded = dirty(|buffer| {
        let mut writer = Writer::new(buffer);
        if row.is_request {
            nst::Request::decode(frame.data()).unwrap().encode(&mut writer).unwrap();
        } else {
            nst::Response::decode(frame.data()).unwrap().encode(&mut writer).unwrap();
        }
        writer.finish().len()
    });
    assert_eq!(encoded, frame.data());
    for cut in 0..frame.data().len() {
        let body = &frame.data()[..cut];
        let accepted = if row.is_request {
            nst::Request::decode(body).is_ok()
        } else {
            nst::Response::decode(body).is_ok()
        };
        assert!(!accepted, "cut at {cut}");
    }
}

#[test]
fn every_frame_is_decoded_encoded_again_and_never_taken_in_part() {
    for row in rows() {
        println!("{}: {}", row.id, row.meaning);
        if row.is_can() {
            can_row(&row);
            continue;
        }
        let frame = bytes(&row.hex);
        match (row.is_nst(), row.is_request) {
            (true, true) => nst_request(&frame),
            (true, false) => nst_reply(&frame),
            (false, true) => modbus_request(&frame),
            (false, false) => modbus_reply(&frame),
        }
    }
}

/// What the row's device answers to a frame of a serial line, its inputs as the manual's example has them.
fn answer(row: &Row, frame: &[u8]) -> Vec<u8> {
    let mut out = [DIRT; 300];
    match row.device.as_str() {
        "nst" => daq(1).serve_serial(frame, &mut out).unwrap().to_vec(),
        "ndam9010" => {
            let mut station = station();
            station.modules()[0].inputs = match row.id.as_str() {
                "ndam-di-reg-req" => 0x000F,
                "ndam-di-bit-req" => 0x35AC,
                _ => 0,
            };
            station.serve(frame, &mut out).unwrap().to_vec()
        }
        "nxi6201" => {
            let hardware = nxi6201::RamHardware::default();
            let mut card = nxi6201::Card::power_up(hardware, &nxi6201::Settings::default()).unwrap();
            card.serve(nxi6201::DEFAULT_ID, frame, &mut out).unwrap().to_vec()
        }
        other => panic!("device {other}"),
    }
}

/// A master finds the reply to the request behind noise, and in none of its cuts.
fn master_accepts(row: &Row, request: &[u8], reply: &[u8]) {
    for cut in 0..=reply.len() {
        let noisy = [&[0x55, 0x01], &reply[..cut]].concat();
        let mut rest = noisy.as_slice();
        let found = if row.is_nst() {
            let request = serial::Frame::decode(request).unwrap();
            let wanted =
                serial::ExpectedResponse::new(request.address, &nst::Request::decode(request.body).unwrap());
            ResponseMatcher::<300, 1>::default().feed(&wanted, &mut rest).map(|(_, found)| found.to_vec())
        } else {
            let request = rtu::Frame::decode(request).unwrap();
            let wanted = ExpectedResponse::new(request.unit, &modbus::Request::decode(request.pdu).unwrap());
            ResponseMatcher::<300, 2>::default().feed(&wanted, &mut rest).map(|(_, found)| found.to_vec())
        };
        assert_eq!(found.as_deref(), (cut == reply.len()).then_some(reply), "cut at {cut}");
    }
}

#[test]
fn devices_answer_printed_requests_with_the_printed_replies() {
    let rows = rows();
    let by_id: HashMap<&str, &Row> = rows.iter().map(|row| (row.id.as_str(), row)).collect();
    assert_eq!(by_id.len(), rows.len(), "no id twice");
    let mut pairs = 0;
    for row in rows.iter().filter(|row| row.is_request) {
        println!("{}", row.id);
        let printed = by_id.get(row.id.replace("-req", "-rep").as_str());
        if row.is_can() {
            let Some(printed) = printed else { continue };
            let frame = row.can_frame();
            let Id::Extended(raw) = frame.id() else { panic!("29 bits") };
            let Identifier { source, destination, .. } = Identifier::from_raw(raw).unwrap();
            let mut data = [DIRT; 300];
            let reply = daq(destination).serve(destination, frame.data(), &mut data).map(|reply| {
                let mut buffer = [DIRT; 300];
                let mut writer = Writer::new(&mut buffer);
                reply.encode(&mut writer).unwrap();
                segment(destination, source, writer.finish()).unwrap().collect::<Vec<_>>()
            });
            assert_eq!(reply.unwrap(), [printed.can_frame()]);
            pairs += 1;
            continue;
        }
        let request = bytes(&row.hex);
        let reply = answer(row, &request);
        master_accepts(row, &request, &reply);
        if let Some(printed) = printed {
            assert_eq!(reply, bytes(&printed.hex));
            pairs += 1;
        } else if row.meaning.contains("the reply is the same frame") {
            assert_eq!(reply, request);
            pairs += 1;
        }
    }
    let replies = rows.iter().filter(|row| !row.is_request).count();
    assert_eq!(pairs, replies - 1 + 2, "one printed reply has no request, two requests are their own reply");
}

/// Table 3.27 prints this reply alone.
#[test]
fn the_printed_reply_without_a_request_is_an_answer_as_well() {
    let rows = rows();
    let printed = rows.iter().find(|row| row.id == "ndam-ao-many-rep").unwrap();
    let request =
        modbus::Request::WriteMultipleRegisters { range: AddressRange::new(0x0060, 4), data: &[7; 8] };
    let (mut frame, mut out) = ([DIRT; 300], [DIRT; 300]);
    let frame = rtu::encode_request(1, &request, &mut frame).unwrap();
    assert_eq!(station().serve(frame, &mut out).unwrap(), bytes(&printed.hex));
}
