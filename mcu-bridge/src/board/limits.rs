//! Limits that act at once.

use jointbus_protocol::time::Duration;

/// Limits that act at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Transactions in a row without an answer after which a device is in quarantine; 0 = never.
    pub quarantine_after: u8,
    /// Time between two probes of a device in quarantine, in ms, 1 and up.
    pub probe_period_ms: u16,
    /// No valid request for so many ms switches the local outputs off; 0 = never.
    pub host_silence_ms: u16,
    /// Silence that ends a burst from the host, in 100 us, 1 and up.
    pub burst_silence_100us: u16,
}

impl Default for Limits {
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl Limits {
    /// None, in zeros.
    pub(crate) const ZERO: Self =
        Self { quarantine_after: 0, probe_period_ms: 0, host_silence_ms: 0, burst_silence_100us: 0 };

    /// The limits of a board that says nothing else.
    pub const DEFAULT: Self =
        Self { quarantine_after: 3, probe_period_ms: 1000, host_silence_ms: 0, burst_silence_100us: 200 };

    /// Time between two probes of a device in quarantine.
    #[must_use]
    pub const fn probe_period(&self) -> Duration {
        Duration::from_millis(self.probe_period_ms as u64)
    }

    /// Silence that ends a burst from the host.
    #[must_use]
    pub const fn burst_silence(&self) -> Duration {
        Duration::from_micros((self.burst_silence_100us as u64).wrapping_mul(100))
    }
}
