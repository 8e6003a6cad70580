//! The general server against libmodbus: a package of its own, since it links against a library of the system.

use anyhow::Result;
use clap::Args;

use crate::run;
use crate::setup;
use crate::workspace::Workspace;

/// A workspace of its own.
const MANIFEST: &str = "checks/agreement/Cargo.toml";

/// Requests in a test run: some seconds.
const BRIEF: u64 = 200_000;

/// How many requests, and where they start.
#[derive(Args)]
pub(crate) struct Extent {
    /// How many requests
    #[arg(long, default_value_t = 2_000_000)]
    requests: u64,
    /// Start somewhere else than always
    #[arg(long)]
    seed: Option<u64>,
}

/// A tenth of it.
pub(crate) fn briefly(workspace: &Workspace) -> Result<()> {
    agree(workspace, &Extent { requests: BRIEF, seed: None })
}

/// Sends the same requests to both; fails at the first difference that no rule explains.
pub(crate) fn agree(workspace: &Workspace, extent: &Extent) -> Result<()> {
    let libmodbus = setup::libmodbus(workspace)?;
    let mut command = workspace.cargo();
    libmodbus.tell(&mut command);
    command
        .args(["run", "--quiet", "--release", "--manifest-path", MANIFEST, "--target-dir"])
        .arg(workspace.target.join("agreement"))
        .args(["--", &extent.requests.to_string()]);
    if let Some(seed) = extent.seed {
        command.arg(seed.to_string());
    }
    run::shown(&mut command)
}

/// The linter over that package.
pub(crate) fn clippy(workspace: &Workspace) -> Result<()> {
    let mut command = workspace.cargo();
    command
        .args(["clippy", "--quiet", "--release", "--manifest-path", MANIFEST, "--target-dir"])
        .arg(workspace.target.join("agreement"));
    run::shown(command.args(["--", "-D", "warnings"]))
}
