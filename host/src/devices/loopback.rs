//! Devices in memory, at the other end of a stream or of a CAN transfer, in virtual time.

use super::{CanBus, SerialLine};
use jointbus_protocol::nst::can::{Outcome, Reassembler, segment};
use jointbus_protocol::time::{Duration, Instant};
use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};

/// Virtual time that a read waits when nothing is there: longer than any silence that ends a burst.
const PAUSE: Duration = Duration::from_millis(10_000);

/// A stream to the devices of a serial line: what is written is answered at once. Time stands still, except that a
/// read of nothing lets a long while pass.
#[derive(Debug)]
pub struct Loopback<L> {
    /// The devices.
    pub line: L,
    now: Instant,
    waiting: VecDeque<u8>,
}

impl<L: SerialLine> Loopback<L> {
    /// A stream to these devices.
    pub const fn new(line: L) -> Self {
        Self { line, now: Instant::from_micros(0), waiting: VecDeque::new() }
    }

    /// The present moment of this stream.
    #[must_use]
    pub const fn now(&self) -> Instant {
        self.now
    }

    /// Lets time pass.
    pub fn advance(&mut self, span: Duration) {
        self.now = self.now.saturating_add(span);
        self.waiting.extend(self.line.poll(self.now));
    }

    /// Has bytes come from the line that no device sent.
    pub fn disturb(&mut self, bytes: &[u8]) {
        self.waiting.extend(bytes);
    }
}

impl<L: SerialLine> Read for Loopback<L> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.waiting.is_empty() {
            self.advance(PAUSE);
        }
        match self.waiting.read(buffer)? {
            0 => Err(ErrorKind::WouldBlock.into()),
            length => Ok(length),
        }
    }
}

impl<L: SerialLine> Write for Loopback<L> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.waiting.extend(self.line.receive(bytes, self.now));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Sends a body from node `host` to node `node` and joins what that node answers to it; `None` where it is silent or
/// the body fits no transfer.
pub fn transfer(bus: &mut impl CanBus, host: u8, node: u8, body: &[u8], now: Instant) -> Option<Vec<u8>> {
    let mut reassembler = Reassembler::<8>::new(host, Duration::ZERO);
    let mut answer = None;
    for frame in segment(host, node, body).ok()? {
        for reply in bus.receive(&frame, now) {
            if let Some(Outcome::Complete { source, body, .. }) = reassembler.push(&reply, now).outcome
                && source == node
            {
                answer = Some(body.to_vec());
            }
        }
    }
    answer
}
