//! The master's side of a line: whatever comes before it, the reply is found, and nothing is taken for one that is
//! none.
#![no_main]

use jointbus_fuzz::{Script, sealed};
use jointbus_protocol::decode::{Match, ResponseMatcher};
use jointbus_protocol::modbus::rtu::ExpectedResponse;
use jointbus_protocol::modbus::{AddressRange, Request};
use jointbus_protocol::nst;
use libfuzzer_sys::fuzz_target;

const UNIT: u8 = 5;

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let way = script.byte();
    let quantity = u16::from(script.byte() % 126);
    let data = [0; 2];
    match way & 0x07 {
        4 => {
            let length = u8::try_from(quantity).unwrap();
            let expected = nst::stream::ExpectedResponse::new(UNIT, &nst::Request::read(0x0200, length));
            finds(&expected, script, &[&[UNIT, 0x03, length][..], &vec![way; length.into()]].concat());
        }
        0 => {
            let length = u8::try_from(quantity).unwrap();
            let expected = nst::serial::ExpectedResponse::new(UNIT, &nst::Request::read(0x0200, length));
            let reply = [&[UNIT, 0x03, length][..], &vec![way; length.into()]].concat();
            finds(&expected, script, &sealed(&reply));
        }
        1 => {
            let expected =
                ExpectedResponse::new(UNIT, &Request::ReadInputRegisters(AddressRange::new(0, quantity)));
            let bytes = u8::try_from(quantity * 2).unwrap();
            finds(&expected, script, &sealed(&[&[UNIT, 4, bytes][..], &vec![way; bytes.into()]].concat()));
        }
        2 => {
            let range = AddressRange::new(quantity, 1);
            let expected =
                ExpectedResponse::new(UNIT, &Request::WriteMultipleRegisters { range, data: &data });
            let [high, low] = quantity.to_be_bytes();
            finds(&expected, script, &sealed(&[UNIT, 0x10, high, low, 0, 1]));
        }
        _ => {
            let expected = ExpectedResponse::new(UNIT, &Request::ReadCoils(AddressRange::new(0, quantity)));
            finds(&expected, script, &sealed(&[UNIT, 0x81, 4]));
        }
    }
});

fn finds<const L: usize>(expected: &impl Match<L>, mut script: Script<'_>, reply: &[u8]) {
    let mut search = ResponseMatcher::<320, L>::default();
    while !script.is_empty() {
        feed(&mut search, expected, script.record());
    }
    // it may be found earlier still: in what came before and the first bytes of the reply
    assert!(feed(&mut search, expected, reply) > 0);
}

fn feed<const L: usize>(
    search: &mut ResponseMatcher<320, L>,
    expected: &impl Match<L>,
    mut bytes: &[u8],
) -> usize {
    let mut found = 0;
    while let Some((kind, frame)) = search.feed(expected, &mut bytes) {
        assert_eq!(frame.len(), expected.lengths()[kind]);
        assert!(expected.accepts(kind, frame));
        found += 1;
    }
    assert!(bytes.is_empty());
    found
}
