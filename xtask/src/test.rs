//! Every check, one after the other, until one fails.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::Args;

use crate::progress::shown;
use crate::setup::TARGETS;
use crate::workspace::Workspace;
use crate::{agreement, bench, firmware, fuzz, imports, length, miri, msrv, portable, probe, run, setup};

/// Tells the tests where the image is, as an ELF file.
pub(crate) const IMAGE: &str = "JOINTBUS_IMAGE";
/// Tells the tests where the emulator's plugin is.
pub(crate) const PLUGIN: &str = "JOINTBUS_EMULATOR_PLUGIN";
/// Tells the tests which Python has the real clients.
const PYTHON: &str = "JOINTBUS_PYTHON";

/// The package with the tests of the image and of the plugin.
const HARNESS: &str = "jointbus-host-tests";

/// Steps that are named in the end for the time that they took.
const SLOWEST: usize = 5;

/// The crate that others take from a registry.
const PROTOCOL: &str = "jointbus-protocol";
/// The crate with the engine and its adapters.
const BRIDGE: &str = "jointbus-mcu-bridge";

/// One check.
struct Step {
    /// What `--only` takes.
    name: &'static str,
    /// What it takes on two cores from a fresh clone.
    seconds: u64,
    /// What it does, as a headline.
    about: &'static str,
    /// Sets up what the check needs; all of this comes before the first check.
    prepare: fn(&Workspace) -> Result<()>,
    run: fn(&Workspace) -> Result<()>,
}

/// All checks, the quick ones first.
static STEPS: &[Step] = &[
    Step {
        name: "format",
        seconds: 2,
        about: "the code is formatted, and no file of it is long",
        prepare: setup::components,
        run: |workspace| {
            run::shown(workspace.cargo().args(["fmt", "--all", "--", "--check"]))?;
            length::check(workspace)
        },
    },
    Step {
        name: "imports",
        seconds: 1,
        about: "no modules of the library crates import each other",
        prepare: |_| Ok(()),
        run: imports::check,
    },
    Step {
        name: "clippy",
        seconds: 40,
        about: "the linter has nothing to say about the host's code",
        prepare: setup::components,
        run: |workspace| {
            run::shown(workspace.cargo().args([
                "clippy",
                "--workspace",
                "--all-targets",
                "--",
                "-D",
                "warnings",
            ]))
        },
    },
    Step {
        name: "clippy-firmware",
        seconds: 30,
        about: "the linter has nothing to say about the image's code",
        prepare: |workspace| {
            setup::components(workspace)?;
            setup::toolchain(workspace)?;
            Ok(())
        },
        run: |workspace| {
            firmware::clippy(workspace)?;
            probe::clippy(workspace)
        },
    },
    Step {
        name: "firmware",
        seconds: 30,
        about: "the image builds and fits the part",
        prepare: |workspace| setup::toolchain(workspace).map(drop),
        run: |workspace| {
            firmware::build(workspace)?.report();
            Ok(())
        },
    },
    Step {
        name: "parts",
        seconds: 15,
        about: "the library crates build for a Cortex-M0+, a Cortex-M4 and a Cortex-M33",
        prepare: |workspace| setup::toolchain(workspace).map(drop),
        run: parts,
    },
    Step {
        name: "panic-free",
        seconds: 100,
        about: "nothing in the protocol crate can panic on the part, optimised for size or for speed",
        prepare: |workspace| setup::toolchain(workspace).map(drop),
        run: probe::panic_free,
    },
    Step {
        name: "emulator",
        seconds: 130,
        about: "the emulator's plugin works in the oldest and the newest QEMU that it is made for",
        prepare: |workspace| setup::emulators(workspace).map(drop),
        run: emulators,
    },
    Step {
        name: "portable",
        seconds: 60,
        about: "everything but the image compiles for Windows and macOS",
        prepare: portable::prepare,
        run: portable::check,
    },
    Step {
        name: "docs",
        seconds: 20,
        about: "the documentation builds, its links lead somewhere",
        prepare: |_| Ok(()),
        run: |workspace| {
            let mut command = workspace.cargo();
            run::shown(command.env("RUSTDOCFLAGS", "-D warnings").args(["doc", "--workspace", "--no-deps"]))
        },
    },
    Step {
        name: "package",
        seconds: 15,
        about: "the protocol crate can be published, and its one feature only adds",
        prepare: setup::components,
        run: |workspace| {
            let lint = ["clippy", "--package", PROTOCOL, "--all-features", "--", "-D", "warnings"];
            run::shown(workspace.cargo().args(lint))?;
            // what is not committed is packaged as well, so that the check says the same at the desk
            run::shown(workspace.cargo().args(["package", "--package", PROTOCOL, "--allow-dirty"]))
        },
    },
    Step {
        name: "msrv",
        seconds: 45,
        about: "the protocol crate builds and passes with the oldest Rust that it promises",
        prepare: |_| Ok(()),
        run: msrv::msrv,
    },
    Step {
        name: "tests",
        seconds: 150,
        about: "the tests pass, also those on the emulated part and with real clients",
        prepare: setup::all,
        run: tests,
    },
    Step {
        name: "agreement",
        seconds: 15,
        about: "the general server and libmodbus answer alike, or a rule says why not",
        prepare: |workspace| setup::libmodbus(workspace).map(drop),
        run: |workspace| {
            agreement::clippy(workspace)?;
            agreement::briefly(workspace)
        },
    },
    Step {
        name: "bench",
        seconds: 150,
        about: "every figure holds its limit",
        prepare: |workspace| {
            setup::components(workspace)?;
            bench::prepare(workspace)
        },
        run: |workspace| {
            bench::lint_and_test(workspace)?;
            bench::check(workspace)
        },
    },
    Step {
        name: "miri",
        seconds: 240,
        about: "the protocol crate's unit tests have no undefined behaviour",
        prepare: setup::nightly::miri,
        run: miri::miri,
    },
    Step {
        name: "fuzz",
        seconds: 120,
        about: "a minute of hostile input finds nothing",
        prepare: setup::nightly::fuzzer,
        run: fuzz::briefly,
    },
];

/// Which checks to run.
#[derive(Args)]
pub(crate) struct Selection {
    /// Show the steps instead of running them
    #[arg(long)]
    list: bool,
    /// Run this step alone; can be given more than once
    #[arg(long, value_name = "STEP", value_parser = names())]
    only: Vec<String>,
}

/// Runs the chosen checks, all of them unless told otherwise.
pub(crate) fn test(workspace: &Workspace, selection: &Selection) -> Result<()> {
    let steps = chosen(&selection.only);
    if selection.list {
        for step in &steps {
            println!("{:<16} {:>5} s  {}", step.name, step.seconds, step.about);
        }
        return Ok(());
    }
    let start = Instant::now();
    println!("{}, about {} on two cores from a fresh clone", count(steps.len()), shown(expected(&steps)));
    for step in &steps {
        (step.prepare)(workspace).with_context(|| format!("cannot set up what `{}` needs", step.name))?;
    }
    println!("set up in {}", shown(start.elapsed()));
    let mut taken = Vec::new();
    for (index, step) in steps.iter().enumerate() {
        println!("\n== {} of {}: {} ({})", index + 1, steps.len(), step.name, step.about);
        let to_go = expected(&steps[index..]);
        println!("== {} so far, about {} to go", shown(start.elapsed()), shown(to_go));
        let began = Instant::now();
        if let Err(error) = (step.run)(workspace) {
            println!("== {} failed after {}", step.name, shown(began.elapsed()));
            let passed: Vec<_> = steps.iter().take(index).map(|step| step.name).collect();
            if !passed.is_empty() {
                println!("passed before it: {}", passed.join(", "));
            }
            println!("to repeat it:     cargo xtask test --only {}", step.name);
            return Err(error.context(format!("step {} failed", step.name)));
        }
        println!("== {} passed in {}", step.name, shown(began.elapsed()));
        taken.push((step.name, began.elapsed()));
    }
    println!("\nslowest: {}", slowest(taken));
    println!("{} passed in {}", count(steps.len()), shown(start.elapsed()));
    Ok(())
}

fn count(steps: usize) -> String {
    format!("{steps} {}", if steps == 1 { "step" } else { "steps" })
}

/// What these steps take together, their set-up left out.
fn expected(steps: &[&Step]) -> Duration {
    Duration::from_secs(steps.iter().map(|step| step.seconds).sum())
}

/// The steps that took longest, the first one first.
fn slowest(mut taken: Vec<(&str, Duration)>) -> String {
    taken.sort_by_key(|(_, time)| std::cmp::Reverse(*time));
    let shown = taken.iter().take(SLOWEST).map(|(name, time)| format!("{name} {}", shown(*time)));
    shown.collect::<Vec<_>>().join(", ")
}

/// The steps of those names in the order of the table; without names, all.
fn chosen(names: &[String]) -> Vec<&'static Step> {
    STEPS.iter().filter(|step| names.is_empty() || names.iter().any(|name| name == step.name)).collect()
}

/// The names of all steps.
fn names() -> Vec<&'static str> {
    STEPS.iter().map(|step| step.name).collect()
}

/// `cargo test`, its tests told where everything is. A test that needs one of these fails without it.
fn tests(workspace: &Workspace) -> Result<()> {
    let image = firmware::build(workspace)?;
    let emulator = setup::emulator(workspace)?;
    let python = setup::clients(workspace)?;
    let mut command = workspace.cargo();
    setup::tell_programs(workspace, &mut command);
    emulator.tell(&mut command);
    command.env(IMAGE, image.elf).env(PLUGIN, emulator.plugin).env(PYTHON, python);
    run::shown(command.args(["test", "--workspace"]))
}

/// The library crates for every processor that they are made for.
fn parts(workspace: &Workspace) -> Result<()> {
    let toolchain = setup::toolchain(workspace)?;
    for target in TARGETS {
        let mut command = toolchain.cargo_for(workspace, "build", target);
        run::shown(command.args(["--lib", "--package", PROTOCOL, "--package", BRIDGE]))?;
    }
    Ok(())
}

/// The tests that touch what releases of QEMU differ in, with each of them.
fn emulators(workspace: &Workspace) -> Result<()> {
    let image = firmware::build(workspace)?;
    for (release, emulator) in setup::emulators(workspace)? {
        println!("with QEMU {release}:");
        let mut command = workspace.cargo();
        emulator.tell(&mut command);
        command.env(IMAGE, &image.elf).env(PLUGIN, &emulator.plugin);
        command.args(["test", "--package", HARNESS, "--test", "emulator_plugin", "--test", "image"]);
        run::shown(&mut command)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen_names(only: &[&str]) -> Vec<&'static str> {
        let only: Vec<String> = only.iter().map(|name| (*name).to_owned()).collect();
        chosen(&only).iter().map(|step| step.name).collect()
    }

    #[test]
    fn without_a_choice_every_step_runs() {
        assert_eq!(chosen_names(&[]).len(), STEPS.len());
    }

    #[test]
    fn chosen_steps_keep_their_order() {
        assert_eq!(chosen_names(&["tests", "format"]), ["format", "tests"]);
    }

    #[test]
    fn no_two_steps_have_one_name() {
        let mut all = names();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), STEPS.len());
    }

    #[test]
    fn the_slowest_steps_come_first() {
        let taken = vec![("a", seconds(1)), ("b", seconds(3)), ("c", seconds(2))];
        assert_eq!(slowest(taken), "b 3 s, c 2 s, a 1 s");
    }

    #[test]
    fn all_of_it_is_expected_to_take_less_than_twenty_minutes() {
        let all: Vec<&Step> = STEPS.iter().collect();
        assert!(expected(&all) < seconds(20 * 60), "{:?}", expected(&all));
    }

    const fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }
}
