//! Modbus data units and RTU frames: what decodes encodes to the same bytes, its length is told by its first ones,
//! and a master accepts an answer only to what it asked.
#![no_main]

use jointbus_protocol::deframe::FrameLength;
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
            FrameLength::Exactly(length) => assert_eq!(length, frame.len()),
            FrameLength::UntilSilence => {}
            // a response's function code, or more data than a frame holds
            FrameLength::Impossible => assert!(data[0] == 0 || data[0] >= 0x80),
            FrameLength::AtLeast(length) => panic!("{length} of {} bytes", frame.len()),
        }
        let expected = ExpectedResponse::new(9, &request);
        let refusal = [9, data[0] | 0x80, 4];
        let refusal = jointbus_fuzz::sealed(&refusal);
        assert_eq!(expected.accepts(&refusal), data[0] < 0x80 || expected.is_open());
    }
    if let Ok(response) = Response::decode(data) {
        let mut writer = Writer::new(&mut buffer);
        response.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), data);
        let frame = rtu::encode_response(9, &response, &mut buffer).unwrap();
        assert_eq!(rtu::Frame::decode(frame).map(|frame| frame.pdu), Ok(data));
    }
});
