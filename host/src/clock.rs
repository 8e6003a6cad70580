//! The one clock of devices, bridge and checks in a process, so that their time stamps can be compared.

use jointbus_protocol::time::Instant;

/// Counts microseconds since it was made; a copy counts from the same moment.
#[derive(Debug, Clone, Copy)]
pub struct Clock(std::time::Instant);

impl Default for Clock {
    fn default() -> Self {
        Self(std::time::Instant::now())
    }
}

impl Clock {
    /// The present moment.
    #[must_use]
    pub fn now(&self) -> Instant {
        Instant::from_micros(u64::try_from(self.0.elapsed().as_micros()).unwrap_or(u64::MAX))
    }
}
