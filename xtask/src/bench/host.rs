//! The subjects on the host, counted by callgrind.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};

use super::figures::Figures;
use super::{MANIFEST, builds};
use crate::workspace::Workspace;
use crate::{run, setup};

const PACKAGE: &str = "jointbus-bench-host";
/// Optimised for speed.
const PROFILE: &str = "firmware-fast";
/// What the figures are filed under.
pub(crate) const PLACE: &str = "host";
/// The function whose calls are counted.
const MEASURED: &str = "measured";

/// Counts; with others' servers only if asked for.
pub(crate) fn measure(workspace: &Workspace, others: bool, figures: &mut Figures) -> Result<()> {
    let mut command = workspace.cargo();
    if others {
        setup::libmodbus(workspace)?.tell(&mut command);
    }
    command.args([
        "build",
        "--quiet",
        "--manifest-path",
        MANIFEST,
        "--package",
        PACKAGE,
        "--profile",
        PROFILE,
    ]);
    command.arg("--target-dir").arg(builds(workspace));
    if others {
        command.args(["--features", "others"]);
    }
    run::shown(&mut command)?;
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let mut command = workspace.command("env");
    setup::tell_programs(workspace, &mut command);
    if others {
        setup::libmodbus(workspace)?.tell(&mut command);
    }
    command
        .args(["valgrind", "--quiet", "--tool=callgrind"])
        .arg(format!("--callgrind-out-file={}", folder.path().join("out").display()))
        .args([format!("--toggle-collect={MEASURED}"), format!("--dump-after={MEASURED}")])
        .arg(builds(workspace).join(PROFILE).join(PACKAGE));
    let printed = run::output(&mut command)?;
    let counts = printed.lines().enumerate().map(|(index, line)| {
        let (subject, request) = line.split_once('\t').with_context(|| format!("what is `{line}`?"))?;
        Ok((subject, request, total(&folder.path().join(format!("out.{}", index + 1)))?))
    });
    let counts = counts.collect::<Result<Vec<_>>>()?;
    let idle = counts.iter().rev().find(|(subject, ..)| *subject == "nothing");
    let (.., idle) = idle.context("the calls themselves were not counted")?;
    for (subject, request, count) in &counts {
        // everything is counted more than once: the last time stays
        figures.set(PLACE, subject, request, count - idle);
    }
    Ok(())
}

/// The instructions in a file of callgrind's.
fn total(path: &Path) -> Result<f64> {
    let file = fs::read_to_string(path).with_context(|| format!("callgrind left no {}", path.display()))?;
    let total = file.lines().find_map(|line| line.strip_prefix("totals:"));
    let total: f64 = total.context("a file of callgrind's without totals")?.trim().parse()?;
    ensure!(total > 0.0, "callgrind counted nothing");
    Ok(total)
}
