//! NST six-axis force/torque DAQs (manual V1.4, 2020-06).
//!
//! One request or reply *body* (function code onward) travels in three forms: on RS232/RS485 with address and CRC
//! ([`serial`]), on USB, UDP and TCP with the address alone ([`stream`]), on CAN with neither ([`can`]).
//! There is no error reply: a device is silent on what it refuses.

pub mod can;
mod dispatcher;
mod error;
mod frame;
pub mod line;
pub mod register;
mod sample;
pub mod serial;
mod settings;
pub mod stream;

pub use dispatcher::{Daq, Hardware, RamHardware};
pub use error::{NoResponse, Refusal, SettingsError, StoreError};
pub use frame::{
    BodyError, COMMAND_LENGTH, FunctionCode, REPLY_DATA_MAX, RESPONSE_HEADER, Request, Response,
    WRITE_DATA_MAX,
};
pub use sample::{AXES, SAMPLE_LENGTH, Sample, SignEncoding};
pub use settings::{ActiveSettings, Channel, EthernetMode, Settings};

/// Address of a broadcast: writes and commands only, never answered (4.1.3).
pub const BROADCAST: u8 = 0xFF;

/// Lowest address of a device (4.1.3).
pub const ADDRESS_MIN: u8 = 0x01;

/// Highest address of a device (4.1.3). The manual counts 126 addresses; 0x01 to 0x7F are 127, and all are accepted.
pub const ADDRESS_MAX: u8 = 0x7F;
