//! Whether everything that has to go on goes on: what the watchdog is fed for.

use crate::board::{PORTS_MAX, Port};

/// A part of the firmware that can stand still by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Task {
    /// The tick's interrupt: time passes.
    Tick,
    /// The main loop has carried everything in, asked the engine, and carried everything out.
    Loop,
    /// The inputs have been read.
    Inputs,
    /// A serial port has nothing to send, or has sent something; a CAN controller has been looked after.
    Port(Port),
}

impl Task {
    const fn bit(self) -> u16 {
        let bit = match self {
            Self::Tick => 0,
            Self::Loop => 1,
            Self::Inputs => 2,
            Self::Port(port) => port.number().saturating_add(3) as u32,
        };
        1u16.wrapping_shl(bit)
    }
}

const _: () = assert!(PORTS_MAX + 3 <= u16::BITS as usize);

/// Which parts have advanced.
#[derive(Debug)]
pub struct Heartbeats {
    all: u16,
    advanced: u16,
}

impl Heartbeats {
    /// For these parts, none of which has advanced yet.
    #[must_use]
    pub fn new(tasks: impl IntoIterator<Item = Task>) -> Self {
        Self { all: tasks.into_iter().fold(0, |bits, task| bits | task.bit()), advanced: 0 }
    }

    /// A part has advanced.
    pub const fn set(&mut self, task: Task) {
        self.advanced |= task.bit();
    }

    /// Whether every part has advanced since this was last true.
    pub const fn take_all(&mut self) -> bool {
        let advanced = self.advanced & self.all == self.all;
        if advanced {
            self.advanced = 0;
        }
        advanced
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_when_every_part_has_advanced_since_the_last_time() {
        let tasks = [Task::Tick, Task::Loop, Task::Inputs, Task::Port(Port::HOST), Task::Port(Port::new(5))];
        for missing in tasks {
            let mut marks = Heartbeats::new(tasks);
            for _ in 0..2 {
                tasks.iter().filter(|part| **part != missing).for_each(|part| marks.set(*part));
                assert!(!marks.take_all(), "{missing:?} stands still");
            }
            marks.set(missing);
            assert!(marks.take_all());
            assert!(!marks.take_all(), "all have to advance again");
        }
    }
}
