//! The benchmark: what is measured, shown beside what others have, and held to limits.
//!
//! Everything in `checks/bench/`, a workspace of its own. No figure depends on how fast this machine is: sizes, counted
//! instructions, virtual time.

mod bridge;
mod figures;
mod host;
mod limits;
pub(crate) mod m4;
mod plot;
mod report;

use std::env;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, Result, bail};
use clap::Args;

pub(crate) use self::figures::Figures;
use crate::workspace::Workspace;
use crate::{run, setup};

/// The workspace of the benchmark.
const MANIFEST: &str = "checks/bench/Cargo.toml";

/// The page with the tables.
const PAGE: &str = "BENCHMARKS.md";

/// What to do with the figures.
#[derive(Args)]
pub(crate) struct Manner {
    /// Measure what has a limit only, and fail where one is not held
    #[arg(long)]
    check: bool,
    /// Put the tables into BENCHMARKS.md
    #[arg(long, conflicts_with = "check")]
    write: bool,
    /// Show which lines of source the instructions of the bridge's image are from instead
    #[arg(long, conflicts_with_all = ["check", "write"])]
    profile: bool,
}

/// Measures.
pub(crate) fn bench(workspace: &Workspace, manner: &Manner) -> Result<()> {
    prepare(workspace)?;
    if manner.check {
        return check(workspace);
    }
    if manner.profile {
        return bridge::profile(workspace);
    }
    setup::libmodbus(workspace)?;
    let figures = measure(workspace, true)?;
    let tables = format!("{}\n{}", conditions(workspace)?, report::tables(&figures)?);
    let verdicts = limits::verdicts(&figures)?;
    println!("{tables}\n{}", limits::table(&verdicts));
    let folder = workspace.target.join("bench");
    let write = |name: &str, content: &str| -> Result<()> {
        let path = folder.join(name);
        fs::write(&path, content).with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}", path.display());
        Ok(())
    };
    for (name, plot) in report::plots(&figures)? {
        write(name, &plot)?;
    }
    write("report.md", &report::whole(&tables, &limits::table(&verdicts)))?;
    if manner.write {
        let path = workspace.root.join(PAGE);
        let page = fs::read_to_string(&path).with_context(|| format!("cannot read {PAGE}"))?;
        fs::write(&path, report::put(&page, &tables, &limits::table(&verdicts))?)?;
        println!("{}", path.display());
    }
    Ok(())
}

/// Sets up what the check needs.
pub(crate) fn prepare(workspace: &Workspace) -> Result<()> {
    setup::toolchain(workspace)?;
    setup::emulator(workspace)?;
    setup::valgrind(workspace)
}

/// Measures what has a limit, and fails where one does not hold.
pub(crate) fn check(workspace: &Workspace) -> Result<()> {
    let verdicts = limits::verdicts(&measure(workspace, false)?)?;
    println!("\n{}", limits::table(&verdicts));
    let broken: Vec<String> = verdicts.iter().filter(|one| !one.holds()).map(ToString::to_string).collect();
    if !broken.is_empty() {
        bail!("{} of {} limits are not held:\n  {}", broken.len(), verdicts.len(), broken.join("\n  "));
    }
    Ok(())
}

/// The formatter, the linter and the tests of the benchmark's workspace, the servers of others left out.
pub(crate) fn lint_and_test(workspace: &Workspace) -> Result<()> {
    run::shown(workspace.cargo().args(["fmt", "--all", "--manifest-path", MANIFEST, "--", "--check"]))?;
    let clippy = |mut command: Command, packages: &[&str]| {
        command.args(["--quiet", "--manifest-path", MANIFEST, "--target-dir"]).arg(builds(workspace));
        for package in packages {
            command.args(["--package", package]);
        }
        run::shown(command.args(["--", "-D", "warnings"]))
    };
    let mut command = workspace.cargo();
    command.arg("clippy");
    clippy(command, &["jointbus-bench-host", "jointbus-bench-bridge", "jointbus-bench-recorder"])?;
    let command = setup::toolchain(workspace)?.cargo(workspace, "clippy");
    clippy(command, &["jointbus-bench-m4", "jointbus-bench-subjects"])?;
    let mut command = workspace.cargo();
    command.args(["test", "--quiet", "--release", "--manifest-path", MANIFEST, "--target-dir"]);
    run::shown(command.arg(builds(workspace)).args(["--package", bridge::PACKAGE]))
}

fn measure(workspace: &Workspace, others: bool) -> Result<Figures> {
    let mut figures = Figures::default();
    m4::measure(workspace, others, &mut figures)?;
    host::measure(workspace, others, &mut figures)?;
    bridge::measure(workspace, &mut figures)?;
    Ok(figures)
}

/// What the figures change with.
fn conditions(workspace: &Workspace) -> Result<String> {
    let compiler = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let version = |mut command: Command| -> Result<String> {
        let printed = run::output(command.arg("--version"))?;
        Ok(printed.lines().next().unwrap_or_default().to_owned())
    };
    let mut valgrind = Command::new("env");
    setup::tell_programs(workspace, &mut valgrind);
    valgrind.arg("valgrind");
    let versions = [workspace.command(compiler), Command::new(setup::emulator(workspace)?.qemu), valgrind];
    let versions = versions.into_iter().map(version).collect::<Result<Vec<_>>>()?;
    Ok(format!("Taken with {}.\n", versions.join(", ")))
}

/// Where the benchmark's workspace is built.
fn builds(workspace: &Workspace) -> PathBuf {
    workspace.target.join("bench").join("build")
}
