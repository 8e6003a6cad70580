//! The NST device: any frames in all its forms. An answer fits its request, who is refused has changed nothing, and
//! the device answers afterwards.
#![no_main]

use jointbus_fuzz::{Script, sealed};
use jointbus_protocol::can::Id;
use jointbus_protocol::nst::can::{self, Identifier};
use jointbus_protocol::nst::register::{self, Access};
use jointbus_protocol::nst::{
    ADDRESS_MAX, ADDRESS_MIN, BROADCAST, Daq, NoResponse, RamHardware, Request, Sample, SignEncoding, serial,
};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let sign =
        if script.byte() & 1 == 0 { SignEncoding::TwosComplement } else { SignEncoding::SignMagnitude };
    let mut daq = Daq::new(RamHardware::new(1), sign);
    while !script.is_empty() {
        let (way, room) = (script.byte(), script.byte());
        let content = script.record();
        let room = if room < 0xE0 { 300 } else { usize::from(room & 0x1F) };
        let mut out = vec![0xEE; room];
        let before = *daq.hardware().settings.as_bytes();
        let address = content.first().copied();
        let outcome = match way & 0x07 {
            0 => daq.serve_serial(content, &mut out).map(<[u8]>::to_vec),
            1 => daq.serve_stream(content, &mut out).map(sealed),
            2 => serve_can(&mut daq, way, content),
            3 => {
                daq.hardware().sample = Sample([i32::from(way) << 23; 6]);
                continue;
            }
            _ => daq.serve_serial(&sealed(content), &mut out).map(<[u8]>::to_vec),
        };
        let after = *daq.hardware().settings.as_bytes();
        match outcome {
            Ok(reply) => {
                assert_ne!(address, Some(BROADCAST));
                let body = if way & 0x07 == 0 { &content[..content.len() - 2] } else { content };
                let request = Request::decode(&body[1..]).unwrap();
                let expected = serial::ExpectedResponse::new(body[0], &request);
                assert!(expected.accepts(&reply), "{request:x?} {reply:x?}");
            }
            Err(NoResponse::Broadcast(None)) => assert_eq!(address, Some(BROADCAST)),
            Err(_) => assert_eq!(before, after, "silence, and yet a change"),
        }
        for row in register::TABLE.iter().filter(|row| row.access == Access::Read) {
            let range = usize::from(row.first)..=usize::from(row.last()).min(after.len() - 1);
            if *range.start() < after.len() {
                assert_eq!(before[range.clone()], after[range], "{row:?} is read only");
            }
        }
        assert!((ADDRESS_MIN..=ADDRESS_MAX).contains(&after[usize::from(register::ADDRESS.first)]));
        assert!((ADDRESS_MIN..=ADDRESS_MAX).contains(&daq.address()));
    }
    let address = daq.address();
    let mut out = [0; 300];
    let request = Request::read(register::DATA.first, 18);
    let mut frame = [0; 16];
    let frame = serial::encode_request(address, &request, &mut frame).unwrap();
    let reply = daq.serve_serial(frame, &mut out).unwrap();
    assert!(serial::ExpectedResponse::new(address, &request).accepts(reply));
});

/// The reply to a transfer, joined and in the form of the serial line.
fn serve_can(daq: &mut Daq<RamHardware>, way: u8, content: &[u8]) -> Result<Vec<u8>, NoResponse> {
    let (source, mut buffer) = (way >> 3, [0xEE; can::TRANSFER_MAX]);
    let destination = content.first().copied().unwrap_or(0);
    let frames = daq.serve_can(source, destination, content.get(1..).unwrap_or(&[]), &mut buffer)?;
    let mut joined = vec![destination];
    for frame in frames {
        let Id::Extended(raw) = frame.id() else { panic!("a short identifier") };
        let identifier = Identifier::from_raw(raw).unwrap();
        assert_eq!((identifier.source, identifier.destination), (destination, source));
        joined.extend_from_slice(frame.data());
    }
    Ok(sealed(&joined))
}
