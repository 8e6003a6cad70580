//! The bridge itself: bytes, frames and the time go in; bytes, frames, actions and the next deadline come out. It reads
//! no clock and touches no port, and every call does bounded work.

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
