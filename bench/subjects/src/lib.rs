//! What is measured: a frame in, a frame out, both in memory.
#![no_std]

pub mod device;
pub mod server;
pub mod transfer;

/// Longest frame.
pub const FRAME_MAX: usize = 256;

/// A request: what it is, its bytes, and the CRC that is to follow them.
#[derive(Debug, Clone, Copy)]
pub struct Request {
    /// For the report.
    pub name: &'static str,
    /// The frame without its CRC.
    pub content: &'static [u8],
    /// Whether the CRC is right.
    pub valid: bool,
}

impl Request {
    const fn new(name: &'static str, content: &'static [u8]) -> Self {
        Self { name, content, valid: true }
    }

    /// Writes the frame; its length.
    #[inline(never)]
    pub fn write(&self, frame: &mut [u8; FRAME_MAX]) -> usize {
        let mut crc = 0xFFFF_u16;
        for (place, byte) in frame.iter_mut().zip(self.content) {
            *place = *byte;
            crc ^= u16::from(*byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 };
            }
        }
        let crc = if self.valid { crc } else { crc ^ 0x0100 };
        let length = self.content.len();
        frame[length..length + 2].copy_from_slice(&crc.to_le_bytes());
        length + 2
    }
}

/// One thing to be measured.
pub trait Subject {
    /// What it is asked.
    const REQUESTS: &'static [Request];

    /// In its first state.
    fn new() -> Self;

    /// Answers a frame; the length of the answer, 0 for silence.
    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize;
}

/// Nothing: what the others are compared with.
pub struct Empty;

impl Subject for Empty {
    const REQUESTS: &'static [Request] = server::REQUESTS;

    fn new() -> Self {
        Self
    }

    fn serve(&mut self, _: &[u8], _: &mut [u8; FRAME_MAX]) -> usize {
        0
    }
}
