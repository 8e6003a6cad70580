//! What bytes cost in which no frame is: as much each, however many they are.

use std::hint::black_box;

use jointbus_protocol::decode::{FrameDecoder, ResponseMatcher};
use jointbus_protocol::modbus::{AddressRange, ExpectedResponse, Request, rtu};
use jointbus_protocol::time::{Duration, Instant};

use crate::count;

/// How many bytes: what is compared.
const LENGTHS: [usize; 2] = [1024, 64 * 1024];

/// Garbage of a kind.
type Garbage = fn(usize) -> Vec<u8>;

const KINDS: [(&str, Garbage); 2] = [("random bytes", random), ("beginnings of replies", beginnings)];

pub(crate) fn all() {
    for (kind, garbage) in KINDS {
        for length in LENGTHS {
            let bytes = garbage(length);
            count(&format!("decode request, {kind}"), &length.to_string(), || bursts(black_box(&bytes)));
            let mut search = Search::behind(&bytes);
            count(&format!("decode reply, {kind}"), &length.to_string(), || search.take(black_box(&bytes)));
        }
    }
}

/// The same 1024 bytes over and over, so that the lengths have the same to do with each; Numerical Recipes' generator.
fn random(length: usize) -> Vec<u8> {
    let mut state = 1_u32;
    let next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state.to_le_bytes()[3]
    };
    let some: Vec<u8> = std::iter::repeat_with(next).take(LENGTHS[0]).collect();
    some.into_iter().cycle().take(length).collect()
}

/// Unit and function code of a reply, everywhere: each one asks for a CRC.
fn beginnings(length: usize) -> Vec<u8> {
    [1, 3, 250].into_iter().cycle().take(length).collect()
}

/// The slave's side: bursts with a silence behind each.
fn bursts(bytes: &[u8]) {
    const SILENCE: u64 = 1750;
    let mut decoder = FrameDecoder::<260>::new(Duration::from_micros(SILENCE));
    let mut now = 0;
    for mut burst in bytes.chunks(64) {
        now += SILENCE;
        let at = Instant::from_micros(now);
        black_box(decoder.poll(&rtu::RequestFraming, at));
        while !burst.is_empty() {
            black_box(decoder.feed(&rtu::RequestFraming, &mut burst, at));
        }
    }
}

/// The master's side, which waits for the longest reply.
struct Search {
    expected: ExpectedResponse,
    search: ResponseMatcher<WINDOW, 2>,
}

/// Bytes that it looks back on.
const WINDOW: usize = 320;

impl Search {
    /// It has kept as many bytes as it can: the first few of all have less to do.
    fn behind(bytes: &[u8]) -> Self {
        let request = Request::ReadHoldingRegisters(AddressRange::new(0, 125));
        let expected = ExpectedResponse::new(1, &request);
        let mut search = Self { expected, search: ResponseMatcher::default() };
        search.take(&bytes[..WINDOW]);
        search
    }

    fn take(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            black_box(self.search.feed(&self.expected, &mut bytes));
        }
    }
}
