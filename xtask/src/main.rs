//! Everything a developer does with this repository, each as one command: `cargo xtask --help`.
//!
//! Every command first sets up what it needs, into the build directory; where it can't, it fails and names what to
//! install. This file holds the command line only.

mod agreement;
mod bench;
mod contributors;
mod demo;
mod emulate;
mod firmware;
mod fresh;
mod fuzz;
mod imports;
mod length;
mod miri;
mod msrv;
mod portable;
mod probe;
mod progress;
mod run;
mod setup;
mod sim;
mod size;
mod stack;
mod test;
mod workspace;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::workspace::Workspace;

/// Set-up, build, emulate, demo, test.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", about, arg_required_else_help = true)]
struct Arguments {
    #[command(subcommand)]
    command: Task,
}

/// One command each.
#[derive(Subcommand)]
enum Task {
    /// Install everything that the other commands need and that is missing
    Setup,
    /// Build the STM32F405 image as .elf, .bin and .hex, and show how much of the part it takes
    Firmware,
    /// Run the image in the emulator, its ports reachable as TCP sockets
    Emulate(emulate::Ports),
    /// Watch a host talk through the bridge to simulated devices
    Demo(demo::Manner),
    /// Show the flash, static RAM and worst-case stack of the image, and what each server and dispatcher takes
    Size,
    /// Measure everything and show it beside what others have; it also leaves a report with plots in the build directory
    Bench(bench::Manner),
    /// Feed the protocol stack and the bridge's engine with hostile input, for as long as you like
    Fuzz(fuzz::Budget),
    /// Repeat a simulated run in virtual time, by its seed
    Sim(sim::Repeat),
    /// Show in virtual time, over millions of requests, that everything holds that must
    Soak(sim::Soak),
    /// Send the same mutated requests to the general server and to libmodbus; every difference has a reason or fails
    Agreement(agreement::Extent),
    /// Make a bare Debian system and run the README's two commands there, as an ordinary user
    Fresh(fresh::Manner),
    /// Run every check and test; this is what CI runs
    Test(test::Selection),
}

fn main() -> ExitCode {
    match run_task(Arguments::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // The causes say what to do; a backtrace would bury it.
            eprintln!("error: {}", run::explain(&error));
            ExitCode::FAILURE
        }
    }
}

/// Hands the command to the file that knows it.
fn run_task(task: Task) -> anyhow::Result<()> {
    let workspace = Workspace::locate()?;
    match task {
        Task::Setup => setup::all(&workspace),
        Task::Firmware => {
            firmware::build(&workspace)?.report();
            Ok(())
        }
        Task::Emulate(ports) => emulate::emulate(&workspace, &ports),
        Task::Demo(manner) => demo::demo(&workspace, &manner),
        Task::Size => size::size(&workspace),
        Task::Bench(manner) => bench::bench(&workspace, &manner),
        Task::Fuzz(budget) => fuzz::fuzz(&workspace, &budget),
        Task::Sim(what) => sim::repeat(&workspace, &what),
        Task::Soak(how) => sim::soak(&workspace, &how),
        Task::Agreement(extent) => agreement::agree(&workspace, &extent),
        Task::Fresh(manner) => fresh::fresh(&workspace, &manner),
        Task::Test(selection) => test::test(&workspace, &selection),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        super::Arguments::command().debug_assert();
    }
}
