//! A server on a line with others. Correct traffic of others, its data full of requests to us: we hear none of them.
//! Then noise, silence, and a request to us: we hear that one.
#![no_main]

use jointbus_fuzz::{SILENCE, Script, sealed};
use jointbus_protocol::modbus::line::{Event, MultidropDecoder};
use jointbus_protocol::modbus::rtu;
use jointbus_protocol::time::{Duration, Instant};
use libfuzzer_sys::fuzz_target;

/// Ours are 5 to 7.
const UNIT: u8 = 5;

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let mut line = MultidropDecoder::new(UNIT..=7, SILENCE);
    let mut now = Instant::from_micros(0);
    let turns = script.byte() & 0x0F;
    for _ in 0..turns {
        let [way, other] = script.array();
        let other = 8 + (other & 3);
        let [first, quantity] = script.array();
        let mut payload = script.record().to_vec();
        if way & 1 != 0 {
            payload.extend(sealed(&[UNIT, 6, 0, 1, 0xAB, 0xCD]));
        }
        let (request, response) = exchange(way >> 1 & 7, other, first, quantity, &payload);
        for frame in [Some(request), response.filter(|_| way & 0x80 == 0)].into_iter().flatten() {
            hears_nothing(&mut line, &sealed(&frame), now);
            now = now.saturating_add(SILENCE);
            assert!(!matches!(line.poll(now), Some(Event::Frame(_))), "{frame:x?}");
        }
    }
    while !script.is_empty() {
        let (pause, mut piece) = script.piece([0, 1000, 19_999, 20_000].map(Duration::from_micros));
        now = now.saturating_add(pause);
        while let Some(heard) = line.feed(&mut piece, now) {
            check(&heard);
        }
    }
    now = now.saturating_add(SILENCE);
    if let Some(heard) = line.poll(now) {
        check(&heard);
    }
    let request = sealed(&[6, 6, 0, 1, 0xAB, 0xCD]);
    let frame = rtu::Frame::decode(&request).unwrap();
    assert_eq!(line.feed(&mut &request[..], now), Some(Event::Frame(frame)));
});

/// What a master asks of another unit, and what that answers. A `payload` is cut or filled to what fits.
fn exchange(kind: u8, unit: u8, first: u8, quantity: u8, payload: &[u8]) -> (Vec<u8>, Option<Vec<u8>>) {
    let quantity = quantity % 120 + 1;
    let filled =
        |length: usize| -> Vec<u8> { payload.iter().copied().chain([0; 256]).take(length).collect() };
    let registers = filled(2 * usize::from(quantity));
    let count = 2 * quantity;
    match kind {
        0 | 1 => (
            vec![unit, 3 + kind, 0, first, 0, quantity],
            Some([&[unit, 3 + kind, count][..], &registers].concat()),
        ),
        2 => (
            [&[unit, 0x10, 0, first, 0, quantity, count][..], &registers].concat(),
            Some(vec![unit, 0x10, 0, first, 0, quantity]),
        ),
        3 => {
            let some = filled(2 * usize::from(quantity.min(118)));
            let count = some.len() as u8;
            (
                [&[unit, 0x17, 0, first, 0, quantity, 0, 0, 0, count / 2, count][..], &some].concat(),
                Some([&[unit, 0x17, 2 * quantity][..], &registers].concat()),
            )
        }
        4 => {
            // a function code that nobody knows
            let some = filled(usize::from(quantity));
            ([&[unit, 0x41][..], &some].concat(), Some([&[unit, 0x41][..], &some].concat()))
        }
        5 => (vec![unit, 6, 0, first, 0, quantity], Some(vec![unit, 6, 0, first, 0, quantity])),
        6 => (vec![unit, 1, 0, first, 0, quantity], Some(vec![unit, 0x81, 2])),
        _ => (vec![unit, 0x11], Some([&[unit, 0x11, quantity][..], &filled(quantity.into())].concat())),
    }
}

fn hears_nothing(line: &mut MultidropDecoder, mut bytes: &[u8], now: Instant) {
    let frame = bytes;
    while let Some(heard) = line.feed(&mut bytes, now) {
        assert!(!matches!(heard, Event::Frame(_)), "{heard:x?} in {frame:x?}");
    }
}

fn check(heard: &Event<'_>) {
    match heard {
        Event::Frame(frame) | Event::Foreign(frame) => assert!((1..=253).contains(&frame.pdu.len())),
        Event::Dropped(_) => {}
    }
}
