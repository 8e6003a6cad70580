//! What must hold, whatever happens; each a function that runs for a while and tells what it counted.

mod answers;
mod dead;
mod faults;
mod polling;

pub use answers::{answers, hidden_commands};
pub use dead::dead_devices;
pub use faults::each_fault_alone;
pub use polling::{Traffic, polling_both, polling_is_on_time};

use std::borrow::Cow;
use std::fmt;
use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

/// Requests of one seed: few enough to repeat a failure in no time.
pub const REQUESTS: u64 = 1000;

/// What a property found.
#[derive(Debug, Clone, Default)]
pub struct Found {
    /// What was counted.
    pub counted: Vec<(Cow<'static, str>, u64)>,
    /// How often it was violated.
    pub violated: u64,
    /// The first few violations, with the command that repeats them.
    pub violations: Vec<String>,
}

impl Found {
    /// Words are kept of so many violations.
    const KEPT: usize = 10;

    fn violation(&mut self, what: String) {
        self.violated += 1;
        if self.violations.len() < Self::KEPT {
            self.violations.push(what);
        }
    }

    /// Counts something.
    fn count(&mut self, what: impl Into<Cow<'static, str>>, number: u64) {
        let what = what.into();
        match self.counted.iter_mut().find(|(name, _)| *name == what) {
            Some((_, sum)) => *sum += number,
            None => self.counted.push((what, number)),
        }
    }

    fn add(&mut self, other: Self) {
        other.counted.into_iter().for_each(|(what, number)| self.count(what, number));
        self.violated += other.violated;
        let room = Self::KEPT.saturating_sub(self.violations.len());
        self.violations.extend(other.violations.into_iter().take(room));
    }
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counted: Vec<_> = self.counted.iter().map(|(what, number)| format!("{number} {what}")).collect();
        f.write_str(&counted.join(", "))
    }
}

/// Runs each seed, as many at once as there are processors. What is found does not depend on that.
fn of_seeds<const N: usize>(seeds: Range<u64>, one: impl Fn(u64) -> [Found; N] + Sync) -> [Found; N] {
    let (next, all) = (AtomicU64::new(seeds.start), Mutex::new(Vec::new()));
    let work = || {
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= seeds.end {
                break;
            }
            let found = one(seed);
            all.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).push((seed, found));
        }
    };
    thread::scope(|scope| {
        for _ in 0..thread::available_parallelism().map_or(1, Into::into) {
            scope.spawn(work);
        }
    });
    let mut all = all.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner());
    all.sort_by_key(|(seed, _)| *seed);
    let mut sum = [const { Found { counted: Vec::new(), violated: 0, violations: Vec::new() } }; N];
    for (_, found) in all {
        sum.iter_mut().zip(found).for_each(|(sum, found)| sum.add(found));
    }
    sum
}
