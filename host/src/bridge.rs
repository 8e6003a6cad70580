//! The bridge's own unit, as a host sees it: who it is, its counters, its time limits.

use crate::client::{Client, Error};
use jointbus_mcu_bridge::registers::{self, command};
use std::io::{Read, Write};
use std::time::{Duration, Instant};

pub use jointbus_mcu_bridge::engine::Counters;

/// Unit address of the bridge itself.
pub const UNIT: u8 = 247;

/// Version of the register map that this module knows.
pub const MAP_VERSION: u16 = registers::MAP;

/// Numbers of the ports in the register map.
pub mod port {
    /// The host.
    pub const HOST: u16 = 0;
    /// The first RS485 bus.
    pub const RS485_A: u16 = 1;
    /// The second RS485 bus.
    pub const RS485_B: u16 = 2;
    /// The CAN bus.
    pub const CAN: u16 = 3;
}

/// Numbers of the routes that lead to buses in the default configuration.
pub const BUS_ROUTES: [u16; 3] = [0, 1, 3];

/// What the bridge tells about itself: input registers [`registers::MAP_VERSION`] to [`registers::HEALTH`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct About {
    /// Version of the register map.
    pub map_version: u16,
    /// Firmware version: major, minor, patch.
    pub version: [u16; 3],
    /// Microseconds since boot.
    pub uptime_us: u64,
    /// Why it started.
    pub reset_cause: u16,
    /// Health bits, 0 where all is well.
    pub health: u16,
}

/// Asks the bridge who it is.
///
/// # Errors
/// [`Error`]. So for every function here.
pub fn about<S: Read + Write>(client: &mut Client<S>) -> Result<About, Error> {
    match *client.modbus(UNIT).read_input_registers(registers::MAP_VERSION.address, 10)? {
        [map_version, major, minor, patch, a, b, c, d, reset_cause, health] => Ok(About {
            map_version,
            version: [major, minor, patch],
            uptime_us: [a, b, c, d].into_iter().fold(0, |value, word| value << 16 | u64::from(word)),
            reset_cause,
            health,
        }),
        _ => Err(Error::Answer),
    }
}

/// Asks until the bridge answers, for so long at most; a burst that was cut short needs silence first.
///
/// # Errors
/// [`Error::Timeout`] where it does not answer in that time.
pub fn wait<S: Read + Write>(client: &mut Client<S>, patience: Duration) -> Result<About, Error> {
    let deadline = Instant::now() + patience;
    loop {
        match about(client) {
            Err(Error::Timeout) if Instant::now() < deadline => {}
            result => return result,
        }
    }
}

/// Reads the counters of a port.
///
/// # Errors
/// [`Error`].
pub fn counters<S: Read + Write>(client: &mut Client<S>, port: u16) -> Result<Counters, Error> {
    let words = client.modbus(UNIT).read_input_registers(registers::RECEIVED.at(port.into()), 24)?;
    let mut values =
        words.as_chunks::<2>().0.iter().map(|[high, low]| u32::from(*high) << 16 | u32::from(*low));
    let mut next = || values.next().ok_or(Error::Answer);
    Ok(Counters {
        received: next()?,
        sent: next()?,
        checksum_errors: next()?,
        dropped_bursts: next()?,
        timeouts: next()?,
        retries: next()?,
        foreign_or_late: next()?,
        overruns: next()?,
        expired: next()?,
        refused: next()?,
        bus_off: next()?,
        transmit_errors: next()?,
    })
}

/// Time limits of the routes to the buses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Time that a device has to answer a read, in ms.
    pub read_ms: u16,
    /// Time that a device has to answer anything else, in ms.
    pub write_ms: u16,
    /// How often a read is sent again.
    pub retries: u16,
    /// Time after which a request is no longer sent, in ms.
    pub time_to_live_ms: u16,
    /// How long a late response is waited for, in ms; 0 stands for three times the timeout.
    pub late_response_window_ms: u16,
    /// Silence that ends a burst from the host, in 100 us.
    pub burst_silence_100us: u16,
}

impl Limits {
    /// Limits that a slow machine does not reach; only what is really absent runs into them.
    pub const GENEROUS: Self = Self {
        read_ms: 3000,
        write_ms: 3000,
        retries: 1,
        time_to_live_ms: 30_000,
        late_response_window_ms: 0,
        burst_silence_100us: 20_000,
    };

    /// Longest time from a request that is alone to the answer that no device answers.
    #[must_use]
    pub fn longest(&self) -> Duration {
        let reads = u64::from(self.read_ms) * (u64::from(self.retries) + 1);
        let attempts = reads.max(u64::from(self.write_ms));
        // an earlier timeout may hold a request back
        Duration::from_millis(u64::from(self.time_to_live_ms) + attempts)
    }
}

/// Sets the silence that ends a burst from the host. Until it is set, a machine that is busy otherwise may pause inside a
/// request for longer than the former silence; the bridge drops such a request, so it is sent again.
fn set_burst_silence<S: Read + Write>(client: &mut Client<S>, silence_100us: u16) -> Result<(), Error> {
    const ASK_AGAIN: Duration = Duration::from_secs(1);
    let patience = client.timeout();
    let deadline = Instant::now() + patience;
    client.set_timeout(patience.min(ASK_AGAIN));
    let result = loop {
        match client.modbus(UNIT).write_registers(registers::BURST_SILENCE.address, &[silence_100us]) {
            Err(Error::Timeout) if Instant::now() < deadline => {}
            result => break result,
        }
    };
    client.set_timeout(patience);
    result
}

/// Puts new limits into force, confirmed.
///
/// # Errors
/// [`Error`]; [`Error::Answer`] where they were not confirmed in time, however often it was tried.
pub fn set_limits<S: Read + Write>(client: &mut Client<S>, limits: &Limits) -> Result<(), Error> {
    const TRIES: usize = 5;
    set_burst_silence(client, limits.burst_silence_100us)?;
    let mut own = client.modbus(UNIT);
    let times = [
        limits.read_ms,
        limits.write_ms,
        limits.retries,
        limits.time_to_live_ms,
        limits.late_response_window_ms,
    ];
    for _ in 0..TRIES {
        for route in BUS_ROUTES {
            own.write_registers(registers::ROUTE_READ_TIMEOUT.at(route.into()), &times)?;
        }
        own.write_registers(registers::COMMAND.address, &[command::APPLY])?;
        own.write_registers(registers::COMMAND.address, &[command::CONFIRM])?;
        // what was confirmed too late is no longer staged
        let mut kept = true;
        for route in BUS_ROUTES {
            let found = own.read_holding_registers(registers::ROUTE_READ_TIMEOUT.at(route.into()), 5)?;
            kept &= found == times;
        }
        if kept {
            return Ok(());
        }
    }
    Err(Error::Answer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use jointbus_protocol::checksum::crc16;
    use std::io;

    /// A bridge that drops the first request and answers the others as writes of registers.
    #[derive(Default)]
    struct Deaf {
        requests: usize,
        answer: Vec<u8>,
    }

    impl Write for Deaf {
        fn write(&mut self, request: &[u8]) -> io::Result<usize> {
            self.requests += 1;
            if self.requests > 1 {
                let content = request.get(..6).unwrap_or_default();
                self.answer = [content, &crc16(content).to_le_bytes()].concat();
            }
            Ok(request.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Read for Deaf {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            if self.answer.is_empty() {
                std::thread::sleep(Duration::from_millis(10));
                return Err(io::ErrorKind::WouldBlock.into());
            }
            let length = self.answer.len().min(buffer.len());
            buffer[..length].copy_from_slice(&self.answer[..length]);
            self.answer.drain(..length);
            Ok(length)
        }
    }

    #[test]
    fn a_request_that_the_bridge_has_dropped_is_sent_again() {
        let patience = Duration::from_secs(60);
        let mut client = Client::new(Deaf::default(), patience);
        set_burst_silence(&mut client, 1000).unwrap();
        assert_eq!(client.timeout(), patience);
    }
}
