//! A bridge, its host and its devices in virtual time, with exact wire timing and everything that can go wrong.
//!
//! A [`World`] is a discrete-event simulation around the engine that the firmware runs. Nothing in it reads a clock, and
//! everything random follows from one seed: a run is repeated bit by bit, in a small part of the time that it tells.
//!
//! | simulated | how |
//! |---|---|
//! | UART characters | start, data, parity and stop bits at the port's rate, one behind the other |
//! | the host's line | full duplex |
//! | boards | [`SimBoard`]: the reference board, a small and a large one; on an RS485 bus are NST sensors or a station with Modbus RTU or ASCII, as its routes say, and NST sensors on a CAN bus |
//! | RS485 buses | half duplex: two drivers at once destroy each other's bytes, a driver that is held too long destroys the answer, a byte without its driver is not heard; all devices hear each other; echo if the port is set so |
//! | CAN buses | frames at their stuffed length with intermission; arbitration by identifier, acknowledgement, error frames and retransmission, transmit errors up to error passive and bus-off, 128 times 11 recessive bits out of it |
//! | a CAN controller | three mailboxes in the order of the requests, abort, the acceptance filter |
//! | the firmware | the queues between interrupts and main loop (its own code), the main loop's order, its latency, its tick of 100 us |
//! | devices | those of [`devices`](jointbus::devices), with reply times from a distribution and with bad habits |
//! | faults | [`Fault`], each kind by name |
//!
//! Not simulated: single bits and noise margins (a random byte lacks its stop bit at random), receive FIFO of the
//! controller (its interrupt is never late), controllers that send equal identifiers at once, the flash store, the
//! watchdog.
//!
//! Not to be held against the bridge, and not simulated: a device that answers later than the hold-off (three times the
//! timeout), or that repeats a reply of its own accord *later*, when a request of the same form is under way. These
//! protocols number nothing; nobody could tell. A reply whose CRC is right by coincidence is counted as that: where bytes
//! were garbled, and no device ever said such a thing. One systematic case: a frame that lost its last byte but one and is
//! followed by a zero byte, for the CRC of a frame with the CRC's first byte behind it is the second byte and zero.
//!
//! [`Run`] puts a host into it that knows of every answer whether it belongs to its question, and sends faults; a
//! [`Trial`] injects one fault alone, and compares what it raises and costs with [`Fault::raises`] and
//! [`Fault::service`] (the page `FAULTS.md`). [`properties`] says what must hold. `cargo xtask soak` shows it over millions
//! of requests, `cargo xtask sim --seed N --board NAME` repeats one run, `--alone KIND` one fault, and `--pcap FILE` records a run for
//! Wireshark ([`Recorder`]).
//!
//! ```
//! use jointbus_host_tests::sim::{MILLIS, Notice, Settings, SimBoard, World};
//!
//! let board = SimBoard::STM32F405;
//! let mut queues = board.queues();
//! let mut world = World::new(Settings::new(board, 1), &mut queues);
//! // the six axes of the sensor behind unit 16
//! world.host_sends(&[16, 0x03, 0x02, 0x00, 0x12, 0xC4, 0x4A]);
//! let (end, mut reply) = (world.now().saturating_add(20 * MILLIS), Vec::new());
//! while let Some(notice) = world.next(end) {
//!     if let Notice::HostHears(byte) = notice {
//!         reply.push(byte);
//!     }
//! }
//! assert_eq!((reply.len(), &reply[..3]), (23, &[16, 0x03, 0x12][..]));
//! ```

mod agenda;
mod boards;
pub mod can_bits;
pub mod can_wire;
mod delay;
mod effects;
mod fault;
mod firmware;
mod framing;
pub mod line;
mod master;
mod moment;
mod plan;
pub mod properties;
mod question;
mod questions;
mod random;
mod recorder;
mod routes;
mod run;
mod settings;
mod station;
mod tally;
mod trial;
mod world;

pub use boards::{Large, SimBoard, Small};
pub use delay::Delay;
pub use effects::{At, Counter, Raise, Service, Times};
pub use fault::{Fault, Place};
pub use master::Master;
pub use moment::{MICROS, MILLIS, Moment, Nanos, SECONDS};
pub use plan::{Manner, Plan};
pub use question::{Fit, Question};
pub use questions::Questions;
pub use random::Random;
pub use recorder::Recorder;
pub use run::Run;
pub use settings::Settings;
pub use station::{
    CanStation, LAYOUT, MODULES, PATTERN, SCRATCH, SerialDevice, SerialStation, device_number, pattern,
};
pub use tally::Tally;
pub use trial::Trial;
pub use world::{Notice, World};
