//! NDAM-9010 station with up to eight DI, DO, AI or AO modules (manual V1.03, 2019-03): Modbus on one serial line,
//! from the factory RTU at 19200 baud 8N1.

mod dispatcher;
pub mod register;
pub mod settings;
mod station;

pub use dispatcher::{CHANNELS_MAX, ChannelError, Layout, Module, RamModule, dispatch};
pub use settings::Settings;
pub use station::{Station, StationError};

/// Most modules of a station.
pub const MODULES_MAX: usize = 8;

/// Highest unit address; the manual's tables up to 3.27 name 0xFE, its section 2 ends at 247.
pub const UNIT_MAX: u8 = 247;

/// Silence that ends an RTU frame from the factory: the station's byte timeout, in milliseconds.
pub const BYTE_TIMEOUT_MS: u64 = 10;
