//! Whether everything that has to go on goes on: what the watchdog is fed for.

/// A part of the firmware that can stand still by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Task {
    /// The tick's interrupt: time passes.
    Tick,
    /// The main loop has carried everything in, asked the engine, and carried everything out.
    Loop,
    /// The host's port has nothing to send, or has sent something.
    Host,
    /// The first RS485 port, likewise.
    Rs485A,
    /// The second RS485 port, likewise.
    Rs485B,
    /// The CAN controller has been looked after.
    Can,
    /// The inputs have been read.
    Inputs,
}

impl Task {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::Tick, Self::Loop, Self::Host, Self::Rs485A, Self::Rs485B, Self::Can, Self::Inputs];

    const fn bit(self) -> u8 {
        1 << self as u8
    }
}

/// A mark for every part.
#[derive(Debug, Default)]
pub struct Heartbeats(u8);

impl Heartbeats {
    /// No part has advanced yet.
    #[must_use]
    pub const fn new() -> Self {
        Self(0)
    }

    /// A part has advanced.
    pub const fn set(&mut self, part: Task) {
        self.0 |= part.bit();
    }

    /// Whether every part has advanced since this was last true.
    pub fn take_all(&mut self) -> bool {
        let all = Task::ALL.iter().fold(0, |bits, part| bits | part.bit());
        let advanced = self.0 == all;
        if advanced {
            self.0 = 0;
        }
        advanced
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_when_every_part_has_advanced_since_the_last_time() {
        for missing in Task::ALL {
            let mut marks = Heartbeats::new();
            for _ in 0..2 {
                Task::ALL.iter().filter(|part| **part != missing).for_each(|part| marks.set(*part));
                assert!(!marks.take_all(), "{missing:?} stands still");
            }
            marks.set(missing);
            assert!(marks.take_all());
            assert!(!marks.take_all(), "all have to advance again");
        }
    }
}
