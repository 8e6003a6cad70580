//! What the tests that need more than one room have in common.
//!
//! - [`sim`]: a bridge, its host and its devices in virtual time, with exact wire timing and everything that can go wrong.
//!
//! The programs `demo`, `emulate` and `sim` are started by the commands of `cargo xtask` with these names.

pub mod sim;
