//! The protocol crate's unit tests, interpreted: miri sees undefined behaviour and overflow that a test run does not.

use anyhow::Result;

use crate::run;
use crate::setup::nightly;
use crate::workspace::Workspace;

/// Runs them.
pub(crate) fn miri(workspace: &Workspace) -> Result<()> {
    nightly::miri(workspace)?;
    let mut command = nightly::cargo(workspace, "miri");
    // proptest reads a file and the environment; a thousand cases would take an hour
    command.env("MIRIFLAGS", "-Zmiri-disable-isolation").env("PROPTEST_CASES", "4");
    run::shown(command.args(["test", "--package", "jointbus-protocol", "--lib"]))
}
