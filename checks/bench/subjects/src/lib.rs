//! What is measured: a frame in, a frame out, both in memory.
#![no_std]

pub mod device;
#[cfg(feature = "others")]
pub mod others;
mod request;
pub mod routes;
pub mod server;
pub mod transfer;

pub use request::{Kind, REQUESTS, Request, Requests};

/// Longest frame.
pub const FRAME_MAX: usize = 256;

/// One thing to be measured.
pub trait Subject {
    /// What it is asked.
    const KIND: Kind;

    /// In its first state.
    fn new() -> Self;

    /// Answers a frame; the length of the answer, 0 for silence.
    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize;
}

/// Nothing: what the others are compared with.
pub struct Empty;

impl Subject for Empty {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self
    }

    fn serve(&mut self, _: &[u8], _: &mut [u8; FRAME_MAX]) -> usize {
        0
    }
}
