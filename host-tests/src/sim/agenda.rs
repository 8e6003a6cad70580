use super::moment::Moment;
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// What happens when: the earliest first, and of one moment what was entered first.
#[derive(Debug)]
pub(super) struct Agenda<T> {
    entries: BinaryHeap<Entry<T>>,
    entered: u64,
}

#[derive(Debug)]
struct Entry<T> {
    at: Moment,
    number: u64,
    what: T,
}

impl<T> Agenda<T> {
    pub(super) fn new() -> Self {
        Self { entries: BinaryHeap::with_capacity(64), entered: 0 }
    }

    pub(super) fn enter(&mut self, at: Moment, what: T) {
        self.entered += 1;
        self.entries.push(Entry { at, number: self.entered, what });
    }

    /// Takes out the next entry, unless it is later than `end`.
    pub(super) fn next(&mut self, end: Moment) -> Option<(Moment, T)> {
        if self.entries.peek()?.at > end {
            return None;
        }
        self.entries.pop().map(|entry| (entry.at, entry.what))
    }
}

impl<T> Ord for Entry<T> {
    fn cmp(&self, other: &Self) -> Ordering {
        // a heap gives the greatest first
        (other.at, other.number).cmp(&(self.at, self.number))
    }
}

impl<T> PartialOrd for Entry<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> PartialEq for Entry<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<T> Eq for Entry<T> {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_earliest_comes_first_and_equals_keep_their_order() {
        let mut agenda = Agenda::new();
        for (at, what) in [(5, 'c'), (3, 'a'), (5, 'd'), (4, 'b'), (9, 'e')] {
            agenda.enter(Moment::from_nanos(at), what);
        }
        let end = Moment::from_nanos(8);
        let order: String = std::iter::from_fn(|| agenda.next(end)).map(|(_, what)| what).collect();
        assert_eq!(order, "abcd");
        assert!(agenda.next(Moment::from_nanos(9)).is_some());
    }
}
