//! NXI-6201 four-channel analog output card (manual V1.2, 2024-02): Modbus RTU frames over TCP or UDP port 7000, and
//! equally on a serial line. Function codes 03 and 10.

mod dispatcher;
pub mod register;
mod stored;

pub use dispatcher::{Card, Hardware, RamHardware};
pub use register::{Channel, External, OutputRange, Register, Settings};
pub use stored::STORED_LENGTH;

/// Output channels of a card.
pub const CHANNELS: usize = 4;

/// ID of a card from the factory (section 1).
pub const DEFAULT_ID: u8 = 31;

/// Highest ID (section 3, item 6).
pub const ID_MAX: u8 = 248;

/// ID of a broadcast, which gets no reply (section 3, item 6).
pub const BROADCAST: u8 = 255;

/// TCP and UDP port (section 1).
pub const PORT: u16 = 7000;
