//! Modbus data units and RTU frames: what decodes encodes to the same bytes, its length is told by its first ones,
//! and a master accepts an answer only to what it asked.
#![no_main]

use jointbus_fuzz::sealed;
use jointbus_protocol::decode::{FrameLength, Match};
use jointbus_protocol::modbus::identification::{MEI_TYPE, Objects};
use jointbus_protocol::modbus::rtu::{self, ExpectedResponse};
use jointbus_protocol::modbus::{PDU_MAX, Request, Response};
use jointbus_protocol::wire::Writer;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut buffer = [0xEE; 300];
    let _ = (rtu::Frame::decode(data), rtu::request_length(data));
    if data.len() > PDU_MAX {
        let _ = (Request::decode(data), Response::decode(data));
        return;
    }
    if let Ok(request) = Request::decode(data) {
        let mut writer = Writer::new(&mut buffer);
        request.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), data);
        let frame = rtu::encode_request(9, &request, &mut buffer).unwrap();
        assert_eq!(rtu::Frame::decode(frame), Ok(rtu::Frame { unit: 9, pdu: data }));
        match rtu::request_length(frame) {
            // of function code 08 a serial line knows the form with two bytes of data alone
            FrameLength::Exactly(length) if data[0] == 8 => assert_eq!(length, 8),
            FrameLength::Exactly(length) => assert_eq!(length, frame.len()),
            FrameLength::UntilSilence => {}
            // a response's function code, or more data than a frame holds
            FrameLength::Impossible => assert!(data[0] == 0 || data[0] >= 0x80),
            FrameLength::AtLeast(length) => panic!("{length} of {} bytes", frame.len()),
        }
        let expected = ExpectedResponse::new(9, &request);
        if (1..0x80).contains(&data[0]) {
            assert!(expected.accepts(&sealed(&[9, data[0] | 0x80, 4])), "it may always be refused");
        }
        assert!(!expected.accepts(&sealed(&[8, data[0] | 0x80, 4])), "by another unit");
        assert!(expected.lengths().into_iter().all(|length| length <= rtu::FRAME_MAX + 6));
    }
    if let Ok(response) = Response::decode(data) {
        let mut writer = Writer::new(&mut buffer);
        response.encode(&mut writer).unwrap();
        assert_eq!(same(writer.finish()), same(data));
        let frame = rtu::encode_response(9, &response, &mut buffer).unwrap();
        assert_eq!(rtu::Frame::decode(frame).map(|frame| Response::decode(frame.pdu)), Ok(Ok(response)));
    }
    if let Ok(objects) = Objects::new(data) {
        let count = usize::from(Objects::count(&objects));
        assert_eq!(objects.map(|(_, value)| 2 + value.len()).sum::<usize>(), data.len());
        assert_eq!(Iterator::count(objects), count);
    }
});

/// Two bytes of a device identification have more than one spelling: whether more follows, and what, if nothing does.
fn same(pdu: &[u8]) -> Vec<u8> {
    let mut pdu = pdu.to_vec();
    if let [0x2B, MEI_TYPE, _, _, more, next, ..] = &mut pdu[..] {
        match more {
            0 => *next = 0,
            _ => *more = 0xFF,
        }
    }
    pdu
}
