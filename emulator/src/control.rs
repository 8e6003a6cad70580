//! The fault console: text lines that change the machine's surroundings, each answered `ok`, or ask what the machine
//! does, each answered `ok` and what was asked for. What is not understood is answered `?`.
//!
//! | line | effect |
//! |---|---|
//! | `ack 0` `ack 1` | nobody, or the adapter, acknowledges the controller's frames |
//! | `bus 0` `bus 1` | the bus is stuck dominant, or works |
//! | `err N` | the next N frames of the controller meet a bit error |
//! | `lost N` | the next N frames of the controller lose arbitration |
//! | `room 0` `room 1` | frames for the controller come whether or not it has room, or wait until it has (at the start) |
//! | `crystal 0` `crystal 1` | the crystal is missing, or there |
//! | `cause por` `pin` `sft` `iwdg` `wwdg` | what the next resets were caused by (`sft` at the start) |
//! | `pin PC0 1` `0` `z` | puts a level on a pin from outside, or leaves it open |
//! | `adc 7 4095` | puts a value of 12 bits on a channel of the converter |
//! | `adc on` `adc off` | the converter's conversions end, or never do |
//! | `flaw 2 parity` `framing` `noise` `overrun` | what is wrong with the next character that USART2 or 3 receives |
//! | `cut N` | the power goes in the middle of the Nth change of the flash from now on, and QEMU ends |
//! | `forget all` | forgets changes of pins and transmissions |
//!
//! | question | answer |
//! |---|---|
//! | `level PB5` | what the firmware drives the pin to: `0`, `1`, or `z` |
//! | `changes PA1` | `NS:LEVEL` for each change of the pin as an output |
//! | `sent 2` | `FROM-TO` in ns for each transmission of USART2 or 3 without a pause in it |
//! | `dac 1` | what the output puts out of 4095, or `off` |
//! | `pwm 1` | how many steps of how many timer 3's channel is high, or `off` |

use crate::gpio::{Level, Pin};
use crate::rcc::ResetCause;
use crate::usart::Flaw;

/// One line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line {
    /// Changes something.
    Control(Control),
    /// Asks something.
    Query(Query),
}

/// What can be asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Query {
    /// What the firmware drives a pin to.
    Level(Pin),
    /// The changes of a pin as an output.
    Changes(Pin),
    /// The transmissions of USART2 or USART3, by its index 0 or 1.
    Sent(usize),
    /// An output of the DAC, from 1.
    Dac(usize),
    /// A channel of timer 3, from 1.
    Pwm(u32),
}

/// What can be changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Whether the controller's frames are acknowledged.
    Acknowledge(bool),
    /// Whether the bus works, rather than being stuck dominant.
    Bus(bool),
    /// Frames of the controller to meet a bit error.
    BitErrors(u32),
    /// Frames of the controller to lose arbitration.
    ArbitrationLosses(u32),
    /// Whether frames for the controller wait until it has room.
    Room(bool),
    /// Whether the crystal is there.
    Crystal(bool),
    /// What further resets of the machine are caused by.
    Cause(ResetCause),
    /// What is on a pin from outside.
    Pin(Pin, Level),
    /// What is on a channel of the converter, from 0 to 18, in 12 bits.
    Analog(usize, u16),
    /// Whether conversions end.
    Converter(bool),
    /// What is wrong with the next character that USART2 or USART3 receives, by its index 0 or 1.
    Flaw(usize, Flaw),
    /// Which change of the flash from now on the power does not outlast, from 1.
    PowerCut(u32),
    /// Forget changes of pins and transmissions.
    Forget,
}

impl Line {
    /// The meaning of a line; nothing if it has none.
    #[must_use]
    pub fn parse(line: &str) -> Option<Self> {
        let mut words = line.split_ascii_whitespace();
        let (name, argument, value) = (words.next()?, words.next()?, words.next());
        if words.next().is_some() {
            return None;
        }
        match value {
            Some(value) => Control::parse_value(name, argument, value).map(Self::Control),
            None => Query::parse(name, argument)
                .map(Self::Query)
                .or_else(|| Control::parse(name, argument).map(Self::Control)),
        }
    }
}

impl Query {
    fn parse(name: &str, argument: &str) -> Option<Self> {
        Some(match name {
            "level" => Self::Level(Pin::parse(argument)?),
            "changes" => Self::Changes(Pin::parse(argument)?),
            "sent" => Self::Sent(serial(argument)?),
            "dac" => Self::Dac(argument.parse().ok().filter(|number| (1..=2).contains(number))?),
            "pwm" => Self::Pwm(argument.parse().ok().filter(|number| (1..=4).contains(number))?),
            _ => return None,
        })
    }
}

impl Control {
    fn parse_value(name: &str, argument: &str, value: &str) -> Option<Self> {
        Some(match name {
            "pin" => Self::Pin(Pin::parse(argument)?, Level::parse(value)?),
            "adc" => Self::Analog(
                argument.parse().ok().filter(|channel| *channel < 19)?,
                value.parse().ok().filter(|value| *value < 1 << 12)?,
            ),
            "flaw" => Self::Flaw(serial(argument)?, Flaw::parse(value)?),
            _ => return None,
        })
    }

    fn parse(name: &str, argument: &str) -> Option<Self> {
        Some(match name {
            "adc" => Self::Converter(match argument {
                "on" => true,
                "off" => false,
                _ => return None,
            }),
            "cut" => Self::PowerCut(argument.parse().ok().filter(|changes| *changes > 0)?),
            "forget" if argument == "all" => Self::Forget,
            "ack" => Self::Acknowledge(switch(argument)?),
            "bus" => Self::Bus(switch(argument)?),
            "err" => Self::BitErrors(argument.parse().ok()?),
            "lost" => Self::ArbitrationLosses(argument.parse().ok()?),
            "room" => Self::Room(switch(argument)?),
            "crystal" => Self::Crystal(switch(argument)?),
            "cause" => Self::Cause(cause(argument)?),
            _ => return None,
        })
    }
}

/// Index of a serial port by its number.
fn serial(number: &str) -> Option<usize> {
    ["2", "3"].iter().position(|known| *known == number)
}

fn switch(word: &str) -> Option<bool> {
    match word {
        "0" => Some(false),
        "1" => Some(true),
        _ => None,
    }
}

fn cause(word: &str) -> Option<ResetCause> {
    match word {
        "por" => Some(ResetCause::PowerOn),
        "pin" => Some(ResetCause::Pin),
        "sft" => Some(ResetCause::Software),
        "iwdg" => Some(ResetCause::IndependentWatchdog),
        "wwdg" => Some(ResetCause::WindowWatchdog),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_understood() {
        let pin = Pin::parse("PA1").unwrap();
        for (line, expected) in [
            ("ack 0", Control::Acknowledge(false)),
            (" bus  1 ", Control::Bus(true)),
            ("err 32", Control::BitErrors(32)),
            ("lost 1", Control::ArbitrationLosses(1)),
            ("room 0", Control::Room(false)),
            ("crystal 0", Control::Crystal(false)),
            ("cause iwdg", Control::Cause(ResetCause::IndependentWatchdog)),
            ("pin PA1 z", Control::Pin(pin, Level(None))),
            ("adc 7 4095", Control::Analog(7, 4095)),
            ("adc off", Control::Converter(false)),
            ("flaw 3 parity", Control::Flaw(1, Flaw::Parity)),
            ("cut 3", Control::PowerCut(3)),
            ("forget all", Control::Forget),
        ] {
            assert_eq!(Line::parse(line), Some(Line::Control(expected)), "{line}");
        }
        for (line, expected) in [
            ("level PA1", Query::Level(pin)),
            ("changes PA1", Query::Changes(pin)),
            ("sent 3", Query::Sent(1)),
            ("dac 2", Query::Dac(2)),
            ("pwm 1", Query::Pwm(1)),
        ] {
            assert_eq!(Line::parse(line), Some(Line::Query(expected)), "{line}");
        }
    }

    #[test]
    fn other_lines_are_not() {
        for line in [
            "",
            "ack",
            "ack 2",
            "ack 1 1",
            "err -1",
            "err 4294967296",
            "cause 1",
            "nonsense 1",
            "pin PA1",
            "pin PA1 2",
            "adc 19 0",
            "adc 0 4096",
            "sent 1",
            "dac 0",
            "cut 0",
            "flaw 1 parity",
            "flaw 2 ink",
            "pwm 5",
            "adc 0 0 0",
        ] {
            assert_eq!(Line::parse(line), None, "{line}");
        }
    }
}
