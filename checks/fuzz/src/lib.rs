//! What the fuzz targets share: reading a fuzzer's bytes as a script, frames with a right checksum, and the property
//! that every slave's side of a line has to have.
//!
//! A target that needs more than raw bytes reads them as a script of records, so that bytes which the fuzzer inserts
//! or drops change little of what follows.

use jointbus_protocol::checksum;
use jointbus_protocol::decode::{Dropped, Event, FrameDecoder, FrameEvent, Framing};
use jointbus_protocol::modbus::rtu::{self, ExpectedResponse};
use jointbus_protocol::modbus::{FunctionCode, Request};
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::Writer;

/// A fuzzer's bytes, read from the front. Past the end there are zeros.
#[derive(Clone, Copy)]
pub struct Script<'a>(pub &'a [u8]);

impl<'a> Script<'a> {
    /// Whether everything has been read.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// One byte.
    pub fn byte(&mut self) -> u8 {
        let [byte] = self.array();
        byte
    }

    /// Two bytes, the high one first.
    pub fn word(&mut self) -> u16 {
        u16::from_be_bytes(self.array())
    }

    /// So many bytes.
    pub fn array<const N: usize>(&mut self) -> [u8; N] {
        let mut array = [0; N];
        let taken = self.slice(N);
        array[..taken.len()].copy_from_slice(taken);
        array
    }

    /// Up to so many bytes.
    pub fn slice(&mut self, length: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(length.min(self.0.len()));
        self.0 = rest;
        taken
    }

    /// A record: a length byte, and so many bytes.
    pub fn record(&mut self) -> &'a [u8] {
        let length = self.byte();
        self.slice(length.into())
    }

    /// A piece of a byte stream and the pause before it: the top two bits of the first byte choose the pause, the
    /// others are the length.
    pub fn piece(&mut self, pauses: [Duration; 4]) -> (Duration, &'a [u8]) {
        let head = self.byte();
        (pauses[usize::from(head >> 6)], self.slice(usize::from(head & 0x3F)))
    }
}

/// `content` and its CRC.
pub fn sealed(content: &[u8]) -> Vec<u8> {
    let mut frame = vec![0; content.len() + checksum::CRC_LENGTH];
    let mut writer = Writer::new(&mut frame);
    writer.slice(content).unwrap();
    checksum::append_crc(&mut writer).unwrap();
    frame
}

/// What holds for every response: a whole frame that a master accepts as an answer to the data unit that it sent to
/// `unit`. Tells whether it is a refusal.
pub fn check_response(unit: u8, pdu: &[u8], frame: &[u8]) -> bool {
    let response = rtu::Frame::decode(frame).expect("a whole frame");
    let refused = response.pdu[0] & FunctionCode::EXCEPTION_FLAG != 0;
    assert_eq!(response.unit, unit);
    match Request::decode(pdu) {
        Ok(request) => {
            assert!(ExpectedResponse::new(unit, &request).accepts(frame), "{request:x?} {frame:x?}");
        }
        Err(_) => assert!(refused && response.pdu.len() == 2),
    }
    refused
}

/// The silence that ends a burst on the lines of [`survives`].
pub const SILENCE: Duration = Duration::from_millis(20);

/// What came out of a decoder, to be kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// A frame.
    Frame(Vec<u8>),
    /// A burst without one.
    Dropped(Vec<u8>),
}

impl From<FrameEvent<'_>> for Outcome {
    fn from(event: FrameEvent<'_>) -> Self {
        match event {
            Event::Frame(frame) => Self::Frame(frame.to_vec()),
            Event::Dropped(Dropped { burst, .. }) => Self::Dropped(burst.to_vec()),
        }
    }
}

/// Feeds the script to the slave's side of a line, then silence, then `request`, which must come out at once.
///
/// On the way: what comes out is no longer than a frame, valid, and the same whether bytes come alone or in pieces.
pub fn survives<const N: usize>(format: &impl Framing, mut script: Script<'_>, request: &[u8]) {
    const PAUSES: [Duration; 4] =
        [Duration::ZERO, Duration::from_millis(1), Duration::from_micros(19_999), SILENCE];
    let mut whole = FrameDecoder::<N>::new(SILENCE);
    let mut single = FrameDecoder::<N>::new(SILENCE);
    let mut now = Instant::from_micros(0);
    while !script.is_empty() {
        let (pause, piece) = script.piece(PAUSES);
        now = now.saturating_add(pause);
        let in_one = take(&mut whole, format, piece, now);
        let one_by_one: Vec<_> =
            piece.chunks(1).flat_map(|byte| take(&mut single, format, byte, now)).collect();
        assert_eq!(in_one, one_by_one);
        for outcome in in_one {
            match outcome {
                Outcome::Frame(frame) => assert!(format.is_valid(&frame) && frame.len() <= N),
                Outcome::Dropped(burst) => assert!(burst.len() <= N),
            }
        }
        assert_eq!(whole.deadline(), single.deadline());
        assert!(piece.is_empty() || whole.deadline().is_none_or(|end| end == now.saturating_add(SILENCE)));
    }
    now = now.saturating_add(SILENCE);
    whole.poll(format, now);
    assert_eq!(whole.deadline(), None);
    assert_eq!(take(&mut whole, format, request, now), [Outcome::Frame(request.to_vec())]);
}

fn take<const N: usize>(
    decoder: &mut FrameDecoder<N>,
    format: &impl Framing,
    mut bytes: &[u8],
    now: Instant,
) -> Vec<Outcome> {
    let mut outcomes = Vec::new();
    while let Some(event) = decoder.feed(format, &mut bytes, now) {
        outcomes.push(event.into());
    }
    assert!(bytes.is_empty());
    outcomes
}
