//! Modbus ASCII: whatever came before, a frame is found; what is found is what the characters say.
#![no_main]

use jointbus_protocol::modbus::Request;
use jointbus_protocol::modbus::ascii::{CONTENT_MAX, Decoder, Event, FRAME_MAX, Frame, encode_request};
use jointbus_protocol::time::Instant;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut buffer = [0; CONTENT_MAX + 1];
    if let Ok(frame) = Frame::decode(data, &mut buffer) {
        assert_eq!(data.len(), 2 * (frame.pdu.len() + 2) + 3);
    }
    let (mut whole, mut single) = (Decoder::new(), Decoder::new());
    let in_one = feed(&mut whole, data);
    let one_by_one: Vec<_> = data.chunks(1).flat_map(|character| feed(&mut single, character)).collect();
    assert_eq!(in_one, one_by_one);
    for (_, pdu) in in_one.into_iter().flatten() {
        assert!(!pdu.is_empty() && pdu.len() < CONTENT_MAX);
    }

    let content = &data[..data.len().min(CONTENT_MAX - 1)];
    let Ok(request) = Request::decode(content) else {
        return ends(&mut whole, &[4, 0, 0, 0, 1]);
    };
    let mut pdu = [0; CONTENT_MAX];
    let mut writer = jointbus_protocol::wire::Writer::new(&mut pdu);
    request.encode(&mut writer).unwrap();
    ends(&mut whole, writer.finish());
});

/// A request comes out of the decoder, whatever it was in the middle of.
fn ends(decoder: &mut Decoder, pdu: &[u8]) {
    let mut buffer = [0; FRAME_MAX];
    let request = Request::decode(pdu).unwrap();
    let frame = encode_request(17, &request, &mut buffer).unwrap();
    let mut bytes = [0; CONTENT_MAX + 1];
    assert_eq!(Frame::decode(frame, &mut bytes), Ok(Frame { unit: 17, pdu }));
    assert_eq!(feed(decoder, frame).last(), Some(&Some((17, pdu.to_vec()))));
    assert!(!decoder.is_inside());
}

/// Frames, and `None` for each that was dropped.
fn feed(decoder: &mut Decoder, mut characters: &[u8]) -> Vec<Option<(u8, Vec<u8>)>> {
    let mut events = Vec::new();
    while let Some(event) = decoder.feed(&mut characters, Instant::default()) {
        events.push(match event {
            Event::Frame(frame) => Some((frame.unit, frame.pdu.to_vec())),
            Event::Dropped(_) => None,
        });
    }
    assert!(characters.is_empty());
    events
}
