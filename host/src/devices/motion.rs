//! What simulated sensors measure: functions of the moment alone, so that whoever knows the moment knows the value.

use jointbus_protocol::ndam9010::CHANNELS_MAX;
use jointbus_protocol::nst::{AXES, Sample};
use jointbus_protocol::time::Instant;
use std::f64::consts::TAU;

/// Largest slow swing of each axis: mN for the forces, mN.m for the torques.
pub const AMPLITUDE: [f64; AXES] = [50_000.0, 40_000.0, 120_000.0, 3_000.0, 2_500.0, 1_500.0];

/// Frequency of the slow swing of each axis in Hz; all differ, so that no two axes can be mistaken for each other.
pub const FREQUENCY: [f64; AXES] = [0.20, 0.23, 0.11, 0.31, 0.37, 0.41];

/// The quick swing has so many times the slow one's frequency,
pub const QUICK: f64 = 17.0;

/// and this part of its amplitude.
pub const QUICK_PART: f64 = 0.05;

/// What a sensor measures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion(Kind);

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    /// Each axis is a slow sine and a quick, small one on top.
    Swing { phase: f64 },
    /// The axes spell the moment.
    Spelling,
}

/// Bits of a moment that one axis spells; all values stay positive in 24 bits.
const SPELT_BITS: u32 = 22;
const SPELT_MASK: u64 = (1 << SPELT_BITS) - 1;

impl Motion {
    /// A tool that swings, a motion of its own for each number.
    #[must_use]
    pub fn new(number: u8) -> Self {
        // the golden ratio spreads the phases of neighbours
        Self(Kind::Swing { phase: (f64::from(number) * 0.618_034).fract() })
    }

    /// Axes that spell the moment at which they are measured, for [`spelt_moment`] to read: no two samples are alike.
    #[must_use]
    pub const fn spelling() -> Self {
        Self(Kind::Spelling)
    }

    /// The six axes at a moment, in mN and mN.m.
    #[must_use]
    pub fn sample(&self, now: Instant) -> Sample {
        let Kind::Swing { phase } = self.0 else { return spell(now) };
        let mut axes = [0; AXES];
        for ((axis, amplitude), frequency) in axes.iter_mut().zip(AMPLITUDE).zip(FREQUENCY) {
            let turns = frequency * seconds(now) + phase;
            let swing = (TAU * turns).sin() + QUICK_PART * (TAU * QUICK * turns).sin();
            *axis = (amplitude * swing).round() as i32;
        }
        Sample(axes)
    }
}

/// A sample that spells a moment: its low bits, its high bits, and both again in four other ways.
fn spell(now: Instant) -> Sample {
    let (low, high) = (now.as_micros() & SPELT_MASK, now.as_micros() >> SPELT_BITS & SPELT_MASK);
    let mixed = [low, high, low ^ 0x15_5555, high ^ 0x2A_AAAA, low * 5 + high, high * 9 + low];
    Sample(mixed.map(|axis| (axis & SPELT_MASK) as i32))
}

/// The moment that a sample of [`Motion::spelling`] was measured at; `None` where its axes are of several moments, or
/// of none.
#[must_use]
pub fn spelt_moment(sample: &Sample) -> Option<Instant> {
    let [low, high, ..] = sample.0.map(i64::from);
    let moment = u64::try_from(low | high << SPELT_BITS).ok().map(Instant::from_micros)?;
    (spell(moment) == *sample).then_some(moment)
}

/// Analog inputs of a module that spell the moment: its low and its high 16 bits in turns, each channel in its own way.
#[must_use]
pub fn spelling_inputs(index: usize, now: Instant) -> [u16; CHANNELS_MAX as usize] {
    std::array::from_fn(|channel| {
        let part = now.as_micros() >> if channel % 2 == 0 { 0 } else { 16 };
        let mask = (channel * 0x1357 + index * 0x2B00) & 0xFFFF;
        (part & 0xFFFF ^ mask as u64) as u16
    })
}

/// The digital inputs of module `index`: a counter that steps four times a second, ahead by `index` steps.
#[must_use]
pub fn digital_inputs(index: usize, now: Instant) -> u16 {
    let steps = now.as_micros() / 250_000;
    (steps.wrapping_add(index as u64) & 0xFFFF) as u16
}

/// The analog inputs of module `index`: sines about the middle of 16 bits, each channel slower than the one before.
#[must_use]
pub fn analog_inputs(index: usize, now: Instant) -> [u16; CHANNELS_MAX as usize] {
    std::array::from_fn(|channel| {
        let turns = seconds(now) / (4.0 + channel as f64) + index as f64 / 8.0;
        (32_768.0 + 30_000.0 * (TAU * turns).sin()).round() as u16
    })
}

fn seconds(now: Instant) -> f64 {
    now.as_micros() as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_move_stay_in_bounds_and_repeat_for_the_same_moment() {
        let motion = Motion::new(3);
        let mut seen = [(i32::MAX, i32::MIN); AXES];
        for step in 0..1000 {
            let now = Instant::from_micros(step * 20_000);
            let sample = motion.sample(now);
            assert_eq!(sample, Motion::new(3).sample(now));
            for (axis, (low, high)) in sample.0.iter().zip(&mut seen) {
                (*low, *high) = ((*low).min(*axis), (*high).max(*axis));
            }
        }
        for ((low, high), amplitude) in seen.into_iter().zip(AMPLITUDE) {
            assert!(f64::from(low) < -0.9 * amplitude && f64::from(low) > -1.06 * amplitude);
            assert!(f64::from(high) > 0.9 * amplitude && f64::from(high) < 1.06 * amplitude);
        }
        assert_ne!(motion.sample(Instant::default()), Motion::new(4).sample(Instant::default()));
    }

    #[test]
    fn a_spelt_moment_is_read_and_a_torn_one_is_not() {
        let at = |micros| Motion::spelling().sample(Instant::from_micros(micros));
        for micros in [0, 1, 4_194_303, 4_194_304, 3_600_000_000, 0xFFF_FFFF_FFFF] {
            let sample = at(micros);
            assert_eq!(spelt_moment(&sample), Some(Instant::from_micros(micros)));
            let encoded = sample.encode(jointbus_protocol::nst::SignEncoding::TwosComplement);
            let decoded = Sample::decode(&encoded, jointbus_protocol::nst::SignEncoding::TwosComplement);
            assert_eq!(decoded, sample, "it fits 24 bits");
            for axis in 0..AXES {
                let mut torn = sample;
                torn.0[axis] = at(micros ^ 0x40_0040).0[axis];
                assert_eq!(spelt_moment(&torn), None, "axis {axis}");
            }
        }
    }

    #[test]
    fn the_inputs_of_a_module_count_and_swing() {
        assert_eq!(digital_inputs(0, Instant::from_micros(999_999)), 3);
        assert_eq!(digital_inputs(2, Instant::from_micros(1_000_000)), 6);
        assert_eq!(digital_inputs(0, Instant::from_micros(250_000 * 0x1_0001)), 1);
        assert_eq!(analog_inputs(0, Instant::default()), [32_768; 16]);
        assert_eq!(analog_inputs(0, Instant::from_micros(1_000_000))[0], 62_768);
    }
}
