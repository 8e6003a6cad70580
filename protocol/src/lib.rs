//! Jointbus protocol stack.
#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::unreachable,
        clippy::arithmetic_side_effects
    )
)]

#[cfg(test)]
extern crate std;

pub mod can;
pub mod checksum;
mod codes;
pub mod deframe;
pub mod modbus;
pub mod ndam9010;
pub mod nst;
pub mod nxi6201;
pub mod slcan;
pub mod time;
pub mod wire;
