//! The NST device's side of a serial line and of a stream: any bytes at any pace, then silence, then a request that
//! must be taken. Then the line with other devices: none of their frames is executed, whatever their data.
#![no_main]

use jointbus_fuzz::{SILENCE, Script, sealed, survives};
use jointbus_protocol::decode::STRAY_MAX;
use jointbus_protocol::nst::line::{Event, MultidropDecoder};
use jointbus_protocol::nst::{serial, stream};
use jointbus_protocol::time::{Duration, Instant};
use libfuzzer_sys::fuzz_target;

const READ: [u8; 5] = [1, 0x03, 2, 0, 0x12];

fuzz_target!(|data: &[u8]| {
    survives::<{ serial::REQUEST_MAX + STRAY_MAX }>(&serial::RequestFraming, Script(data), &sealed(&READ));
    survives::<{ serial::REQUEST_MAX + STRAY_MAX }>(&stream::RequestFraming, Script(data), &READ);
    among_others(Script(data));
});

/// Correct traffic of others, its data full of requests to us: none is heard. Then noise, silence, and a request to us.
fn among_others(mut script: Script<'_>) {
    let (mut whole, mut single) =
        (MultidropDecoder::new(1..=1, SILENCE), MultidropDecoder::new(1..=1, SILENCE));
    let mut now = Instant::from_micros(0);
    for _ in 0..script.byte() & 0x0F {
        let [way, high, low] = script.array();
        let other = 2 + (way & 3);
        let mut payload = script.record().to_vec();
        if way & 0x10 != 0 {
            payload.extend(sealed(&[1, 0x10, 0x01, 0x93, 1, 0x7E]));
        }
        payload.truncate(180);
        payload.push(0);
        let count = payload.len() as u8;
        let (request, response) = match way & 0x20 {
            // a register that is written, and one that is read
            0 => ([&[other, 0x10, 0, low & 0x1F, count][..], &payload].concat(), vec![other, 0x10, count]),
            _ => (vec![other, 3, high & 1, low & 0x3F, count], [&[other, 3, count][..], &payload].concat()),
        };
        for frame in [Some(request), (way & 0x80 == 0).then_some(response)].into_iter().flatten() {
            let events = hear(&mut whole, &mut single, &sealed(&frame), now);
            assert!(events.iter().all(|event| !matches!(event, Heard::Frame(_))), "{frame:x?}");
            now = now.saturating_add(SILENCE);
            let (in_one, one_by_one) = (whole.poll(now).map(Heard::from), single.poll(now).map(Heard::from));
            assert!(in_one == one_by_one && !matches!(in_one, Some(Heard::Frame(_))), "{frame:x?}");
        }
    }
    while !script.is_empty() {
        let (pause, piece) = script.piece([0, 1000, 19_999, 20_000].map(Duration::from_micros));
        now = now.saturating_add(pause);
        hear(&mut whole, &mut single, piece, now);
        assert_eq!(whole.deadline(), single.deadline());
    }
    now = now.saturating_add(SILENCE);
    let _ = (whole.poll(now).is_some(), single.poll(now).is_some());
    assert_eq!((whole.deadline(), single.deadline()), (None, None));
    let request = sealed(&READ);
    assert_eq!(hear(&mut whole, &mut single, &request, now), [Heard::Frame(READ.to_vec())]);
}

#[derive(Debug, PartialEq)]
enum Heard {
    Frame(Vec<u8>),
    Other,
}

impl From<Event<'_>> for Heard {
    fn from(event: Event<'_>) -> Self {
        match event {
            Event::Frame(frame) => Self::Frame([&[frame.address], frame.body].concat()),
            Event::Foreign(frame) => {
                assert!(frame.address != 1 && frame.body.len() >= 2);
                Self::Other
            }
            Event::Dropped(_) => Self::Other,
        }
    }
}

/// The same comes out whether bytes come alone or in pieces.
fn hear(
    whole: &mut MultidropDecoder,
    single: &mut MultidropDecoder,
    bytes: &[u8],
    now: Instant,
) -> Vec<Heard> {
    let feed = |line: &mut MultidropDecoder, mut bytes: &[u8]| {
        let mut heard = Vec::new();
        while let Some(event) = line.feed(&mut bytes, now) {
            heard.push(Heard::from(event));
        }
        assert!(bytes.is_empty());
        heard
    };
    let in_one = feed(whole, bytes);
    let one_by_one: Vec<_> = bytes.chunks(1).flat_map(|byte| feed(single, byte)).collect();
    assert_eq!(in_one, one_by_one);
    in_one
}
