//! The oldest Rust that the protocol crate promises to build with.

use std::fs;
use std::time::Duration;

use anyhow::{Context, Result};

use crate::run;
use crate::workspace::Workspace;

const PACKAGE: &str = "jointbus-protocol";

/// A toolchain of some hundred megabytes.
const TOOLCHAIN_LIMIT: Duration = Duration::from_secs(900);

/// Builds and tests with that very release; where it can't be had, the linter looks for anything younger instead.
pub(crate) fn msrv(workspace: &Workspace) -> Result<()> {
    let release = promised(workspace)?;
    if let Err(error) = toolchain(workspace, &release) {
        println!("Rust {release} can't be had ({error:#}): the linter checks what was stable then");
        let lint = ["clippy", "--package", PACKAGE, "--", "-D", "clippy::incompatible_msrv"];
        return run::shown(workspace.cargo().args(lint));
    }
    let mut command = workspace.command("rustup");
    for name in ["CARGO", "RUSTC", "RUSTDOC", "RUSTUP_TOOLCHAIN", "LD_LIBRARY_PATH"] {
        command.env_remove(name);
    }
    let folder = workspace.target.join("msrv");
    command.env("CARGO_TARGET_DIR", folder);
    run::shown(command.args(["run", &release, "cargo", "test", "--package", PACKAGE]))
}

/// What the package's manifest says, as rustup names it.
fn promised(workspace: &Workspace) -> Result<String> {
    let manifest = workspace.root.join("protocol/Cargo.toml");
    let text = fs::read_to_string(&manifest).with_context(|| format!("can't read {}", manifest.display()))?;
    let stated = text.lines().find_map(|line| line.strip_prefix("rust-version = \"")?.strip_suffix('"'));
    let release = stated.with_context(|| format!("{} states no rust-version", manifest.display()))?;
    Ok(if release.matches('.').count() == 1 { format!("{release}.0") } else { release.to_owned() })
}

/// Has rustup install the release where it is missing.
fn toolchain(workspace: &Workspace, release: &str) -> Result<()> {
    let installed = run::output(workspace.command("rustup").args(["toolchain", "list"]))?;
    if installed.lines().any(|line| line.starts_with(release)) {
        return Ok(());
    }
    println!("setup: installing Rust {release} with rustup");
    let mut command = workspace.command("rustup");
    run::quiet(command.args(["toolchain", "install", release, "--profile", "minimal"]), TOOLCHAIN_LIMIT)
}
