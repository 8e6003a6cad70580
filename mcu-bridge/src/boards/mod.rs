//! The boards that this package knows: one file each.

pub mod stm32f405;
