//! `cargo fmt` and `cargo clippy`, which a minimal Rust installation lacks.

use std::time::Duration;

use anyhow::{Context, Result, bail};

use super::advice::Advice;
use crate::run;
use crate::workspace::Workspace;

/// Two small downloads.
const RUSTUP_LIMIT: Duration = Duration::from_secs(120);

/// Subcommands of cargo, and what rustup calls them.
const COMPONENTS: [(&str, &str); 2] = [("fmt", "rustfmt"), ("clippy", "clippy")];

const ADVICE: Advice = Advice {
    what: "`cargo fmt` and `cargo clippy`",
    purpose: "formatting and linting (with rustup, on any system: rustup component add rustfmt clippy)",
    debian: "sudo apt-get install rustfmt-web rust-web-clippy, beside rustc-web",
    fedora: "sudo dnf install rustfmt clippy",
    arch: "sudo pacman -S rust",
    macos: "brew install rust",
};

/// Has rustup add what is missing.
pub(crate) fn ensure(workspace: &Workspace) -> Result<()> {
    let missing: Vec<&str> = COMPONENTS
        .into_iter()
        .filter(|(subcommand, _)| !works(workspace, subcommand))
        .map(|(_, component)| component)
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    if run::find("rustup").is_none() {
        bail!(ADVICE);
    }
    println!("setup: adding {} with rustup", missing.join(", "));
    let mut command = workspace.command("rustup");
    run::quiet(command.args(["component", "add"]).args(&missing), RUSTUP_LIMIT).context(ADVICE)
}

/// Whether cargo has the subcommand.
fn works(workspace: &Workspace, subcommand: &str) -> bool {
    run::output(workspace.cargo().args([subcommand, "--version"])).is_ok()
}
