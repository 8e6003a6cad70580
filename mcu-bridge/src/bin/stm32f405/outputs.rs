//! The board's eight digital outputs and its four analog ones: two DAC channels and two PWM channels. The output stage
//! behind those makes volts or milliamperes of the steps; the middle of the range is 0, and that is where an output that
//! is off stays.

use crate::constants::{OUTPUT_OFF, OUTPUT_STEPS};
use crate::pins::Port;
use jointbus_protocol::nxi6201::{CHANNELS, Channel, Settings};
use stm32f4xx_hal::pac::{DAC, RCC, TIM3};
use stm32f4xx_hal::rcc::{Enable, Reset};

/// DAC channels on PA4 and PA5, PWM channels on PC6 and PC7.
pub struct Outputs {
    dac: DAC,
    timer: TIM3,
}

impl Outputs {
    /// Starts the outputs, all of them off.
    pub fn start(dac: DAC, timer: TIM3, rcc: &mut RCC) -> Self {
        DAC::enable(rcc);
        DAC::reset(rcc);
        TIM3::enable(rcc);
        TIM3::reset(rcc);
        // SAFETY: every value is within its register's field
        unsafe {
            timer.arr().write(|w| w.bits(OUTPUT_STEPS));
            // PWM mode 1 with preload on both channels (RM0090, 18.4.7)
            timer.ccmr1_output().write(|w| w.bits(0x6868));
            timer.ccer().write(|w| w.bits(0x0011));
        }
        let off = Settings::default().channels;
        let outputs = Self { dac, timer };
        outputs.apply(&off);
        outputs.dac.cr().modify(|_, w| w.en1().set_bit().en2().set_bit());
        outputs.timer.cr1().modify(|_, w| w.arpe().set_bit().cen().set_bit());
        outputs
    }

    /// Drives the outputs.
    pub fn apply(&self, channels: &[Channel; CHANNELS]) {
        let [a, b, c, d] = channels.map(|channel| steps(&channel));
        // SAFETY: steps are within 12 bits
        unsafe {
            // both DAC channels change together
            self.dac.dhr12rd().write(|w| w.bits(b << 16 | a));
            self.timer.ccr1().write(|w| w.bits(c));
            self.timer.ccr2().write(|w| w.bits(d));
        }
    }
}

/// Drives the digital outputs, DO0 in bit 0: PB5 to PB7, PB13 to PB15, PC10 and PC11.
pub fn drive_digital(values: u16) {
    let port_b = u32::from(values & 0b111) << 5 | u32::from(values >> 3 & 0b111) << 13;
    let port_c = u32::from(values >> 6 & 0b11) << 10;
    let (all_b, all_c) = (0b111 << 5 | 0b111 << 13, 0b11 << 10);
    Port::B.set_reset((all_b & !port_b) << 16 | port_b);
    Port::C.set_reset((all_c & !port_c) << 16 | port_c);
}

/// Steps of a channel's set value, or of the middle where it is off.
fn steps(channel: &Channel) -> u32 {
    if !channel.output {
        return OUTPUT_OFF;
    }
    let limit = channel.range.limit();
    let share = (channel.set_value + limit) / (2.0 * limit);
    // the cast saturates
    ((share * OUTPUT_STEPS as f32 + 0.5) as u32).min(OUTPUT_STEPS)
}
