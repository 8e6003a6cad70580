//! The pins of ports A to C (RM0090, chapter 8): what the firmware drives, and what the board puts on them.
//!
//! A pin that is no output shows what is put on it from outside, or what its resistor makes of it. Every change of an
//! output is kept with its time. Not modelled: locking, and that alternate functions drive pins; what timers and
//! converters put out is in [`crate::analog`].

use std::fmt;

/// Bytes that the registers of one port occupy.
pub const SIZE: u32 = 0x400;

/// Ports there are: A, B, C.
pub const PORTS: usize = 3;

/// Pins of a port.
const PINS: usize = 16;

/// Changes that are kept for each pin; older ones are forgotten.
const KEPT: usize = 4096;

/// Where each register stands.
mod offset {
    pub(super) const MODER: u32 = 0x00;
    pub(super) const PUPDR: u32 = 0x0c;
    pub(super) const IDR: u32 = 0x10;
    pub(super) const ODR: u32 = 0x14;
    pub(super) const BSRR: u32 = 0x18;
    /// Behind the last register.
    pub(super) const END: u32 = 0x28;
}

/// Mode, speed and resistors after a reset, where the debugger's pins are special.
const AFTER_RESET: [[(u32, u32); 3]; PORTS] = [
    [(0x00, 0xa800_0000), (0x08, 0x0c00_0000), (0x0c, 0x6400_0000)],
    [(0x00, 0x0000_0280), (0x08, 0x0000_00c0), (0x0c, 0x0000_0100)],
    [(0x00, 0), (0x08, 0), (0x0c, 0)],
];

/// One pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pin {
    port: usize,
    number: usize,
}

impl Pin {
    /// The pin of a name such as `PB12`.
    #[must_use]
    pub fn parse(name: &str) -> Option<Self> {
        let rest = name.strip_prefix('P')?;
        let port = ["A", "B", "C"].iter().position(|letter| rest.starts_with(letter))?;
        let number = rest.get(1..)?.parse().ok().filter(|number| *number < PINS)?;
        Some(Self { port, number })
    }
}

/// What a pin is driven to; nothing where it floats.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Level(pub Option<bool>);

impl Level {
    /// `0`, `1`, or `z` for one that floats.
    #[must_use]
    pub fn parse(word: &str) -> Option<Self> {
        match word {
            "0" => Some(Self(Some(false))),
            "1" => Some(Self(Some(true))),
            "z" => Some(Self(None)),
            _ => None,
        }
    }
}

impl fmt::Display for Level {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self.0 {
            Some(false) => "0",
            Some(true) => "1",
            None => "z",
        })
    }
}

/// All ports.
#[derive(Debug, Clone)]
pub struct Gpio {
    registers: [[u32; (offset::END / 4) as usize]; PORTS],
    outside: [[Option<bool>; PINS]; PORTS],
    /// Changes of each pin as an output: nanoseconds, and the level from then on.
    changes: [[Vec<(u64, Level)>; PINS]; PORTS],
}

impl Default for Gpio {
    fn default() -> Self {
        let mut gpio =
            Self { registers: Default::default(), outside: Default::default(), changes: Default::default() };
        gpio.reset(0);
        gpio
    }
}

impl Gpio {
    /// Pins after power-on, nothing connected to them.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A reset at a moment in nanoseconds; what is connected from outside stays.
    pub fn reset(&mut self, now: u64) {
        for (port, values) in AFTER_RESET.iter().enumerate() {
            self.change(port, now, |registers| {
                registers.fill(0);
                for (register, value) in values {
                    registers[(register / 4) as usize] = *value;
                }
            });
        }
    }

    /// Reads a register of a port.
    #[must_use]
    pub fn read(&self, port: usize, offset: u32) -> u32 {
        match offset & !3 {
            offset::IDR => {
                (0..PINS).map(|number| u32::from(self.shows(Pin { port, number })) << number).sum()
            }
            offset::BSRR => 0,
            offset if offset < offset::END => self.registers[port][(offset / 4) as usize],
            _ => 0,
        }
    }

    /// Writes a register of a port at a moment in nanoseconds.
    pub fn write(&mut self, port: usize, offset: u32, value: u32, now: u64) {
        self.change(port, now, |registers| match offset & !3 {
            offset::IDR => {}
            offset::BSRR => {
                let output = &mut registers[(offset::ODR / 4) as usize];
                // a bit that is set and reset at once is set
                *output = *output & !(value >> 16) | value & 0xffff;
            }
            offset::ODR => registers[(offset::ODR / 4) as usize] = value & 0xffff,
            offset if offset < offset::END => registers[(offset / 4) as usize] = value,
            _ => {}
        });
    }

    /// Puts a level on a pin from outside, or leaves it open.
    pub fn connect(&mut self, pin: Pin, level: Level) {
        self.outside[pin.port][pin.number] = level.0;
    }

    /// What the firmware drives a pin to.
    #[must_use]
    pub fn drives(&self, pin: Pin) -> Level {
        drives(&self.registers[pin.port], pin.number)
    }

    /// The changes of a pin as an output since they were forgotten.
    #[must_use]
    pub fn changes(&self, pin: Pin) -> &[(u64, Level)] {
        &self.changes[pin.port][pin.number]
    }

    /// Forgets all changes.
    pub fn forget(&mut self) {
        self.changes.iter_mut().flatten().for_each(Vec::clear);
    }

    fn change(&mut self, port: usize, now: u64, how: impl FnOnce(&mut [u32])) {
        let registers = &mut self.registers[port];
        let before: [Level; PINS] = std::array::from_fn(|number| drives(registers, number));
        how(registers);
        for (number, (before, changes)) in before.iter().zip(&mut self.changes[port]).enumerate() {
            let after = drives(registers, number);
            if after != *before {
                if changes.len() == KEPT {
                    changes.remove(0);
                }
                changes.push((now, after));
            }
        }
    }

    /// What the input register shows of a pin.
    fn shows(&self, pin: Pin) -> bool {
        const ANALOG: u32 = 0b11;
        const PULL_UP: u32 = 0b01;
        let registers = &self.registers[pin.port];
        if mode(registers, pin.number) == ANALOG {
            return false;
        }
        let pull = registers[(offset::PUPDR / 4) as usize] >> (2 * pin.number) & 0b11;
        let outside = self.outside[pin.port][pin.number];
        self.drives(pin).0.or(outside).unwrap_or(pull == PULL_UP)
    }
}

fn mode(registers: &[u32], number: usize) -> u32 {
    registers[(offset::MODER / 4) as usize] >> (2 * number) & 0b11
}

fn drives(registers: &[u32], number: usize) -> Level {
    const OUTPUT: u32 = 0b01;
    let set = registers[(offset::ODR / 4) as usize] >> number & 1 == 1;
    Level((mode(registers, number) == OUTPUT).then_some(set))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pin(name: &str) -> Pin {
        Pin::parse(name).unwrap()
    }

    #[test]
    fn outputs_are_driven_and_their_changes_kept() {
        let mut gpio = Gpio::new();
        assert_eq!(gpio.drives(pin("PB12")), Level(None));
        gpio.write(1, offset::MODER, 1 << 24, 10);
        gpio.write(1, offset::BSRR, 1 << 12, 20);
        gpio.write(1, offset::BSRR, 1 << 12, 25);
        gpio.write(1, offset::BSRR, 1 << 28, 30);
        let told: Vec<String> =
            gpio.changes(pin("PB12")).iter().map(|(at, level)| format!("{at}:{level}")).collect();
        assert_eq!(told, ["10:0", "20:1", "30:0"]);
        gpio.write(1, offset::ODR, 1 << 12, 40);
        assert_eq!(gpio.read(1, offset::IDR), 1 << 12 | 1 << 4, "and the pull-up of the debugger's pin");
        gpio.reset(50);
        assert_eq!(gpio.changes(pin("PB12")).last(), Some(&(50, Level(None))));
        gpio.forget();
        assert!(gpio.changes(pin("PB12")).is_empty());
    }

    #[test]
    fn inputs_show_what_is_put_on_them_or_their_resistor() {
        let mut gpio = Gpio::new();
        gpio.write(2, offset::PUPDR, 0b01, 0);
        assert_eq!(gpio.read(2, offset::IDR), 1);
        gpio.connect(pin("PC0"), Level(Some(false)));
        gpio.connect(pin("PC9"), Level(Some(true)));
        assert_eq!(gpio.read(2, offset::IDR), 1 << 9);
        gpio.connect(pin("PC0"), Level(None));
        assert_eq!(gpio.read(2, offset::IDR), 1 << 9 | 1);
        gpio.write(2, offset::MODER, 0b11 << 18, 0);
        assert_eq!(gpio.read(2, offset::IDR), 1, "an analog pin shows nothing");
    }

    #[test]
    fn names_are_those_of_the_data_sheet() {
        assert_eq!(Pin::parse("PC15"), Some(Pin { port: 2, number: 15 }));
        for name in ["PD0", "PA16", "A1", "P", "PA", "PA-1"] {
            assert_eq!(Pin::parse(name), None, "{name}");
        }
    }
}
