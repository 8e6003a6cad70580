use super::moment::{MICROS, Nanos};
use super::random::Random;

/// How long something takes: a distribution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delay {
    /// Always the same.
    Fixed(Nanos),
    /// Anything from the first to the second, all alike.
    Uniform(Nanos, Nanos),
    /// Mostly the first; so many times in a million anything up to three times the timeout.
    Moody(Nanos, u64),
}

impl Delay {
    /// A device that answers soon.
    pub const PROMPT: Self = Self::Uniform(100 * MICROS, 400 * MICROS);

    /// The next one, of an answer that is waited for so long.
    pub const fn draw(&self, timeout: Nanos, random: &mut Random) -> Nanos {
        match *self {
            Self::Fixed(delay) => delay,
            Self::Uniform(least, most) => random.between(least, most),
            Self::Moody(_, in_a_million) if random.chance(in_a_million) => random.below(3 * timeout),
            Self::Moody(usual, _) => usual,
        }
    }
}
