use jointbus_protocol::time::Instant;

/// A span of simulated time in nanoseconds.
pub type Nanos = u64;

/// Nanoseconds of a microsecond.
pub const MICROS: Nanos = 1000;

/// Nanoseconds of a millisecond.
pub const MILLIS: Nanos = 1_000_000;

/// Nanoseconds of a second.
pub const SECONDS: Nanos = 1_000_000_000;

/// A moment of the simulation. Wires need finer steps than the engine's microseconds: a bit of 921600 baud takes 1085 ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Moment(u64);

impl Moment {
    /// A moment so many nanoseconds after the start.
    #[must_use]
    pub const fn from_nanos(nanos: Nanos) -> Self {
        Self(nanos)
    }

    /// Nanoseconds since the start.
    #[must_use]
    pub const fn as_nanos(self) -> Nanos {
        self.0
    }

    /// This moment and so much more.
    #[must_use]
    pub const fn saturating_add(self, span: Nanos) -> Self {
        Self(self.0.saturating_add(span))
    }

    /// The time since an earlier moment; none where that is later.
    #[must_use]
    pub const fn saturating_duration_since(self, earlier: Self) -> Nanos {
        self.0.saturating_sub(earlier.0)
    }

    /// The same in the engine's time: the microsecond that has begun.
    #[must_use]
    pub const fn instant(self) -> Instant {
        Instant::from_micros(self.0 / MICROS)
    }

    /// The moment at which the engine's time begins to be `instant`.
    #[must_use]
    pub const fn of(instant: Instant) -> Self {
        Self(instant.as_micros().saturating_mul(MICROS))
    }

    /// This moment, or the next multiple of `step` after it.
    #[must_use]
    pub const fn rounded_up(self, step: Nanos) -> Self {
        Self(self.0.div_ceil(step).saturating_mul(step))
    }
}
