//! A serial port whose interrupt and main loop share two bounded rings of bytes.
//!
//! The end of a transmission is kept with its place among the received bytes, so that a response is never taken for
//! something that came before the request had left. The rings are no queues of a crate because an interrupt per byte is to be
//! short: their length is a power of two and known when it is compiled, and all they need are words that are loaded and
//! stored whole: a Cortex-M0+ has no other atomic operations. What the interrupt counts it alone writes; the main loop
//! remembers how far it has seen the count.
//!
//! # The interrupt's side
//!
//! An RS485 port whose driver is on from before the first bit until after the last stop bit:
//!
//! ```
//! use jointbus_mcu_bridge::io::serial::{IsrHalf, RX_CAPACITY_RESPONSES, UartBuffers};
//!
//! /// The registers of a UART, and the pin of its driver.
//! trait Uart {
//!     fn received(&mut self) -> Option<u8>;
//!     /// A character came with a wrong parity or stop bit.
//!     fn had_error(&mut self) -> bool;
//!     fn is_empty(&self) -> bool;
//!     /// The last stop bit has left.
//!     fn is_complete(&self) -> bool;
//!     fn send(&mut self, byte: u8);
//!     fn drive(&mut self, on: bool);
//!     fn enable_interrupts(&mut self, empty: bool, complete: bool);
//! }
//!
//! /// Also pended by the main loop when it has put something down for sending.
//! fn on_interrupt(uart: &mut impl Uart, port: &mut IsrHalf<'_, RX_CAPACITY_RESPONSES>, micros: u32) {
//!     if let Some(byte) = uart.received() {
//!         let byte = if uart.had_error() { port.transmitter().framing_error(byte) } else { byte };
//!         port.received(byte, micros);
//!     }
//!     if !port.is_sending() {
//!         return;
//!     }
//!     let mut transmitter = port.transmitter();
//!     while uart.is_empty() && let Some(byte) = transmitter.next_byte() {
//!         if !transmitter.set_driving(true) {
//!             uart.drive(true);
//!         }
//!         uart.send(byte);
//!     }
//!     let drained = transmitter.is_drained();
//!     if drained && transmitter.is_driving() && uart.is_complete() {
//!         uart.drive(false);
//!         transmitter.set_driving(false);
//!         transmitter.transmitted(micros);
//!     }
//!     uart.enable_interrupts(!drained, drained && transmitter.is_driving());
//! }
//!
//! let mut buffers = UartBuffers::<RX_CAPACITY_RESPONSES>::new();
//! // the interrupt owns one, the main loop the other
//! let (_interrupt, _main) = buffers.split();
//! ```

use crate::board::Port;
use crate::engine::AnyEngine;
use core::sync::atomic::{AtomicBool, AtomicU8, AtomicU32, Ordering};
use heapless::Vec;
use jointbus_protocol::modbus::rtu;
use jointbus_protocol::time::Instant;

/// Received bytes that wait for the main loop, where frames come one behind the other: a whole frame, 2.8 ms at the
/// fastest rate.
pub const RX_CAPACITY: usize = 256;

/// The same where a reply comes at a time, which the main loop takes in while it comes.
pub const RX_CAPACITY_RESPONSES: usize = 128;

/// Bytes that wait to be sent: a whole frame, so that an RS485 driver is never released inside one.
pub const TX_CAPACITY: usize = rtu::FRAME_MAX;

/// Bytes handed to the engine at a time.
const CHUNK: usize = 64;

/// Bytes from one who puts them in to one who takes them out. The indices count on and on; their difference is what
/// waits.
#[derive(Debug)]
struct Ring<const N: usize> {
    ends: Ends,
    bytes: [AtomicU8; N],
}

#[derive(Debug)]
struct Ends {
    put: AtomicU32,
    taken: AtomicU32,
}

impl Ends {
    fn length(&self) -> u32 {
        self.put.load(Ordering::Acquire).wrapping_sub(self.taken.load(Ordering::Acquire))
    }
}

impl<const N: usize> Ring<N> {
    const MASK: u32 = {
        assert!(N.is_power_of_two());
        N as u32 - 1
    };

    const fn new() -> Self {
        Self {
            ends: Ends { put: AtomicU32::new(0), taken: AtomicU32::new(0) },
            bytes: [const { AtomicU8::new(0) }; N],
        }
    }

    /// Puts a byte in, where there is room.
    #[inline(always)]
    fn put(&self, byte: u8) -> bool {
        let put = self.ends.put.load(Ordering::Relaxed);
        let full = put.wrapping_sub(self.ends.taken.load(Ordering::Acquire)) > Self::MASK;
        if full {
            return false;
        }
        if let Some(place) = self.bytes.get((put & Self::MASK) as usize) {
            place.store(byte, Ordering::Relaxed);
        }
        self.ends.put.store(put.wrapping_add(1), Ordering::Release);
        true
    }

    /// Puts in as many bytes as there is room for; tells how many.
    fn put_all(&self, bytes: &[u8]) -> usize {
        let put = self.ends.put.load(Ordering::Relaxed);
        let used = put.wrapping_sub(self.ends.taken.load(Ordering::Acquire));
        let room = (N as u32).saturating_sub(used) as usize;
        let bytes = bytes.get(..room).unwrap_or(bytes);
        let (before, behind) = self.bytes.split_at_checked((put & Self::MASK) as usize).unwrap_or_default();
        let (first, rest) = bytes.split_at_checked(behind.len()).unwrap_or((bytes, &[]));
        store_all(behind, first);
        store_all(before, rest);
        self.ends.put.store(put.wrapping_add(bytes.len() as u32), Ordering::Release);
        bytes.len()
    }

    fn take(&self) -> Option<u8> {
        let taken = self.ends.taken.load(Ordering::Relaxed);
        if taken == self.ends.put.load(Ordering::Acquire) {
            return None;
        }
        let byte = self.bytes.get((taken & Self::MASK) as usize)?.load(Ordering::Relaxed);
        self.ends.taken.store(taken.wrapping_add(1), Ordering::Release);
        Some(byte)
    }
}

/// Stores bytes at the front of `places`.
fn store_all(places: &[AtomicU8], bytes: &[u8]) {
    places.iter().zip(bytes).for_each(|(place, byte)| place.store(*byte, Ordering::Relaxed));
}

/// Rings of a port, with room for `IN` received bytes.
#[derive(Debug)]
pub struct UartBuffers<const IN: usize = RX_CAPACITY> {
    incoming: Ring<IN>,
    shared: Shared,
    seen: Seen,
}

/// What interrupt and main loop share beside the received bytes.
#[derive(Debug)]
struct Shared {
    outgoing: Ring<TX_CAPACITY>,
    /// When the last byte ended.
    last_byte: AtomicU32,
    /// How many bytes had come when the last transmission ended.
    ended_at: AtomicU32,
    /// When that was.
    ended_micros: AtomicU32,
    /// A transmission ended since the main loop looked last.
    ended: AtomicBool,
    /// Times that bytes were lost.
    overruns: Count,
    /// Times that the transmitter has taken a byte, or finished.
    progress: Count,
    /// It has something to send, or has not finished.
    sending: AtomicBool,
    /// For the interrupt alone: a byte is on the wire, or will be.
    driving: AtomicBool,
    /// Characters with errors.
    errors: Count,
}

/// A count that the interrupt alone changes. It wraps around; the main loop compares.
#[derive(Debug)]
struct Count(AtomicU32);

impl Count {
    const fn new() -> Self {
        Self(AtomicU32::new(0))
    }

    #[inline(always)]
    fn increment(&self) {
        self.0.store(self.0.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    }

    /// How many there are more than `seen`, which is brought up to date.
    fn more_than(&self, seen: &mut u32) -> u32 {
        let now = self.0.load(Ordering::Relaxed);
        now.wrapping_sub(core::mem::replace(seen, now))
    }

    fn is(&self, seen: u32) -> bool {
        self.0.load(Ordering::Relaxed) == seen
    }
}

/// How far the main loop has seen each [`Count`].
#[derive(Debug)]
struct Seen {
    overruns: u32,
    progress: u32,
    errors: u32,
}

impl<const IN: usize> UartBuffers<IN> {
    /// Empty rings; `IN` is a power of two.
    #[must_use]
    pub const fn new() -> Self {
        let shared = Shared {
            outgoing: Ring::new(),
            last_byte: AtomicU32::new(0),
            ended_at: AtomicU32::new(0),
            ended_micros: AtomicU32::new(0),
            ended: AtomicBool::new(false),
            overruns: Count::new(),
            progress: Count::new(),
            sending: AtomicBool::new(false),
            driving: AtomicBool::new(false),
            errors: Count::new(),
        };
        Self { incoming: Ring::new(), shared, seen: Seen { overruns: 0, progress: 0, errors: 0 } }
    }

    /// The interrupt's end and the main loop's end.
    pub fn split(&mut self) -> (IsrHalf<'_, IN>, MainHalf<'_>) {
        let Self { incoming, shared, seen } = self;
        (
            IsrHalf { incoming, transmitter: TransmitterSide { ends: &incoming.ends, shared } },
            MainHalf { bytes: &incoming.bytes, ends: &incoming.ends, shared, seen },
        )
    }
}

impl<const IN: usize> Default for UartBuffers<IN> {
    fn default() -> Self {
        Self::new()
    }
}

/// The interrupt's end of a port's rings.
#[derive(Debug)]
pub struct IsrHalf<'a, const IN: usize = RX_CAPACITY> {
    incoming: &'a Ring<IN>,
    transmitter: TransmitterSide<'a>,
}

impl<const IN: usize> IsrHalf<'_, IN> {
    /// A byte ended at `micros`, the low half of the microseconds since boot.
    #[inline(always)]
    pub fn received(&mut self, byte: u8, micros: u32) {
        let shared = self.transmitter.shared;
        shared.last_byte.store(micros, Ordering::Relaxed);
        if !self.incoming.put(byte) {
            shared.overruns.increment();
        }
    }

    /// Whether the transmitter has something to do.
    #[inline(always)]
    #[must_use]
    pub fn is_sending(&self) -> bool {
        self.transmitter.shared.sending.load(Ordering::Relaxed)
    }

    /// What sends, and hears of errors.
    pub fn transmitter(&mut self) -> TransmitterSide<'_> {
        TransmitterSide { ..self.transmitter }
    }
}

/// What the transmitter and errors have of the interrupt's end, alike for all ports.
#[derive(Debug)]
pub struct TransmitterSide<'a> {
    ends: &'a Ends,
    shared: &'a Shared,
}

impl TransmitterSide<'_> {
    /// The last stop bit left at `micros`, the low half of the microseconds since boot, and the driver is off.
    pub fn transmitted(&mut self, micros: u32) {
        let shared = self.shared;
        shared.progress.increment();
        shared.sending.store(false, Ordering::Relaxed);
        shared.ended_at.store(self.ends.put.load(Ordering::Relaxed), Ordering::Relaxed);
        shared.ended_micros.store(micros, Ordering::Relaxed);
        shared.ended.store(true, Ordering::Release);
    }

    /// A byte came whose parity or stop bit was wrong. Its complement, which is returned, takes its place: a frame around
    /// it keeps its length, and as all that is wrong lies within eight bits, its checksum is certain not to fit.
    #[must_use]
    pub fn framing_error(&mut self, byte: u8) -> u8 {
        self.noise_error();
        !byte
    }

    /// There was noise on the line, or something else wrong with a byte.
    pub fn noise_error(&mut self) {
        self.shared.errors.increment();
    }

    /// The port lost bytes.
    pub fn overrun(&mut self) {
        self.shared.overruns.increment();
    }

    /// Whether a byte is on the wire, or will be.
    #[must_use]
    pub fn is_driving(&self) -> bool {
        self.shared.driving.load(Ordering::Relaxed)
    }

    /// Keeps whether a byte is on the wire, or will be; tells whether one was.
    pub fn set_driving(&mut self, driving: bool) -> bool {
        let was_driving = self.is_driving();
        self.shared.driving.store(driving, Ordering::Relaxed);
        was_driving
    }

    /// There was nothing to send after all.
    pub fn stop(&mut self) {
        self.shared.sending.store(false, Ordering::Relaxed);
    }

    /// The next byte to send.
    pub fn next_byte(&mut self) -> Option<u8> {
        let byte = self.shared.outgoing.take()?;
        self.shared.progress.increment();
        Some(byte)
    }

    /// Whether nothing is left to send.
    #[must_use]
    pub fn is_drained(&self) -> bool {
        self.shared.outgoing.ends.length() == 0
    }
}

/// The main loop's end of a port's rings.
#[derive(Debug)]
pub struct MainHalf<'a> {
    bytes: &'a [AtomicU8],
    ends: &'a Ends,
    shared: &'a Shared,
    seen: &'a mut Seen,
}

impl MainHalf<'_> {
    /// Whether the interrupt has put nothing down.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.ends.length() == 0 && !self.shared.ended.load(Ordering::Relaxed)
    }

    /// Whether the interrupt has noticed nothing wrong.
    fn is_well(&self) -> bool {
        self.shared.errors.is(self.seen.errors) && self.shared.overruns.is(self.seen.overruns)
    }

    /// Whether the last stop bit of all that was to be sent has left.
    #[must_use]
    pub fn is_quiet(&self) -> bool {
        !self.shared.sending.load(Ordering::Relaxed)
    }

    /// Whether nothing is to be sent, or the transmitter has advanced since this was asked last.
    pub fn made_progress(&mut self) -> bool {
        self.is_quiet() || self.shared.progress.more_than(&mut self.seen.progress) > 0
    }

    /// Carries what came in to the engine; tells whether there was any.
    #[inline]
    pub fn drain_rx(&mut self, engine: &mut (impl AnyEngine + ?Sized), port: Port, now: Instant) -> bool {
        let came = !(self.is_idle() && self.is_well());
        if came {
            self.carry_all_in(engine, port, now);
        }
        came
    }

    fn carry_all_in(&mut self, engine: &mut (impl AnyEngine + ?Sized), port: Port, now: Instant) {
        for _ in 0..self.shared.errors.more_than(&mut self.seen.errors) {
            engine.receive_error(port);
        }
        if self.shared.overruns.more_than(&mut self.seen.overruns) > 0 {
            engine.overrun(port);
        }
        // what comes from here on waits for the next turn, so that a babbling line cannot keep the main loop here
        let put = self.ends.put.load(Ordering::Acquire);
        let ended = self.shared.ended.load(Ordering::Acquire);
        let ended_at = self.shared.ended_at.load(Ordering::Relaxed);
        if ended && put.wrapping_sub(ended_at) <= u32::MAX / 2 {
            let at = extend_timestamp(now, self.shared.ended_micros.load(Ordering::Relaxed));
            self.shared.ended.store(false, Ordering::Relaxed);
            self.carry_until(ended_at, engine, port, now);
            engine.transmit_complete(port, at);
        }
        self.carry_until(put, engine, port, now);
    }

    fn carry_until(&mut self, until: u32, engine: &mut (impl AnyEngine + ?Sized), port: Port, now: Instant) {
        let mut taken = self.ends.taken.load(Ordering::Relaxed);
        while taken != until {
            let mut chunk = Vec::<u8, CHUNK>::new();
            while taken != until {
                // the length is a power of two
                let index = taken as usize & self.bytes.len().wrapping_sub(1);
                let byte = self.bytes.get(index).map_or(0, |byte| byte.load(Ordering::Relaxed));
                if chunk.push(byte).is_err() {
                    break;
                }
                taken = taken.wrapping_add(1);
            }
            self.ends.taken.store(taken, Ordering::Release);
            let at = extend_timestamp(now, self.shared.last_byte.load(Ordering::Relaxed));
            engine.receive(port, &chunk, at);
        }
    }

    /// Carries what the engine has to send to the interrupt; tells whether there was any.
    pub fn fill_tx(&mut self, engine: &mut (impl AnyEngine + ?Sized), port: Port) -> bool {
        let output = engine.output(port);
        if output.is_empty() {
            return false;
        }
        let taken = self.shared.outgoing.put_all(output);
        engine.advance(port, taken);
        if taken > 0 {
            self.shared.sending.store(true, Ordering::Release);
        }
        taken > 0
    }
}

/// The time whose low half is `micros`: not after `now`, and less than 36 minutes before.
#[must_use]
pub fn extend_timestamp(now: Instant, micros: u32) -> Instant {
    let [_, _, _, _, low @ ..] = now.as_micros().to_be_bytes();
    let age = u32::from_be_bytes(low).wrapping_sub(micros);
    // a byte that ended since `now` was read would look very old
    let age = if age > u32::MAX / 2 { 0 } else { age };
    Instant::from_micros(now.as_micros().saturating_sub(age.into()))
}

#[cfg(test)]
mod tests;
