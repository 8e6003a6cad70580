//! A serial port whose interrupt and main loop share two bounded queues.
//!
//! The end of a transmission stands in the same queue as the received bytes, so that a reply is never taken for
//! something that came before the request had left.

use crate::engine::Engine;
use crate::engine::config::Port;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use heapless::spsc::{Consumer, Producer, Queue};
use jointbus_protocol::modbus::rtu;
use jointbus_protocol::time::Instant;

/// Received bytes and ends of transmissions that wait for the main loop, where frames come one behind the other: more
/// than a whole frame, some 3 ms at the fastest rate.
pub const INCOMING: usize = 288;

/// The same where a reply comes at a time, which the main loop takes in while it comes.
pub const INCOMING_REPLY: usize = 128;

/// Bytes that wait to be sent: a whole frame, so that an RS485 driver is never released inside one.
pub const OUTGOING: usize = rtu::FRAME_MAX + 1;

/// What an interrupt reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Report(u16);

impl Report {
    /// The last stop bit has left and the driver is off.
    pub const TRANSMITTED: Self = Self(0x100);

    /// A byte came in.
    #[must_use]
    pub const fn byte(byte: u8) -> Self {
        Self(byte as u16)
    }
}

/// Queues of a port, with room for `IN` received bytes less one.
#[derive(Debug)]
pub struct Queues<const IN: usize = INCOMING> {
    incoming: Queue<Report, IN>,
    outgoing: Queue<u8, OUTGOING>,
    shared: Shared,
}

/// What interrupt and main loop tell each other beside the queues.
#[derive(Debug)]
struct Shared {
    /// When the last byte ended: low half of the microseconds.
    last_byte: AtomicU32,
    /// Bytes were lost since the main loop looked last.
    overrun: AtomicBool,
    /// The transmitter has taken a byte, or finished, since the main loop looked last.
    advanced: AtomicBool,
    /// It has taken a byte, and not finished.
    sending: AtomicBool,
}

impl<const IN: usize> Queues<IN> {
    /// Empty queues.
    #[must_use]
    pub const fn new() -> Self {
        let shared = Shared {
            last_byte: AtomicU32::new(0),
            overrun: AtomicBool::new(false),
            advanced: AtomicBool::new(false),
            sending: AtomicBool::new(false),
        };
        Self { incoming: Queue::new(), outgoing: Queue::new(), shared }
    }

    /// The interrupt's end and the main loop's end.
    pub fn split(&mut self) -> (InterruptSide<'_>, MainSide<'_>) {
        let (put, get) = self.incoming.split();
        let (put_out, get_out) = self.outgoing.split();
        let shared = &self.shared;
        (
            InterruptSide { incoming: put, outgoing: get_out, shared },
            MainSide { incoming: get, outgoing: put_out, shared },
        )
    }
}

impl<const IN: usize> Default for Queues<IN> {
    fn default() -> Self {
        Self::new()
    }
}

/// The interrupt's end of a port's queues.
pub struct InterruptSide<'a> {
    incoming: Producer<'a, Report>,
    outgoing: Consumer<'a, u8>,
    shared: &'a Shared,
}

impl InterruptSide<'_> {
    /// A byte ended at `micros`, the low half of the microseconds since boot.
    #[inline]
    pub fn received(&mut self, byte: u8, micros: u32) {
        self.shared.last_byte.store(micros, Ordering::Relaxed);
        if self.incoming.enqueue(Report::byte(byte)).is_err() {
            self.lost();
        }
    }

    /// The port lost bytes.
    pub fn lost(&mut self) {
        self.shared.overrun.store(true, Ordering::Relaxed);
    }

    /// The last stop bit has left and the driver is off.
    pub fn transmitted(&mut self) {
        self.shared.advanced.store(true, Ordering::Relaxed);
        self.shared.sending.store(false, Ordering::Relaxed);
        if self.incoming.enqueue(Report::TRANSMITTED).is_err() {
            self.lost();
        }
    }

    /// The next byte to send.
    #[inline]
    pub fn next_byte(&mut self) -> Option<u8> {
        let byte = self.outgoing.dequeue()?;
        self.shared.advanced.store(true, Ordering::Relaxed);
        self.shared.sending.store(true, Ordering::Relaxed);
        Some(byte)
    }

    /// Whether nothing is left to send.
    #[must_use]
    pub fn is_drained(&self) -> bool {
        !self.outgoing.ready()
    }
}

/// The main loop's end of a port's queues.
pub struct MainSide<'a> {
    incoming: Consumer<'a, Report>,
    outgoing: Producer<'a, u8>,
    shared: &'a Shared,
}

impl MainSide<'_> {
    /// Whether the interrupt has put something down.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        !self.incoming.ready()
    }

    /// Whether nothing is to be sent, or the transmitter has advanced since this was asked last.
    pub fn advances(&mut self) -> bool {
        let advanced = self.shared.advanced.swap(false, Ordering::Relaxed);
        advanced || self.outgoing.is_empty() && !self.shared.sending.load(Ordering::Relaxed)
    }

    /// Carries what came in to the engine.
    pub fn carry_in(&mut self, engine: &mut Engine, port: Port, now: Instant) {
        if self.shared.overrun.swap(false, Ordering::Relaxed) {
            engine.overrun(port);
        }
        let mut chunk = heapless::Vec::<u8, 64>::new();
        // no more than the queue holds, so that a babbling line cannot keep the main loop here
        for _ in 0..INCOMING {
            match self.incoming.dequeue() {
                Some(Report::TRANSMITTED) => {
                    self.flush(&mut chunk, engine, port, now);
                    engine.transmitted(port, now);
                }
                Some(Report(byte)) => {
                    let [byte, _] = byte.to_le_bytes();
                    if chunk.is_full() {
                        self.flush(&mut chunk, engine, port, now);
                    }
                    // there is room now
                    let _ = chunk.push(byte);
                }
                None => break,
            }
        }
        self.flush(&mut chunk, engine, port, now);
    }

    /// Carries what the engine has to send to the interrupt; tells whether there was any.
    pub fn carry_out(&mut self, engine: &mut Engine, port: Port) -> bool {
        let mut taken = 0usize;
        for byte in engine.output(port) {
            if self.outgoing.enqueue(*byte).is_err() {
                break;
            }
            taken = taken.saturating_add(1);
        }
        engine.consume(port, taken);
        taken > 0
    }

    fn flush(&self, chunk: &mut heapless::Vec<u8, 64>, engine: &mut Engine, port: Port, now: Instant) {
        if !chunk.is_empty() {
            engine.receive(port, chunk, recent(now, self.shared.last_byte.load(Ordering::Relaxed)));
            chunk.clear();
        }
    }
}

/// The moment not after `now`, and not as much as 71 minutes before, whose low half is `micros`.
#[must_use]
pub fn recent(now: Instant, micros: u32) -> Instant {
    let [_, _, _, _, low @ ..] = now.as_micros().to_be_bytes();
    let age = u32::from_be_bytes(low).wrapping_sub(micros);
    // a byte that ended since `now` was read would look very old
    let age = if age > u32::MAX / 2 { 0 } else { age };
    Instant::from_micros(now.as_micros().saturating_sub(age.into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Identity, ResetCause};

    #[test]
    fn stamps_are_recent() {
        let at = |now: u64, micros: u32| recent(Instant::from_micros(now), micros).as_micros();
        assert_eq!(at(1000, 990), 990);
        assert_eq!(at(1000, 1005), 1000, "not after now");
        assert_eq!(at(0x1_0000_0005, 0xFFFF_FFFE), 0xFFFF_FFFE);
        assert_eq!(at(0x5_0000_0005, 0xFFFF_FFFE), 0x4_FFFF_FFFE);
    }

    #[test]
    fn a_request_passes_and_its_answer_comes_back() {
        let now = Instant::from_micros(5);
        let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
        let mut engine = Engine::new(identity, now);
        let mut queues = Queues::<INCOMING>::new();
        let (mut interrupt, mut main) = queues.split();
        let request = jointbus_protocol::modbus::Request::ReadInputRegisters(
            jointbus_protocol::modbus::Range::new(0, 120),
        );
        let mut buffer = [0; 16];
        for byte in rtu::encode_request(247, &request, &mut buffer).unwrap() {
            interrupt.received(*byte, 5);
        }
        assert!(!main.is_idle());
        main.carry_in(&mut engine, Port::Host, now);
        assert!(main.is_idle());
        assert!(main.carry_out(&mut engine, Port::Host));
        let sent: std::vec::Vec<u8> = core::iter::from_fn(|| interrupt.next_byte()).collect();
        assert_eq!(sent.len(), 245);
        assert!(rtu::Frame::decode(&sent).is_ok());
        assert!(interrupt.is_drained());
    }

    #[test]
    fn a_transmitter_that_takes_nothing_stands_still() {
        let now = Instant::from_micros(0);
        let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
        let mut engine = Engine::new(identity, now);
        let mut queues = Queues::<INCOMING>::new();
        let (mut interrupt, mut main) = queues.split();
        assert!(main.advances(), "there is nothing to send");
        let request = jointbus_protocol::modbus::Request::ReadInputRegisters(
            jointbus_protocol::modbus::Range::new(0, 1),
        );
        engine.receive(Port::Host, rtu::encode_request(247, &request, &mut [0; 16]).unwrap(), now);
        assert!(main.carry_out(&mut engine, Port::Host));
        assert!(!main.advances());
        assert!(interrupt.next_byte().is_some());
        assert!(main.advances());
        assert!(!main.advances());
        while interrupt.next_byte().is_some() {}
        assert!(main.advances());
        assert!(!main.advances(), "the last byte does not leave");
        interrupt.transmitted();
        assert!(main.advances());
        assert!(main.advances(), "there is nothing to send");
    }

    #[test]
    fn lost_bytes_are_counted() {
        let now = Instant::from_micros(0);
        let identity = Identity { version: [0, 1, 0], reset_cause: ResetCause::PowerOn };
        let mut engine = Engine::new(identity, now);
        let mut queues = Queues::<INCOMING>::new();
        let (mut interrupt, mut main) = queues.split();
        for _ in 0..INCOMING + 1 {
            interrupt.received(0x55, 0);
        }
        main.carry_in(&mut engine, Port::Host, now);
        assert_eq!(engine.counters(Port::Host).overruns, 1);
    }
}
