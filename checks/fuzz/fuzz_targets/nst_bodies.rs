//! NST bodies and frames: what decodes encodes to the same bytes, and its length is told by its first ones.
#![no_main]

use jointbus_protocol::decode::{FrameLength, Match};
use jointbus_protocol::nst::can;
use jointbus_protocol::nst::{Request, Response, SAMPLE_LENGTH, Sample, SignEncoding, serial, stream};
use jointbus_protocol::wire::Writer;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut buffer = [0xEE; 300];
    if let Ok(request) = Request::decode(data) {
        let mut writer = Writer::new(&mut buffer);
        request.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), data);

        let frame = serial::encode_request(7, &request, &mut buffer).unwrap();
        assert_eq!(serial::request_length(frame), FrameLength::Exactly(frame.len()));
        assert_eq!(serial::Frame::decode(frame).map(|frame| (frame.address, frame.body)), Some((7, data)));
        let [longest] = serial::ExpectedResponse::new(7, &request).lengths();
        // a read may ask for more than any reply holds
        assert!(longest <= serial::RESPONSE_MAX + 5);

        let frame = stream::encode_request(7, &request, &mut buffer).unwrap();
        assert_eq!(stream::split(frame), Some((7, data)));
        assert_eq!(stream::request_length(frame), FrameLength::Exactly(frame.len()));
        parts(&request);
    }
    if let Ok(reply) = Response::decode(data) {
        let mut writer = Writer::new(&mut buffer);
        reply.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), data);
        let frame = serial::encode_reply(7, &reply, &mut buffer).unwrap();
        assert!(frame.len() <= serial::RESPONSE_MAX);
        assert_eq!(serial::Frame::decode(frame).map(|frame| frame.body), Some(data));
    }
    if let Some(raw) = data.first_chunk::<SAMPLE_LENGTH>() {
        for sign in [SignEncoding::TwosComplement, SignEncoding::SignMagnitude] {
            let sample = Sample::decode(raw, sign);
            let again = Sample::decode(&sample.encode(sign), sign);
            assert_eq!(again, sample);
        }
    }
    let _ = (serial::Frame::decode(data), serial::request_length(data), stream::split(data));
});

/// A request over CAN in parts asks for every byte once, in order.
fn parts(request: &Request<'_>) {
    let mut moved = 0;
    while let Some(part) = can::next_fragment(request, moved) {
        assert_eq!(part.function(), request.function());
        assert_eq!(part.register(), request.register().wrapping_add(moved.into()));
        let most = if part.function().is_read() { can::READ_MAX } else { can::WRITE_MAX };
        let splits = part.function().is_read() || matches!(part, Request::Write { .. });
        assert!(!splits || usize::from(part.length()) <= most);
        moved = moved.checked_add(part.length()).expect("more than was asked for");
        if request.length() == 0 {
            return;
        }
    }
    assert_eq!(moved, request.length());
}
