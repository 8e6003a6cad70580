//! The board's eight digital and four analog inputs.
//!
//! The converter is asked one channel after the other and never waited for: each tick the main loop looks whether it
//! is done. One that does not get done in time fails until a whole round has been converted again.

use crate::constants::{ADC_CHANNELS, ADC_LIMIT_US};
use crate::pins::Port;
use stm32f4xx_hal::pac::{ADC_COMMON, ADC1, RCC};
use stm32f4xx_hal::rcc::{Enable, Reset};

/// Values of the analog inputs.
type Analog = [u16; ADC_CHANNELS.len()];

/// Digital inputs on PC0 to PC5, PC8 and PC9, analog inputs on PA0, PA6, PA7 and PB0.
pub struct Inputs {
    converter: ADC1,
    /// Where in the round it is, and since when, in microseconds.
    index: usize,
    started: u32,
    round: Analog,
    known: Option<Analog>,
}

impl Inputs {
    /// Starts the converter.
    pub fn start(converter: ADC1, common: &ADC_COMMON, rcc: &mut RCC, now: u32) -> Self {
        /// 84 cycles of sampling for channels 0 to 9 (RM0090, 13.13.5).
        const SAMPLING: u32 = 0o4_444_444_444;
        /// 84 MHz divided by 4; more than 36 MHz are not allowed (data sheet, 6.3.21).
        const DIVIDE_BY_4: u32 = 1 << 16;
        ADC1::enable(rcc);
        ADC1::reset(rcc);
        // SAFETY: values of RM0090, 13.13
        unsafe {
            common.ccr().write(|w| w.bits(DIVIDE_BY_4));
            converter.smpr2().write(|w| w.bits(SAMPLING));
        }
        converter.cr2().write(|w| w.adon().set_bit());
        let mut inputs =
            Self { converter, index: 0, started: now, round: [0; ADC_CHANNELS.len()], known: None };
        inputs.convert(now);
        inputs
    }

    /// The digital inputs, DI0 in bit 0.
    pub fn digital(&self) -> u16 {
        let pins = Port::C.levels();
        pins & 0x3F | pins >> 2 & 0xC0
    }

    /// The analog inputs, where they can be measured: 0 for 0 V at the pin, 0xFFFF for the reference of 3.3 V. `now` is in
    /// microseconds.
    pub fn analog(&mut self, now: u32) -> Option<Analog> {
        if self.converter.sr().read().eoc().bit_is_set() {
            // 12 bits become 16 by repeating the highest, so that the whole range is used
            let value = self.converter.dr().read().bits() as u16;
            if let Some(place) = self.round.get_mut(self.index) {
                *place = value << 4 | value >> 8;
            }
            self.index += 1;
            if self.index >= ADC_CHANNELS.len() {
                self.index = 0;
                self.known = Some(self.round);
            }
            self.convert(now);
        } else if now.wrapping_sub(self.started) > ADC_LIMIT_US {
            self.index = 0;
            self.known = None;
            self.convert(now);
        }
        self.known
    }

    fn convert(&mut self, now: u32) {
        let channel = ADC_CHANNELS.get(self.index).copied().unwrap_or(0);
        // SAFETY: a channel of the converter, alone in its sequence
        self.converter.sqr3().write(|w| unsafe { w.bits(channel) });
        self.converter.cr2().modify(|_, w| w.swstart().set_bit());
        self.started = now;
    }
}
