//! Modbus TCP: the frames of a connection are the same in any segments, and after a fault nothing is believed until
//! the next connection.
#![no_main]

use jointbus_protocol::modbus::tcp::{
    Decoder, Event, FRAME_MAX, Frame, HEADER_LENGTH, Header, encode_request,
};
use jointbus_protocol::modbus::{AddressRange, PDU_MAX, Request};
use jointbus_protocol::time::Instant;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    if let Some(header) = data.first_chunk::<HEADER_LENGTH>()
        && let Ok(decoded) = Header::from_bytes(*header)
    {
        assert_eq!(decoded.to_bytes(), *header);
        assert!((1..=PDU_MAX).contains(&decoded.pdu_length()));
    }
    let (mut whole, mut single) = (Decoder::new(), Decoder::new());
    let (frames, fault) = feed(&mut whole, data);
    let mut one_by_one = Vec::new();
    for byte in data.chunks(1) {
        one_by_one.extend(feed(&mut single, byte).0);
    }
    assert_eq!(frames, one_by_one);
    let length: usize = frames.iter().map(Vec::len).sum();
    assert_eq!(frames.concat(), data[..length], "every byte once, in order");
    let mut buffer = [0; FRAME_MAX];
    let request = Request::ReadCoils(AddressRange::new(1, 2));
    let frame = encode_request(0x1234, 3, &request, &mut buffer).unwrap();
    if fault {
        assert_eq!(feed(&mut whole, frame), (vec![], true), "out of step for good");
        whole.clear();
        assert_eq!(feed(&mut whole, frame), (vec![frame.to_vec()], false));
    } else {
        assert!(data.len() - length < FRAME_MAX);
    }
});

/// The frames, and whether the connection is to be closed.
fn feed(decoder: &mut Decoder, mut bytes: &[u8]) -> (Vec<Vec<u8>>, bool) {
    let mut frames = Vec::new();
    while let Some(event) = decoder.feed(&mut bytes, Instant::default()) {
        match event {
            Event::Frame(Frame { transaction, unit, pdu }) => {
                let header = Header::of(transaction, unit, pdu.len()).unwrap();
                frames.push([&header.to_bytes()[..], pdu].concat());
            }
            Event::Dropped(_) => {
                assert!(bytes.is_empty());
                return (frames, true);
            }
        }
    }
    assert!(bytes.is_empty());
    (frames, false)
}
