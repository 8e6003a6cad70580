//! Timer 5 as a counter that runs free (RM0090, chapter 18): 32 bits, counted up from the clock of the timer through the
//! prescaler. QEMU's own would count with 1 GHz whatever the clock control says.

/// Bytes that the registers occupy.
pub const SIZE: u32 = 0x400;

mod offset {
    pub(super) const CR1: u32 = 0x00;
    pub(super) const EGR: u32 = 0x14;
    pub(super) const CNT: u32 = 0x24;
    pub(super) const PSC: u32 = 0x28;
    pub(super) const ARR: u32 = 0x2c;
}

/// CR1: it counts.
const CEN: u32 = 1;

/// EGR: start over, with the prescaler that was written last.
const UG: u32 = 1;

/// A timer that counts up to the end of its 32 bits and on from 0.
#[derive(Debug, Clone, Default)]
pub struct Counter {
    running: bool,
    /// What was written, and what is in force.
    prescaler: [u32; 2],
    /// What it was at `since`, in nanoseconds.
    value: u32,
    since: u64,
}

impl Counter {
    /// Reads a register at a moment in nanoseconds; `hz` is the clock of the timer.
    #[must_use]
    pub fn read(&self, offset: u32, now: u64, hz: u32) -> u32 {
        match offset & !3 {
            offset::CR1 => u32::from(self.running) * CEN,
            offset::CNT => self.count(now, hz),
            offset::PSC => self.prescaler[0],
            offset::ARR => u32::MAX,
            _ => 0,
        }
    }

    /// Writes a register; a shorter period than the whole is not modelled.
    pub fn write(&mut self, offset: u32, value: u32, now: u64, hz: u32) {
        match offset & !3 {
            offset::CR1 => {
                (self.value, self.since) = (self.count(now, hz), now);
                self.running = value & CEN != 0;
            }
            offset::EGR if value & UG != 0 => {
                (self.value, self.since) = (0, now);
                self.prescaler[1] = self.prescaler[0];
            }
            offset::CNT => (self.value, self.since) = (value, now),
            offset::PSC => self.prescaler[0] = value & 0xffff,
            _ => {}
        }
    }

    fn count(&self, now: u64, hz: u32) -> u32 {
        if !self.running {
            return self.value;
        }
        let clocks = u128::from(now.saturating_sub(self.since)) * u128::from(hz) / 1_000_000_000;
        let counted = clocks / u128::from(self.prescaler[1] + 1);
        // it wraps
        self.value.wrapping_add(counted as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HZ: u32 = 84_000_000;

    #[test]
    fn it_counts_what_its_prescaler_lets_through() {
        let mut counter = Counter::default();
        counter.write(offset::PSC, 83, 0, HZ);
        counter.write(offset::EGR, UG, 0, HZ);
        assert_eq!(counter.read(offset::CNT, 5_000_000, HZ), 0, "it is off");
        counter.write(offset::CR1, CEN, 1_000_000, HZ);
        assert_eq!(counter.read(offset::CNT, 3_000_999, HZ), 2000);
        counter.write(offset::CR1, 0, 4_000_000, HZ);
        assert_eq!(counter.read(offset::CNT, 9_000_000, HZ), 3000);
    }

    #[test]
    fn a_prescaler_counts_from_the_next_start_on_and_the_counter_wraps() {
        let mut counter = Counter::default();
        counter.write(offset::CR1, CEN, 0, HZ);
        counter.write(offset::PSC, 83, 0, HZ);
        assert_eq!(counter.read(offset::CNT, 1_000_000, HZ), 84_000);
        counter.write(offset::EGR, UG, 1_000_000, HZ);
        counter.write(offset::CNT, u32::MAX, 1_000_000, HZ);
        assert_eq!(counter.read(offset::CNT, 1_001_000, HZ), 0);
    }
}
