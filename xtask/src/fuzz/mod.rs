//! The fuzz targets of `checks/fuzz/`: built with the fuzzer, run beside each other for a time that they share, and
//! counted.

mod seeds;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::Duration;
use std::{mem, thread};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;

use crate::run;
use crate::setup::nightly;
use crate::workspace::Workspace;

/// The workspace of the targets.
const FOLDER: &str = "checks/fuzz";

/// No input is longer, in bytes: some dozen frames.
const LENGTH_MAX: usize = 2048;

/// Longest run of one input, in seconds; the slowest takes some milliseconds.
const HANG: u32 = 20;

/// How long to fuzz, and what.
#[derive(Args)]
pub(crate) struct Budget {
    /// Minutes for all targets together
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    minutes: u64,
    /// Fuzz this target alone; can be given more than once
    #[arg(long, value_name = "TARGET")]
    only: Vec<String>,
    /// Write the inputs to start from anew, and do nothing else
    #[arg(long)]
    write_seeds: bool,
}

/// Where the fuzzer keeps what.
struct Folders {
    /// What is committed: inputs to start from.
    seeds: PathBuf,
    /// What earlier runs have found interesting; it can be deleted.
    corpus: PathBuf,
    /// Inputs that failed.
    artifacts: PathBuf,
    /// What the targets print.
    logs: PathBuf,
    /// The programs.
    programs: PathBuf,
}

/// What came of one target.
struct Outcome {
    target: String,
    executions: u64,
    /// What to say about a failure.
    failure: Option<String>,
}

/// A minute of everything.
pub(crate) fn briefly(workspace: &Workspace) -> Result<()> {
    fuzz(workspace, &Budget { minutes: 1, only: Vec::new(), write_seeds: false })
}

/// Fuzzes until the time is over; fails if any target did.
pub(crate) fn fuzz(workspace: &Workspace, budget: &Budget) -> Result<()> {
    if budget.write_seeds {
        return seeds::write(workspace);
    }
    nightly::fuzzer(workspace)?;
    let targets = chosen(targets(workspace)?, &budget.only)?;
    let folders = build(workspace)?;
    let jobs = thread::available_parallelism().map_or(1, usize::from).min(targets.len());
    let each = share(Duration::from_secs(60 * budget.minutes), targets.len(), jobs);
    println!("{} targets, {jobs} beside each other, {} s each", targets.len(), each.as_secs());
    let outcomes = run_all(&folders, targets, jobs, each)?;

    println!("\n{:<16} {:>14}", "target", "executions");
    for outcome in &outcomes {
        let remark = if outcome.failure.is_some() { "  FAILED" } else { "" };
        println!("{:<16} {:>14}{remark}", outcome.target, outcome.executions);
    }
    println!("{:<16} {:>14}", "all", outcomes.iter().map(|outcome| outcome.executions).sum::<u64>());
    let failures: Vec<_> = outcomes.into_iter().filter_map(|outcome| outcome.failure).collect();
    ensure!(failures.is_empty(), "{}", failures.join("\n"));
    Ok(())
}

/// The time of one target, so that all of them fit into `total`.
fn share(total: Duration, targets: usize, jobs: usize) -> Duration {
    let rounds = targets.div_ceil(jobs.max(1)).max(1);
    (total / u32::try_from(rounds).unwrap_or(u32::MAX)).max(Duration::from_secs(1))
}

/// Where the targets and their seeds are.
fn folder(workspace: &Workspace) -> PathBuf {
    workspace.root.join(FOLDER)
}

/// The names of all targets: their files.
fn targets(workspace: &Workspace) -> Result<Vec<String>> {
    let folder = folder(workspace).join("fuzz_targets");
    let entries = fs::read_dir(&folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut names = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "rs") {
            names.extend(path.file_stem().map(|name| name.to_string_lossy().into_owned()));
        }
    }
    names.sort_unstable();
    Ok(names)
}

/// Those that were asked for; without a wish, all.
fn chosen(all: Vec<String>, only: &[String]) -> Result<Vec<String>> {
    if let Some(unknown) = only.iter().find(|name| !all.contains(name)) {
        bail!("there is no target `{unknown}`, but there are {}", all.join(", "));
    }
    Ok(all.into_iter().filter(|name| only.is_empty() || only.contains(name)).collect())
}

/// Builds all targets.
fn build(workspace: &Workspace) -> Result<Folders> {
    // A folder of its own: the instrumented builds would otherwise take turns with the others.
    let target = workspace.target.join("fuzz");
    let mut command = nightly::cargo(workspace, "fuzz");
    command.args(["build", "--fuzz-dir", FOLDER, "--target-dir"]).arg(&target);
    run::shown(&mut command)?;
    Ok(Folders {
        seeds: seeds::folder(workspace),
        artifacts: folder(workspace).join("artifacts"),
        corpus: target.join("corpus"),
        logs: target.join("logs"),
        programs: target.join(nightly::host(workspace)?).join("release"),
    })
}

/// Runs the targets, so many beside each other, and hands back what came of them in the same order.
fn run_all(folders: &Folders, targets: Vec<String>, jobs: usize, each: Duration) -> Result<Vec<Outcome>> {
    let count = targets.len();
    let waiting = Mutex::new(targets.into_iter().enumerate());
    let done = Mutex::new(Vec::with_capacity(count));
    let next = || waiting.lock().ok().and_then(|mut waiting| waiting.next());
    thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| {
                while let Some((index, target)) = next() {
                    let outcome = run_one(folders, target, each);
                    if let Ok(mut done) = done.lock() {
                        done.push((index, outcome));
                    }
                }
            });
        }
    });
    let mut done = mem::take(&mut *done.lock().map_err(|_| anyhow::anyhow!("a job has panicked"))?);
    ensure!(done.len() == count, "a job has panicked");
    done.sort_by_key(|(index, _)| *index);
    done.into_iter().map(|(_, outcome)| outcome).collect()
}

/// Runs one target.
fn run_one(folders: &Folders, target: String, time: Duration) -> Result<Outcome> {
    let [seeds, corpus, artifacts] =
        [&folders.seeds, &folders.corpus, &folders.artifacts].map(|folder| folder.join(&target));
    for folder in [&corpus, &artifacts, &folders.logs] {
        fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    }
    let log = folders.logs.join(format!("{target}.log"));
    let file = File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
    let mut command = Command::new(folders.programs.join(&target));
    command
        .arg(format!("-max_total_time={}", time.as_secs()))
        .arg(format!("-max_len={LENGTH_MAX}"))
        .arg(format!("-timeout={HANG}"))
        .arg(format!("-artifact_prefix={}/", artifacts.display()))
        .args(["-print_final_stats=1", "-verbosity=1"])
        .arg(&corpus);
    if seeds.exists() {
        command.arg(&seeds);
    }
    // With the seeds the fuzzer is done in the time given; a target that hangs is ended by the fuzzer itself.
    let status = command
        .stdin(Stdio::null())
        .stdout(file.try_clone()?)
        .stderr(file)
        .status()
        .with_context(|| format!("cannot start {target}"))?;
    let printed = String::from_utf8_lossy(&fs::read(&log)?).into_owned();
    let failure = (!status.success()).then(|| explain(&target, &printed, &log));
    let outcome = Outcome { executions: executions(&printed), failure, target };
    println!("{:<16} {:>14} executions", outcome.target, outcome.executions);
    Ok(outcome)
}

/// How often the fuzzer says that it ran its target.
fn executions(printed: &str) -> u64 {
    let number = printed.lines().find_map(|line| line.strip_prefix("stat::number_of_executed_units:"));
    number.and_then(|number| number.trim().parse().ok()).unwrap_or(0)
}

/// What failed, with which input, and how to see it again.
fn explain(target: &str, printed: &str, log: &Path) -> String {
    let reason = printed.lines().skip_while(|line| !line.contains("panicked at") && !line.starts_with("=="));
    let reason: Vec<_> = reason.take(4).collect();
    let artifact = printed.lines().find_map(|line| line.split_once("Test unit written to "));
    let repeat = match artifact {
        Some((_, path)) => format!("input: {path}\nrepeat: cargo +nightly fuzz run {target} {path}"),
        None => format!("it wrote no input; it printed {}", log.display()),
    };
    format!("{target} failed\n{}\n{repeat}", reason.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_targets_fit_into_the_time() {
        let minute = Duration::from_secs(60);
        assert_eq!(share(minute, 16, 2), Duration::from_millis(7500));
        assert_eq!(share(minute, 3, 2), Duration::from_secs(30));
        assert_eq!(share(minute, 1, 1), minute);
        assert_eq!(share(minute, 1000, 1), Duration::from_secs(1));
    }

    #[test]
    fn every_target_has_a_program() {
        let workspace = Workspace::locate().unwrap();
        let manifest = fs::read_to_string(folder(&workspace).join("Cargo.toml")).unwrap();
        for target in targets(&workspace).unwrap() {
            assert!(manifest.contains(&format!("path = \"fuzz_targets/{target}.rs\"")), "{target}");
        }
    }

    #[test]
    fn a_wish_that_there_is_not_is_refused() {
        let all = || vec!["a".to_owned(), "b".to_owned()];
        assert_eq!(chosen(all(), &[]).unwrap(), ["a", "b"]);
        assert_eq!(chosen(all(), &["b".to_owned()]).unwrap(), ["b"]);
        assert!(chosen(all(), &["c".to_owned()]).unwrap_err().to_string().contains("a, b"));
    }

    #[test]
    fn the_fuzzers_words_are_understood() {
        let printed = "stat::number_of_executed_units: 1016215\nstat::average_exec_per_sec: 1\n";
        assert_eq!(executions(printed), 1_016_215);
        assert_eq!(executions(""), 0);
        let failed = "INFO\nthread 'x' panicked at a.rs:1:2:\nboom\nTest unit written to /a/crash-1\n";
        let text = explain("t", failed, Path::new("log"));
        assert!(text.contains("boom") && text.ends_with("cargo +nightly fuzz run t /a/crash-1"), "{text}");
    }
}
