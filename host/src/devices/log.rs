use jointbus_protocol::time::Instant;
use std::collections::VecDeque;

/// The newest things that a device told, each with its moment.
#[derive(Debug, Clone)]
pub struct Log<T> {
    entries: VecDeque<(Instant, T)>,
    total: u64,
}

impl<T> Default for Log<T> {
    fn default() -> Self {
        Self { entries: VecDeque::new(), total: 0 }
    }
}

impl<T> Log<T> {
    /// So many entries are kept.
    pub const KEPT: usize = 256;

    /// Adds the newest entry; the oldest may go.
    pub(crate) fn push(&mut self, at: Instant, entry: T) {
        if self.entries.len() >= Self::KEPT {
            self.entries.pop_front();
        }
        self.entries.push_back((at, entry));
        self.total = self.total.saturating_add(1);
    }

    /// Entries ever made, those that are gone included.
    #[must_use]
    pub const fn total(&self) -> u64 {
        self.total
    }

    /// The newest entry.
    #[must_use]
    pub fn newest(&self) -> Option<&(Instant, T)> {
        self.entries.back()
    }

    /// The entries made in a span of time, its ends included, the newest first.
    pub fn between(&self, first: Instant, last: Instant) -> impl Iterator<Item = &(Instant, T)> {
        self.entries.iter().rev().filter(move |(at, _)| (first..=last).contains(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_bounded_and_keeps_the_newest() {
        let mut log = Log::default();
        let last = Log::<u64>::KEPT as u64 + 9;
        for entry in 0..=last {
            log.push(Instant::from_micros(entry), entry);
        }
        let all: Vec<u64> = log
            .between(Instant::from_micros(0), Instant::from_micros(last))
            .map(|(_, entry)| *entry)
            .collect();
        assert_eq!(all, (10..=last).rev().collect::<Vec<_>>());
        assert_eq!((log.newest(), log.total()), (Some(&(Instant::from_micros(last), last)), last + 1));
        let few: Vec<_> = log.between(Instant::from_micros(20), Instant::from_micros(22)).collect();
        assert_eq!(few.len(), 3);
    }
}
