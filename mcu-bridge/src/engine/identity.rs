//! What the firmware knows of itself and tells the host.

/// Why the bridge started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResetCause {
    /// Power came.
    PowerOn,
    /// The reset pin.
    Pin,
    /// The firmware itself: the reboot command.
    Software,
    /// The watchdog.
    Watchdog,
    /// A panic or a fault.
    Panic,
}

impl ResetCause {
    /// Its number in the register.
    #[must_use]
    pub const fn value(self) -> u16 {
        match self {
            Self::PowerOn => 1,
            Self::Pin => 2,
            Self::Software => 3,
            Self::Watchdog => 4,
            Self::Panic => 5,
        }
    }
}

/// What is not well with the bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Health {
    /// It runs from the internal oscillator.
    pub internal_oscillator: bool,
    /// A CAN controller does not answer.
    pub no_can: bool,
    /// The stored configuration could not be read.
    pub defaulted: bool,
}

/// What the firmware tells about itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Firmware version: major, minor, patch.
    pub version: [u16; 3],
    /// Why it started.
    pub reset_cause: ResetCause,
}
