//! The bridge itself: bytes, frames and the time go in; bytes, frames, actions and the next deadline come out. It reads
//! no clock and touches no port, and every call does bounded work.
//!
//! # The main loop
//!
//! One turn hands in what has come, with the time at which it ended; polls until no action is left; and hands out what
//! is to be sent. Then the processor may sleep until something comes, or until [`Engine::poll_at`]. Ports may be
//! served in any order, and late: times decide, not the order of the calls.
//!
//! ```
//! use jointbus_mcu_bridge::board::Port;
//! use jointbus_mcu_bridge::boards::stm32f405::{CAN, Engine, RS485_A, RS485_B};
//! use jointbus_mcu_bridge::engine::{Action, STORED_LENGTH};
//! use jointbus_protocol::can::Frame;
//! use jointbus_protocol::time::Instant;
//!
//! /// What a firmware has around the engine: drivers, a store, a clock.
//! trait Hardware {
//!     fn now(&self) -> Instant;
//!     /// Bytes that a UART received, and when the last of them ended.
//!     fn received(&mut self, port: Port, buffer: &mut [u8]) -> Option<(usize, Instant)>;
//!     /// When the last stop bit left, once after each transmission.
//!     fn transmitted(&mut self, port: Port) -> Option<Instant>;
//!     /// Takes bytes to send, and tells how many.
//!     fn send(&mut self, port: Port, bytes: &[u8]) -> usize;
//!     /// A frame that CAN received, and when it ended.
//!     fn received_frame(&mut self) -> Option<(Frame, Instant)>;
//!     /// When a frame was acknowledged, once for each.
//!     fn acknowledged(&mut self) -> Option<Instant>;
//!     fn has_room(&self) -> bool;
//!     fn send_frame(&mut self, frame: Frame);
//!     fn is_bus_off(&self) -> bool;
//!     /// Gives up the frames that are not sent; whether none is left.
//!     fn abort(&mut self) -> bool;
//!     fn restart_can(&mut self);
//!     fn configure(&mut self, port: Port, engine: &Engine);
//!     fn drive_outputs(&mut self, engine: &Engine);
//!     fn store(&mut self, settings: &[u8]) -> bool;
//!     fn reboot_when_sent(&mut self);
//! }
//!
//! fn turn(engine: &mut Engine, hardware: &mut impl Hardware, aborting: &mut bool) {
//!     let now = hardware.now();
//!     let mut buffer = [0; 64];
//!     for port in [Port::HOST, RS485_A, RS485_B] {
//!         if let Some(at) = hardware.transmitted(port) {
//!             engine.transmit_complete(port, at);
//!         }
//!         if let Some((length, at)) = hardware.received(port, &mut buffer) {
//!             engine.receive(port, &buffer[..length], at);
//!         }
//!     }
//!     while let Some(at) = hardware.acknowledged() {
//!         engine.frame_sent(CAN, at);
//!     }
//!     while let Some((frame, at)) = hardware.received_frame() {
//!         engine.receive_frame(CAN, &frame, at);
//!     }
//!     engine.set_bus_off(CAN, hardware.is_bus_off(), now);
//!
//!     while let Some(action) = engine.poll(now) {
//!         match action {
//!             Action::Outputs => hardware.drive_outputs(engine),
//!             Action::AbortCan(_) => *aborting = true,
//!             Action::RestartCan(_) => hardware.restart_can(),
//!             Action::Configure(port) => hardware.configure(port, engine),
//!             Action::Store => {
//!                 let mut settings = [0; STORED_LENGTH];
//!                 engine.encode_settings(&mut settings);
//!                 engine.saved(hardware.store(&settings));
//!             }
//!             Action::Reboot => hardware.reboot_when_sent(),
//!         }
//!     }
//!
//!     for port in [Port::HOST, RS485_A, RS485_B] {
//!         let taken = hardware.send(port, engine.output(port));
//!         engine.advance(port, taken);
//!     }
//!     if *aborting {
//!         if hardware.abort() {
//!             *aborting = false;
//!             engine.frames_aborted(CAN, now);
//!         }
//!     } else {
//!         while hardware.has_room()
//!             && let Some(frame) = engine.next_frame(CAN)
//!         {
//!             hardware.send_frame(frame);
//!         }
//!     }
//! }
//! ```

mod actions;
mod any;
mod bridge;
mod can_bus;
mod change;
mod context;
mod core;
mod counters;
mod dispatch;
mod framing;
mod host;
mod identity;
mod management;
mod pending_late;
mod polling;
mod quarantine;
mod queue;
mod request;
mod response_matcher;
pub mod router;
mod serial_bus;
mod settings;
mod slab;
mod transaction;

pub use actions::Action;
pub use any::AnyEngine;
pub use bridge::{Engine, Storage};
pub use counters::Counters;
pub use identity::{Health, Identity, ResetCause};
pub use management::CONFIRM_WITHIN;
pub use polling::{Slot, SlotState};
pub use settings::{STORED_LENGTH, Settings, SlotSettings};
