//! The fault console: text lines that break the machine's surroundings, each answered `ok` or `?`.
//!
//! | line | effect |
//! |---|---|
//! | `ack 0` `ack 1` | nobody, or the adapter, acknowledges the controller's frames |
//! | `bus 0` `bus 1` | the bus is stuck dominant, or works |
//! | `err N` | the next N frames of the controller meet a bit error |
//! | `lost N` | the next N frames of the controller lose arbitration |
//! | `crystal 0` `crystal 1` | the crystal is missing, or there |
//! | `cause por` `pin` `sft` `iwdg` `wwdg` | what the next resets were caused by (`sft` at the start) |

use crate::rcc::ResetCause;

/// One line.
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
    /// Whether the crystal is there.
    Crystal(bool),
    /// What further resets of the machine are caused by.
    Cause(ResetCause),
}

impl Control {
    /// The value of a line; nothing if it is none.
    #[must_use]
    pub fn parse(line: &str) -> Option<Self> {
        let mut words = line.split_ascii_whitespace();
        let (name, argument, end) = (words.next()?, words.next()?, words.next());
        if end.is_some() {
            return None;
        }
        Some(match name {
            "ack" => Self::Acknowledge(switch(argument)?),
            "bus" => Self::Bus(switch(argument)?),
            "err" => Self::BitErrors(argument.parse().ok()?),
            "lost" => Self::ArbitrationLosses(argument.parse().ok()?),
            "crystal" => Self::Crystal(switch(argument)?),
            "cause" => Self::Cause(cause(argument)?),
            _ => return None,
        })
    }
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
        assert_eq!(Control::parse("ack 0"), Some(Control::Acknowledge(false)));
        assert_eq!(Control::parse(" bus  1 "), Some(Control::Bus(true)));
        assert_eq!(Control::parse("err 32"), Some(Control::BitErrors(32)));
        assert_eq!(Control::parse("lost 1"), Some(Control::ArbitrationLosses(1)));
        assert_eq!(Control::parse("crystal 0"), Some(Control::Crystal(false)));
        assert_eq!(Control::parse("cause iwdg"), Some(Control::Cause(ResetCause::IndependentWatchdog)));
    }

    #[test]
    fn other_lines_are_not() {
        for line in ["", "ack", "ack 2", "ack 1 1", "err -1", "err 4294967296", "cause 1", "nonsense 1"] {
            assert_eq!(Control::parse(line), None, "{line}");
        }
    }
}
