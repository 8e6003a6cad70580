//! A nightly toolchain, for the two tools that need one: the fuzzer and miri. Everything else is built by the stable
//! one.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail};

use super::toolbox::Toolbox;
use super::tools;
use crate::workspace::Workspace;
use crate::{progress, run};

/// A toolchain of some hundred megabytes.
const TOOLCHAIN_LIMIT: Duration = Duration::from_secs(900);
/// Two downloads of some megabytes.
const COMPONENTS_LIMIT: Duration = Duration::from_secs(300);
/// A build of a minute or two.
const CARGO_FUZZ_LIMIT: Duration = Duration::from_secs(1200);

/// What miri consists of.
const MIRI: [&str; 2] = ["miri", "rust-src"];

/// `cargo SUBCOMMAND` of the nightly toolchain, at work in the repository.
pub(crate) fn cargo(workspace: &Workspace, subcommand: &str) -> Command {
    let mut command = workspace.command("rustup");
    // What the running cargo has set for us would lead the other one astray.
    for name in ["CARGO", "RUSTC", "RUSTDOC", "RUSTUP_TOOLCHAIN", "LD_LIBRARY_PATH"] {
        command.env_remove(name);
    }
    command.args(["run", "nightly", "cargo", subcommand]);
    command
}

/// The fuzzer: nightly, `cargo fuzz`, and the C++ compiler that libFuzzer is built with.
pub(crate) fn fuzzer(workspace: &Workspace) -> Result<()> {
    toolchain(workspace)?;
    tools::ensure(&Toolbox::new(workspace), &[tools::CXX])?;
    if run::output(cargo(workspace, "fuzz").arg("--version")).is_ok() {
        return Ok(());
    }
    progress::during("installing cargo-fuzz with cargo", Duration::from_secs(90), || {
        run::quiet(workspace.cargo().args(["install", "cargo-fuzz", "--locked"]), CARGO_FUZZ_LIMIT)
    })
    .context("missing: cargo-fuzz\n  everywhere: cargo install cargo-fuzz --locked")
}

/// Miri and the library source that it interprets.
pub(crate) fn miri(workspace: &Workspace) -> Result<()> {
    toolchain(workspace)?;
    if run::output(cargo(workspace, "miri").arg("--version")).is_ok() && has_source(workspace) {
        return Ok(());
    }
    let mut command = workspace.command("rustup");
    command.args(["component", "add", "--toolchain", "nightly"]).args(MIRI);
    let what = format!("adding {} to nightly with rustup", MIRI.join(", "));
    progress::during(&what, Duration::from_secs(15), || run::quiet(&mut command, COMPONENTS_LIMIT)).with_context(|| {
        format!(
            "missing: {} of the nightly toolchain\n  with rustup: rustup component add --toolchain nightly {}",
            MIRI.join(", "),
            MIRI.join(" ")
        )
    })
}

/// The nightly toolchain itself.
fn toolchain(workspace: &Workspace) -> Result<()> {
    const ADVICE: &str = "missing: a nightly Rust toolchain\n  \
                          with rustup: rustup toolchain install nightly --profile minimal\n  \
                          rustup itself: https://rustup.rs";
    if run::find("rustup").is_none() {
        bail!(ADVICE);
    }
    if rustc(workspace).is_ok() {
        return Ok(());
    }
    let mut command = workspace.command("rustup");
    command.args(["toolchain", "install", "nightly", "--profile", "minimal"]);
    progress::during("installing the nightly toolchain with rustup", Duration::from_secs(40), || {
        run::quiet(&mut command, TOOLCHAIN_LIMIT)
    })
    .context(ADVICE)?;
    rustc(workspace).map(drop).context(ADVICE)
}

/// What nightly's compiler says about itself. Never installs anything: `rustup run` might.
fn rustc(workspace: &Workspace) -> Result<String> {
    let list = run::output(workspace.command("rustup").args(["toolchain", "list"]))?;
    if !list.lines().any(|line| line.starts_with("nightly-")) {
        bail!("rustup has no nightly toolchain");
    }
    run::output(workspace.command("rustup").args(["run", "nightly", "rustc", "--version", "--verbose"]))
}

/// The target that nightly builds for unless told otherwise.
pub(crate) fn host(workspace: &Workspace) -> Result<String> {
    let about = rustc(workspace)?;
    let host = about.lines().find_map(|line| line.strip_prefix("host: "));
    Ok(host.context("the compiler does not tell its host")?.to_owned())
}

/// Whether the library source is there.
fn has_source(workspace: &Workspace) -> bool {
    let mut command = workspace.command("rustup");
    let installed = run::output(command.args(["component", "list", "--toolchain", "nightly", "--installed"]));
    installed.is_ok_and(|list| list.lines().any(|line| line.starts_with("rust-src")))
}
