//! Who gets which answer, and what reaches the devices.

use super::{Found, REQUESTS, of_seeds};
use crate::sim::plan::Plan;
use crate::sim::tally::Tally;
use std::ops::Range;

/// Under all faults and reply times: no answer reaches the host that is not to its question; every request is answered
/// or counted; nothing is sent after its time to live; no write or command is carried out twice, or without a request.
#[must_use]
pub fn answers(seeds: Range<u64>) -> Found {
    let [found] = of_seeds(seeds, |seed| [of(seed, &Plan::of_seed(seed, REQUESTS, None).run(), "")]);
    found
}

/// The same where most bursts of the host are broken frames with a valid command in their data: none is carried out, and
/// none answered.
#[must_use]
pub fn hidden_commands(seeds: Range<u64>) -> Found {
    let [found] = of_seeds(seeds, |seed| [of(seed, &Plan::hiding(seed, REQUESTS).run(), " --hiding")]);
    found
}

fn of(seed: u64, tally: &Tally, how: &str) -> Found {
    let mut found = Found::default();
    if tally.violated > 0 {
        let first = tally.violations.first().cloned().unwrap_or_default();
        found.violation(format!("cargo xtask sim --seed {seed}{how}: {first}"));
        found.violated = tally.violated;
    }
    found.count("requests", tally.asked);
    found.count("answered", tally.answered);
    found.count("refused", tally.refused);
    found.count("silent", tally.silent);
    found.count("copies of broadcasts sent", tally.copies[1]);
    found.count("frames on RS485", tally.sent[0]);
    found.count("frames on CAN", tally.sent[1]);
    found.count("writes and commands done", tally.executed);
    found.count("broken bursts with a command inside", tally.hidden);
    found.count("replies right by coincidence of the CRC", tally.coincidences);
    found
}
