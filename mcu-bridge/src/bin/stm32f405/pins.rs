//! What each pin of the board is for, in one table (RM0090, chapter 8; alternate functions: data sheet, table 9).

use stm32f4xx_hal::pac::{GPIOA, GPIOB, GPIOC, RCC, gpioa};
use stm32f4xx_hal::rcc::Enable;

/// A port; their registers lie alike.
#[derive(Clone, Copy)]
pub enum Port {
    A,
    B,
    C,
}

/// What a pin does.
#[derive(Clone, Copy)]
enum Mode {
    /// Input with a pull-up.
    Input,
    /// Push-pull output, low at first.
    Output,
    Alternate(u8),
    Analog,
}

/// The driver-enable pins of the RS485 ports.
pub const DRIVER_A: OutputPin = OutputPin { port: Port::A, number: 1 };
pub const DRIVER_B: OutputPin = OutputPin { port: Port::B, number: 12 };

const PINS: [(Port, u8, Mode); 34] = [
    // host: USART1
    (Port::A, 9, Mode::Alternate(7)),
    (Port::A, 10, Mode::Alternate(7)),
    // rs485-a: driver enable, USART2
    (Port::A, 1, Mode::Output),
    (Port::A, 2, Mode::Alternate(7)),
    (Port::A, 3, Mode::Alternate(7)),
    // rs485-b: driver enable, USART3
    (Port::B, 12, Mode::Output),
    (Port::B, 10, Mode::Alternate(7)),
    (Port::B, 11, Mode::Alternate(7)),
    // can: CAN1
    (Port::B, 8, Mode::Alternate(9)),
    (Port::B, 9, Mode::Alternate(9)),
    // analog outputs: DAC, then PWM of TIM3
    (Port::A, 4, Mode::Analog),
    (Port::A, 5, Mode::Analog),
    (Port::C, 6, Mode::Alternate(2)),
    (Port::C, 7, Mode::Alternate(2)),
    // digital inputs
    (Port::C, 0, Mode::Input),
    (Port::C, 1, Mode::Input),
    (Port::C, 2, Mode::Input),
    (Port::C, 3, Mode::Input),
    (Port::C, 4, Mode::Input),
    (Port::C, 5, Mode::Input),
    (Port::C, 8, Mode::Input),
    (Port::C, 9, Mode::Input),
    // digital outputs
    (Port::B, 5, Mode::Output),
    (Port::B, 6, Mode::Output),
    (Port::B, 7, Mode::Output),
    (Port::B, 13, Mode::Output),
    (Port::B, 14, Mode::Output),
    (Port::B, 15, Mode::Output),
    (Port::C, 10, Mode::Output),
    (Port::C, 11, Mode::Output),
    // analog inputs: ADC1
    (Port::A, 0, Mode::Analog),
    (Port::A, 6, Mode::Analog),
    (Port::A, 7, Mode::Analog),
    (Port::B, 0, Mode::Analog),
];

/// Gives every pin its mode.
pub fn start(rcc: &mut RCC) {
    GPIOA::enable(rcc);
    GPIOB::enable(rcc);
    GPIOC::enable(rcc);
    for (port, number, mode) in PINS {
        let (mode, pull, function) = match mode {
            Mode::Input => (0b00, 0b01, 0),
            Mode::Output => (0b01, 0b00, 0),
            Mode::Alternate(function) => (0b10, 0b00, u32::from(function)),
            Mode::Analog => (0b11, 0b00, 0),
        };
        let registers = port.registers();
        let (pair, nibble) = (2 * u32::from(number), 4 * u32::from(number % 8));
        let with = |bits: u32, mask: u32, shift: u32, value: u32| bits & !(mask << shift) | value << shift;
        // SAFETY: any content of these fields is a mode; the function comes before it, so that nothing else is driven
        unsafe {
            if number < 8 {
                registers.afrl().modify(|r, w| w.bits(with(r.bits(), 0xF, nibble, function)));
            } else {
                registers.afrh().modify(|r, w| w.bits(with(r.bits(), 0xF, nibble, function)));
            }
            registers.pupdr().modify(|r, w| w.bits(with(r.bits(), 0b11, pair, pull)));
            registers.moder().modify(|r, w| w.bits(with(r.bits(), 0b11, pair, mode)));
        }
    }
}

impl Port {
    /// The registers of the port. Only set-reset writes are made while anything else runs.
    fn registers(self) -> &'static gpioa::RegisterBlock {
        let base = match self {
            Self::A => GPIOA::ptr(),
            Self::B => GPIOB::ptr().cast(),
            Self::C => GPIOC::ptr().cast(),
        };
        // SAFETY: the peripherals exist as long as the chip runs; see above for who writes
        unsafe { &*base }
    }

    /// Sets and resets outputs of the port: the low half of `bits` sets, the high half resets.
    pub fn set_reset(self, bits: u32) {
        // SAFETY: each bit of this register stands for one pin and leaves the others alone
        self.registers().bsrr().write(|w| unsafe { w.bits(bits) });
    }

    /// The levels of the port's pins.
    pub fn levels(self) -> u16 {
        self.registers().idr().read().bits() as u16
    }
}

/// An output.
#[derive(Clone, Copy)]
pub struct OutputPin {
    port: Port,
    number: u8,
}

impl OutputPin {
    /// Drives it.
    pub fn set(self, high: bool) {
        self.port.set_reset(1 << if high { self.number } else { self.number + 16 });
    }
}
