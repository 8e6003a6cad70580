//! NST transfers over CAN: frames in any order from any node; nothing is delivered in part, and once every transfer
//! is overdue a whole one comes through.
#![no_main]

use jointbus_fuzz::Script;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::nst::can::{
    BROADCAST, Identifier, Outcome, PushResult, Reassembler, ReassemblyError, TRANSFER_MAX, segment,
};
use jointbus_protocol::time::{Duration, Instant};
use libfuzzer_sys::fuzz_target;

const NODE: u8 = 5;
const LIMIT: Duration = Duration::from_millis(10);

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let mut reassembler = Reassembler::<2>::new(NODE, LIMIT);
    let mut now = Instant::from_micros(0);
    while !script.is_empty() {
        now = now.saturating_add(Duration::from_micros(u64::from(script.byte()) * 100));
        let head = script.byte();
        let raw = match head & 0x30 {
            // few nodes, so that their transfers meet
            0x00 | 0x10 => u32::from_be_bytes([0, head & 3, NODE, script.byte()]),
            0x20 => u32::from_be_bytes([0, head & 3, BROADCAST, script.byte()]),
            _ => u32::from_be_bytes(script.array()) & 0x1FFF_FFFF,
        };
        let id = if head & 0x40 == 0 { Id::Extended(raw) } else { Id::Standard(raw as u16 & 0x7FF) };
        let dlc = script.byte() & 0x0F;
        let payload = script.array();
        let frame = Frame::from_parts(id, head & 0x80 != 0, dlc, payload).unwrap();
        let identifier = Identifier::from_raw(raw);
        if let Some(identifier) = identifier {
            assert_eq!(Identifier::to_raw(identifier), raw);
        }
        let PushResult { outcome, error } = reassembler.push(&frame, now);
        match outcome {
            Some(Outcome::Complete { source, destination, body }) => {
                let identifier = identifier.unwrap();
                assert_eq!((source, destination), (identifier.source, identifier.destination));
                assert!(destination == NODE || destination == BROADCAST);
                assert!(!body.is_empty() && body.len() <= TRANSFER_MAX);
                assert!(body.ends_with(frame.data()), "the last frame ends the body");
                assert_eq!(body.len().div_ceil(8), usize::from(identifier.counter) + 1, "nothing in part");
            }
            Some(Outcome::More) => assert_eq!(frame.data().len(), 8),
            None => assert!(error.is_some(), "what brings nothing says why"),
        }
        if outcome.is_some() {
            assert!(matches!(error, None | Some(ReassemblyError::Restarted)));
        }
    }
    now = now.saturating_add(LIMIT).saturating_add(Duration::from_micros(1));
    let body: Vec<u8> = data.iter().copied().chain([1]).take(TRANSFER_MAX).collect();
    let mut delivered = None;
    for frame in segment(9, NODE, &body).unwrap() {
        if let Some(Outcome::Complete { body, .. }) = reassembler.push(&frame, now).outcome {
            delivered = Some(body.to_vec());
        }
    }
    assert_eq!(delivered, Some(body));
});
