//! Every check, one after the other, until one fails.

use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;

use crate::workspace::Workspace;
use crate::{agreement, bench, emulate, firmware, fuzz, miri, msrv, probe, run, setup};

/// Tells the tests where the image is, as an ELF file.
pub(crate) const IMAGE: &str = "JOINTBUS_IMAGE";
/// Tells the tests where the emulator's plugin is.
pub(crate) const PLUGIN: &str = "JOINTBUS_EMULATOR_PLUGIN";
/// Tells the tests which Python has the real clients.
const PYTHON: &str = "JOINTBUS_PYTHON";

/// The crate that others take from a registry.
const PROTOCOL: &str = "jointbus-protocol";

/// One check.
struct Step {
    /// What `--only` takes.
    name: &'static str,
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
        about: "the code is formatted",
        prepare: setup::components,
        run: |workspace| run::shown(workspace.cargo().args(["fmt", "--all", "--", "--check"])),
    },
    Step {
        name: "clippy",
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
        about: "the image builds and fits the part",
        prepare: |workspace| setup::toolchain(workspace).map(drop),
        run: |workspace| {
            firmware::build(workspace)?.report();
            Ok(())
        },
    },
    Step {
        name: "panic-free",
        about: "nothing in the protocol crate can panic on the part, optimised for size or for speed",
        prepare: |workspace| setup::toolchain(workspace).map(drop),
        run: probe::panic_free,
    },
    Step {
        name: "emulator",
        about: "the emulator's plugin builds",
        prepare: |_| Ok(()),
        run: |workspace| emulate::build_plugin(workspace).map(drop),
    },
    Step {
        name: "docs",
        about: "the documentation builds, its links lead somewhere",
        prepare: |_| Ok(()),
        run: |workspace| {
            let mut command = workspace.cargo();
            run::shown(command.env("RUSTDOCFLAGS", "-D warnings").args(["doc", "--workspace", "--no-deps"]))
        },
    },
    Step {
        name: "package",
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
        about: "the protocol crate builds and passes with the oldest Rust that it promises",
        prepare: |_| Ok(()),
        run: msrv::msrv,
    },
    Step {
        name: "tests",
        about: "the tests pass, also those on the emulated part and with real clients",
        prepare: setup::all,
        run: tests,
    },
    Step {
        name: "agreement",
        about: "the general server and libmodbus answer alike, or a rule says why not",
        prepare: |_| setup::libmodbus(),
        run: |workspace| {
            agreement::clippy(workspace)?;
            agreement::briefly(workspace)
        },
    },
    Step {
        name: "bench",
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
        about: "the protocol crate's unit tests have no undefined behaviour",
        prepare: setup::nightly::miri,
        run: miri::miri,
    },
    Step {
        name: "fuzz",
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
            println!("{:<16} {}", step.name, step.about);
        }
        return Ok(());
    }
    for step in &steps {
        (step.prepare)(workspace).with_context(|| format!("cannot set up what `{}` needs", step.name))?;
    }
    for (index, step) in steps.iter().enumerate() {
        println!("\n== {} of {}: {} ({})", index + 1, steps.len(), step.name, step.about);
        let start = Instant::now();
        if let Err(error) = (step.run)(workspace) {
            println!("== {} failed after {:.1} s", step.name, start.elapsed().as_secs_f64());
            let passed: Vec<_> = steps.iter().take(index).map(|step| step.name).collect();
            if !passed.is_empty() {
                println!("passed before it: {}", passed.join(", "));
            }
            println!("to repeat it:     cargo xtask test --only {}", step.name);
            return Err(error.context(format!("step {} failed", step.name)));
        }
        println!("== {} passed in {:.1} s", step.name, start.elapsed().as_secs_f64());
    }
    println!("\n{} {} passed", steps.len(), if steps.len() == 1 { "step" } else { "steps" });
    Ok(())
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
    let plugin = emulate::build_plugin(workspace)?;
    let python = setup::clients(workspace)?;
    let mut command = workspace.cargo();
    command.env(IMAGE, image.elf).env(PLUGIN, plugin).env(PYTHON, python);
    run::shown(command.args(["test", "--workspace"]))
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
}
