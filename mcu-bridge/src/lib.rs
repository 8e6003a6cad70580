//! Jointbus bridge.
#![no_std]
