//! The Jointbus bridge.
//!
//! [`engine`] forwards between a host and the buses of a robot joint: deaf and clockless, so that it builds and is
//! tested anywhere. [`io`] puts it behind the ports of a board. The firmware for the STM32F405 is this package's
//! binary.
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

pub mod board;
pub mod boards;
pub mod engine;
pub mod io;
pub mod registers;
