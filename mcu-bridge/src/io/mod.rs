//! Between the ports of a board and the [engine](crate::engine): what interrupts put down, the main loop carries on.

pub mod serial;
pub mod store;
pub mod watchdog;
