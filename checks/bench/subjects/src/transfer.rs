//! NST over CAN: a reply of 20 bytes in three frames.

use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::nst::can::{Outcome, Reassembler, segment};
use jointbus_protocol::time::{Duration, Instant};

use crate::{FRAME_MAX, Kind, Subject};

const SENSOR: u8 = 1;
const BRIDGE: u8 = 127;

/// A reply to a read of 18 bytes.
pub(crate) const REPLY: [u8; 20] = [0x03, 18, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18];

/// Three frames become a body.
pub struct Join {
    reassembler: Reassembler<2>,
    frames: [Frame; 3],
}

impl Subject for Join {
    const KIND: Kind = Kind::Transfer;

    fn new() -> Self {
        let mut frames = [Frame::data_frame(Id::Extended(0), &[]).expect("short enough"); 3];
        let cut = segment(SENSOR, BRIDGE, &REPLY).expect("short enough");
        frames.iter_mut().zip(cut).for_each(|(place, frame)| *place = frame);
        Self { reassembler: Reassembler::new(BRIDGE, Duration::from_millis(10)), frames }
    }

    fn serve(&mut self, _: &[u8], _: &mut [u8; FRAME_MAX]) -> usize {
        let mut joined = 0;
        for frame in &self.frames {
            if let Some(Outcome::Complete { body, .. }) =
                self.reassembler.push(frame, Instant::from_micros(1)).outcome
            {
                joined = core::hint::black_box(body).len();
            }
        }
        joined
    }
}

/// A body becomes three frames.
pub struct Cut;

impl Subject for Cut {
    const KIND: Kind = Kind::Transfer;

    fn new() -> Self {
        Self
    }

    fn serve(&mut self, frame: &[u8], _: &mut [u8; FRAME_MAX]) -> usize {
        // without the CRC, which CAN does not carry
        let body = frame.split_last_chunk::<2>().map_or(frame, |(body, _)| body);
        let Ok(frames) = segment(SENSOR, BRIDGE, body) else { return 0 };
        let mut cut = 0;
        for frame in frames {
            cut += core::hint::black_box(&frame).data().len();
        }
        cut
    }
}
