use super::moment::{MICROS, MILLIS, Nanos};
use super::random::Random;

/// How long something takes: a distribution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delay {
    /// Always the same.
    Fixed(Nanos),
    /// Anything from the first to the second, all alike.
    Uniform(Nanos, Nanos),
    /// Mostly the first; so many times in a million anything from there to the second.
    Tailed(Nanos, Nanos, u64),
}

impl Delay {
    /// A device that answers soon.
    pub const PROMPT: Self = Self::Uniform(100 * MICROS, 400 * MICROS);

    /// A device that answers soon, but once in fifty times far too late for a timeout of 50 ms.
    pub const MOODY: Self = Self::Tailed(200 * MICROS, 150 * MILLIS, 20_000);

    /// The next one.
    pub const fn draw(&self, random: &mut Random) -> Nanos {
        match *self {
            Self::Fixed(delay) => delay,
            Self::Uniform(least, most) => random.between(least, most),
            Self::Tailed(usual, most, in_a_million) if random.chance(in_a_million) => {
                random.between(usual, most)
            }
            Self::Tailed(usual, ..) => usual,
        }
    }
}
