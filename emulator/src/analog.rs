//! What carries analog values: the first converter (RM0090, chapter 13), the two outputs of the DAC (chapter 14) and
//! timer 3 as a PWM (chapter 18).
//!
//! A conversion that is started by software is complete at once, unless the converter has been made to fail. Not
//! modelled: everything that triggers conversions otherwise, scans, the watchdog, DMA, the DAC's generators; of timer 3
//! anything that counts.

/// Bytes that the registers of the three converters occupy, with those that they share.
pub const ADC_SIZE: u32 = 0x400;
/// Bytes that the registers of the DAC occupy.
pub const DAC_SIZE: u32 = 0x400;
/// Bytes that the registers of a timer occupy.
pub const TIMER_SIZE: u32 = 0x400;

/// Channels of the converter.
const CHANNELS: usize = 19;

mod adc {
    pub(super) const SR: u32 = 0x00;
    pub(super) const CR2: u32 = 0x08;
    pub(super) const SQR1: u32 = 0x2c;
    pub(super) const SQR3: u32 = 0x34;
    pub(super) const DR: u32 = 0x4c;
    pub(super) const CCR: u32 = 0x304;
    pub(super) const END: u32 = 0x50;

    pub(super) const EOC: u32 = 1 << 1;
    pub(super) const STRT: u32 = 1 << 4;
    pub(super) const ADON: u32 = 1;
    pub(super) const SWSTART: u32 = 1 << 30;
}

/// The first converter.
#[derive(Debug, Clone)]
pub struct Adc {
    registers: [u32; (adc::END / 4) as usize],
    common: u32,
    inputs: [u16; CHANNELS],
    fails: bool,
}

impl Default for Adc {
    fn default() -> Self {
        Self { registers: Default::default(), common: 0, inputs: [0; CHANNELS], fails: false }
    }
}

impl Adc {
    /// A converter with nothing on its inputs.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A reset; what is on the inputs stays.
    pub fn reset(&mut self) {
        self.registers.fill(0);
        self.common = 0;
    }

    /// Puts a value of 12 bits on a channel; whether there is such a channel.
    pub fn connect(&mut self, channel: usize, value: u16) -> bool {
        let Some(input) = self.inputs.get_mut(channel).filter(|_| value < 1 << 12) else { return false };
        *input = value;
        true
    }

    /// Has conversions end, or never end.
    pub fn set_working(&mut self, works: bool) {
        self.fails = !works;
    }

    /// Reads a register; the data register clears the flag of its conversion.
    pub fn read(&mut self, offset: u32) -> u32 {
        match offset & !3 {
            adc::CCR => self.common,
            adc::DR => {
                *self.register(adc::SR) &= !adc::EOC;
                *self.register(adc::DR)
            }
            offset if offset < adc::END => *self.register(offset),
            _ => 0,
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) {
        match offset & !3 {
            adc::CCR => self.common = value,
            // a 0 clears a flag, a 1 leaves it
            adc::SR => *self.register(adc::SR) &= value,
            adc::DR => {}
            adc::CR2 => {
                *self.register(adc::CR2) = value & !adc::SWSTART;
                if value & adc::ADON != 0 && value & adc::SWSTART != 0 {
                    self.convert();
                }
            }
            offset if offset < adc::END => *self.register(offset) = value,
            _ => {}
        }
    }

    fn convert(&mut self) {
        *self.register(adc::SR) |= adc::STRT;
        let is_single = *self.register(adc::SQR1) >> 20 & 0xf == 0;
        if self.fails || !is_single {
            return;
        }
        let channel = *self.register(adc::SQR3) & 0x1f;
        let value = self.inputs.get(channel as usize).copied().unwrap_or(0);
        *self.register(adc::DR) = value.into();
        *self.register(adc::SR) |= adc::EOC;
    }

    const fn register(&mut self, offset: u32) -> &mut u32 {
        &mut self.registers[(offset / 4) as usize]
    }
}

mod dac {
    pub(super) const DHR12R1: u32 = 0x08;
    pub(super) const DHR12R2: u32 = 0x14;
    pub(super) const DHR12RD: u32 = 0x20;
    pub(super) const DOR1: u32 = 0x2c;
    pub(super) const DOR2: u32 = 0x30;
}

/// The DAC, written right-aligned in 12 bits and without a trigger.
#[derive(Debug, Clone, Default)]
pub struct Dac {
    control: u32,
    values: [u32; 2],
}

impl Dac {
    /// Reads a register.
    #[must_use]
    pub fn read(&self, offset: u32) -> u32 {
        let [first, second] = self.values;
        match offset & !3 {
            0 => self.control,
            dac::DHR12R1 | dac::DOR1 => first,
            dac::DHR12R2 | dac::DOR2 => second,
            dac::DHR12RD => second << 16 | first,
            _ => 0,
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) {
        let [first, second] = &mut self.values;
        match offset & !3 {
            0 => self.control = value,
            dac::DHR12R1 => *first = value & 0xfff,
            dac::DHR12R2 => *second = value & 0xfff,
            dac::DHR12RD => (*first, *second) = (value & 0xfff, value >> 16 & 0xfff),
            _ => {}
        }
    }

    /// What an output (1 or 2) puts out of 4095; nothing while it is off.
    #[must_use]
    pub fn output(&self, number: usize) -> Option<u32> {
        let index = number.checked_sub(1)?;
        let value = self.values.get(index).copied()?;
        (self.control >> (16 * index) & 1 == 1).then_some(value)
    }
}

mod timer {
    pub(super) const CR1: u32 = 0x00;
    pub(super) const CCER: u32 = 0x20;
    pub(super) const ARR: u32 = 0x2c;
    pub(super) const CCR1: u32 = 0x34;
    pub(super) const END: u32 = 0x54;
}

/// A timer as a PWM: its registers, and what they say.
#[derive(Debug, Clone)]
pub struct Pwm([u32; (timer::END / 4) as usize]);

impl Default for Pwm {
    fn default() -> Self {
        let mut registers = [0; (timer::END / 4) as usize];
        registers[(timer::ARR / 4) as usize] = 0xffff;
        Self(registers)
    }
}

impl Pwm {
    /// Reads a register.
    #[must_use]
    pub fn read(&self, offset: u32) -> u32 {
        self.0.get((offset / 4) as usize).copied().unwrap_or(0)
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) {
        if let Some(register) = self.0.get_mut((offset / 4) as usize) {
            *register = value;
        }
    }

    /// How long a channel (1 to 4) is high, and the period, in steps; nothing while it is off.
    #[must_use]
    pub fn output(&self, number: u32) -> Option<(u32, u32)> {
        let index = number.checked_sub(1).filter(|index| *index < 4)?;
        let is_on = self.read(timer::CR1) & 1 == 1 && self.read(timer::CCER) >> (4 * index) & 1 == 1;
        is_on.then(|| (self.read(timer::CCR1 + 4 * index), self.read(timer::ARR) + 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_conversion_brings_what_is_on_its_channel() {
        let mut converter = Adc::new();
        assert!(converter.connect(7, 1234) && !converter.connect(7, 4096) && !converter.connect(19, 0));
        converter.write(adc::SQR3, 7);
        converter.write(adc::CR2, adc::SWSTART);
        assert_eq!(converter.read(adc::SR) & adc::EOC, 0, "it is off");
        converter.write(adc::CR2, adc::ADON);
        converter.write(adc::CR2, adc::ADON | adc::SWSTART);
        assert_eq!(converter.read(adc::SR), adc::EOC | adc::STRT);
        assert_eq!(converter.read(adc::DR), 1234);
        assert_eq!(converter.read(adc::SR), adc::STRT);
        converter.set_working(false);
        converter.write(adc::CR2, adc::ADON | adc::SWSTART);
        assert_eq!(converter.read(adc::SR) & adc::EOC, 0, "it fails");
    }

    #[test]
    fn outputs_of_the_dac_are_on_or_off() {
        let mut converter = Dac::default();
        converter.write(dac::DHR12RD, 0x0123_0456);
        assert_eq!(converter.output(1), None);
        converter.write(0, 1 << 16 | 1);
        assert_eq!((converter.output(1), converter.output(2)), (Some(0x456), Some(0x123)));
        assert_eq!((converter.output(0), converter.output(3)), (None, None));
    }

    #[test]
    fn a_pwm_tells_its_duty() {
        let mut pwm = Pwm::default();
        pwm.write(timer::ARR, 999);
        pwm.write(timer::CCR1 + 4, 250);
        pwm.write(timer::CCER, 1 << 4);
        assert_eq!(pwm.output(2), None, "it does not count");
        pwm.write(timer::CR1, 1);
        assert_eq!((pwm.output(1), pwm.output(2)), (None, Some((250, 1000))));
    }
}
