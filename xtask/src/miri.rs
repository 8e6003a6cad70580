//! The protocol crate's unit tests, interpreted: miri sees undefined behaviour and overflow that a test run does not.

use std::process::Command;
use std::thread;
use std::time::Duration;

use anyhow::{Result, anyhow};

use crate::run;
use crate::setup::nightly;
use crate::workspace::Workspace;

/// About half of the work. Miri interprets with one core; two of it do with two.
const HALF: &str = "modbus::";

/// Only a hang reaches it.
const LIMIT: Duration = Duration::from_secs(3600);

/// Runs them, in two halves side by side.
pub(crate) fn miri(workspace: &Workspace) -> Result<()> {
    nightly::miri(workspace)?;
    // what is built is built once
    run::shown(tests(workspace).arg("--no-run"))?;
    thread::scope(|scope| {
        let other = scope.spawn(|| run::quiet(tests(workspace).args(["--", HALF]), LIMIT));
        let shown = run::shown(tests(workspace).args(["--", "--skip", HALF]));
        let quiet = other.join().unwrap_or_else(|_| Err(anyhow!("the other half has panicked")));
        println!("the half `{HALF}` has ended");
        shown.and(quiet)
    })
}

fn tests(workspace: &Workspace) -> Command {
    let mut command = nightly::cargo(workspace, "miri");
    // proptest reads a file and the environment; a thousand cases would take an hour
    command.env("MIRIFLAGS", "-Zmiri-disable-isolation").env("PROPTEST_CASES", "4");
    command.args(["test", "--package", "jointbus-protocol", "--lib"]);
    command
}
