//! What is counted in a run.

use super::moment::Moment;

/// What was counted in a run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tally {
    /// Requests that the bridge had to accept.
    pub asked: u64,
    /// Answers that belong to one of them; a device's exception is one.
    pub answered: u64,
    /// Exceptions 06 and 0B, by which the bridge says that there is no answer.
    pub refused: u64,
    /// NST requests that ended with silence.
    pub silent: u64,
    /// Requests to units that no route serves.
    pub unknown: u64,
    /// Copies of broadcasts that buses had to send, and that they have sent.
    pub copies: [u64; 2],
    /// Broken bursts with a valid command somewhere inside.
    pub hidden: u64,
    /// Writes and commands that devices carried out.
    pub executed: u64,
    /// Frames of the bridge on RS485, and on CAN.
    pub sent: [u64; 2],
    /// Answers that fit nothing, on a bus where bytes were garbled at that time: the CRC was right by coincidence.
    pub coincidences: u64,
    /// What must not happen, the first few in words.
    pub violations: Vec<String>,
    /// How many there were.
    pub violated: u64,
}

impl Tally {
    /// Words are kept of so many.
    const KEPT: usize = 5;

    /// Counts what must not happen.
    pub fn violation(&mut self, now: Moment, what: impl FnOnce() -> String) {
        self.violated += 1;
        if self.violations.len() < Self::KEPT {
            self.violations.push(format!("{:.6} s: {}", now.as_nanos() as f64 / 1e9, what()));
        }
    }

    /// Adds another run's.
    pub fn add(&mut self, other: &Self) {
        self.asked += other.asked;
        self.answered += other.answered;
        self.refused += other.refused;
        self.silent += other.silent;
        self.unknown += other.unknown;
        self.copies[0] += other.copies[0];
        self.copies[1] += other.copies[1];
        self.hidden += other.hidden;
        self.executed += other.executed;
        self.sent[0] += other.sent[0];
        self.sent[1] += other.sent[1];
        self.coincidences += other.coincidences;
        self.violated += other.violated;
        let room = Self::KEPT.saturating_sub(self.violations.len());
        self.violations.extend(other.violations.iter().take(room).cloned());
    }
}
