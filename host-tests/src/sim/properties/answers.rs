//! Who gets which answer, and what reaches the devices.

use super::{Found, REQUESTS, of_seeds};
use crate::sim::boards::SimBoard;
use crate::sim::plan::Plan;
use std::ops::Range;

/// Under all faults and reply times: no answer reaches the host that is not to its question; every request is answered
/// or counted; nothing is sent after its time to live; no write or command is carried out twice, or without a request.
/// The board varies with the seed.
#[must_use]
pub fn answers(board: impl Fn(u64) -> SimBoard + Sync, seeds: Range<u64>) -> Found {
    let [found] = of_seeds(seeds, |seed| [of(Plan::of_seed(board(seed), seed, REQUESTS, None), "")]);
    found
}

/// The same where most bursts of the host are broken frames with a valid command in their data: none is carried out, and
/// none answered.
#[must_use]
pub fn hidden_commands(board: impl Fn(u64) -> SimBoard + Sync, seeds: Range<u64>) -> Found {
    let [found] = of_seeds(seeds, |seed| [of(Plan::hiding(board(seed), seed, REQUESTS), " --hiding")]);
    found
}

fn of(plan: Plan, how: &str) -> Found {
    let (board, seed) = (plan.settings.board.name(), plan.settings.seed);
    let tally = plan.run();
    let mut found = Found::default();
    if tally.violated > 0 {
        let first = tally.violations.first().cloned().unwrap_or_default();
        found.violation(format!("cargo xtask sim --seed {seed} --board {board}{how}: {first}"));
        found.violated = tally.violated;
    }
    found.count("requests", tally.asked);
    found.count(format!("of them on {board}"), tally.asked);
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
