//! Simulated devices, for people who test host software or a bridge without hardware.
//!
//! | | what it is | answers by |
//! |---|---|---|
//! | [`NstSerial`] | NST six-axis DAQs on an RS485 line | [`Daq`](jointbus_protocol::nst::Daq) |
//! | [`NstCan`] | NST six-axis DAQs on a CAN bus | [`Daq`](jointbus_protocol::nst::Daq) |
//! | [`NdamLine`] | an NDAM-9010 station on an RS485 line | [`Station`](jointbus_protocol::ndam9010::Station) |
//!
//! Each is deaf and clockless: bytes or frames and the present moment go in, answers come out. The same device
//! therefore runs in virtual time and, by [`attach`], behind a TCP port in wall time. What a sensor measures is a
//! documented function of that moment ([`motion`]), and each device keeps a [`Log`] of what it told, so that a reader
//! at the far end can be checked value by value. Devices can be unplugged and plugged in again at any moment.
//!
//! Not simulated: bit times, reply times (an answer comes at once), collisions; the simulation in virtual time of the
//! repository's `host-tests` puts these devices on lines and a bus that have them. Not simulated at all: EtherCAT and
//! Ethernet DAQs.

pub mod attach;
mod log;
pub mod loopback;
pub mod motion;
mod ndam;
mod nst_can;
mod nst_serial;
mod order;
mod sensor;

pub use log::Log;
pub use motion::Motion;
pub use ndam::{Inputs, NdamLine};
pub use nst_can::NstCan;
pub use nst_serial::NstSerial;
pub use order::Order;
pub use sensor::{Sensor, Wiring};

use jointbus_protocol::can::Frame;
use jointbus_protocol::time::{Duration, Instant};

/// Silence that ends a burst, and the longest pause inside a CAN transfer, where time is virtual.
pub const PROMPT: Duration = Duration::from_millis(10);

/// The same where devices run in wall time: a host that is short of it must not cut a frame in two.
pub const PATIENT: Duration = Duration::from_millis(2000);

/// All devices of a serial line.
pub trait SerialLine: Send {
    /// Takes bytes that ended at `now`; what the devices answer.
    fn receive(&mut self, bytes: &[u8], now: Instant) -> Vec<u8>;

    /// Tells the devices the time, so that they notice silence; what they answer.
    fn poll(&mut self, now: Instant) -> Vec<u8>;

    /// When [`Self::poll`] is due; `None` while nothing is pending.
    fn deadline(&self) -> Option<Instant>;
}

/// All devices of a CAN bus.
pub trait CanBus: Send {
    /// Takes a frame that ended at `now`; what the devices answer, in order.
    fn receive(&mut self, frame: &Frame, now: Instant) -> Vec<Frame>;
}
