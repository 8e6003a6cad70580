//! Systems that have no emulator for the image: the rest is compiled for them, tests and programs too.

use std::time::Duration;

use anyhow::{Context, Result};

use crate::workspace::Workspace;
use crate::{progress, run};

/// Windows, and macOS on both of its processors.
const TARGETS: [&str; 3] = ["x86_64-pc-windows-gnu", "x86_64-apple-darwin", "aarch64-apple-darwin"];

/// Some standard libraries of some tens of megabytes.
const RUSTUP_LIMIT: Duration = Duration::from_secs(600);

/// Has rustup add the standard libraries.
pub(crate) fn prepare(workspace: &Workspace) -> Result<()> {
    let installed = run::output(workspace.command("rustup").args(["target", "list", "--installed"]));
    let missing = match &installed {
        Ok(list) => TARGETS.into_iter().filter(|target| !list.lines().any(|line| line == *target)).collect(),
        Err(_) => TARGETS.to_vec(),
    };
    if missing.is_empty() {
        return Ok(());
    }
    let mut command = workspace.command("rustup");
    command.args(["target", "add"]).args(&missing);
    let what = format!("adding the standard libraries of {} with rustup", missing.join(", "));
    progress::during(&what, Duration::from_secs(30), || run::quiet(&mut command, RUSTUP_LIMIT)).with_context(
        || {
            format!(
                "missing: standard libraries of other systems\n  with rustup: rustup target add {}",
                missing.join(" ")
            )
        },
    )
}

/// Compiles everything for each of them, without linking.
pub(crate) fn check(workspace: &Workspace) -> Result<()> {
    for target in TARGETS {
        run::shown(workspace.cargo().args(["check", "--workspace", "--all-targets", "--target", target]))?;
    }
    Ok(())
}
