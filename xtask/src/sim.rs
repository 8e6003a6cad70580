//! The simulation in virtual time: one run, or all that must hold.

use anyhow::Result;
use clap::Args;
use std::path::PathBuf;

use crate::workspace::Workspace;
use crate::{emulate, run};

/// The program that simulates.
const PROGRAM: &str = "sim";

/// Which run.
#[derive(Args)]
pub(crate) struct Repeat {
    /// Everything random follows from it
    #[arg(long, required_unless_present_any = ["list", "table"])]
    seed: Option<u64>,
    /// The board: stm32f405, small or large; unless given, the one whose turn it is in a soak
    #[arg(long, value_name = "NAME", conflicts_with = "alone")]
    board: Option<String>,
    /// Only this kind of fault; can be given more than once
    #[arg(long, value_name = "KIND")]
    kind: Vec<String>,
    /// This kind of fault, once, in clean traffic on the reference board
    #[arg(long, value_name = "KIND", conflicts_with_all = ["kind", "hiding", "pcap"])]
    alone: Option<String>,
    /// Mostly broken bursts with a command inside
    #[arg(long, conflicts_with = "kind")]
    hiding: bool,
    /// How many requests the host sends
    #[arg(long, default_value_t = 1000)]
    requests: u64,
    /// Record all wires into this file, for Wireshark
    #[arg(long, value_name = "FILE")]
    pcap: Option<PathBuf>,
    /// List the kinds of fault instead
    #[arg(long)]
    list: bool,
    /// Print the table of what each kind of fault raises and costs instead, which is host-tests/FAULTS.md
    #[arg(long, conflicts_with = "list")]
    table: bool,
}

/// How much is to be shown.
#[derive(Args)]
pub(crate) struct Soak {
    /// First seed
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Seeds of a thousand requests each
    #[arg(long, default_value_t = 1100)]
    seeds: u64,
}

/// Repeats the run of a seed.
pub(crate) fn repeat(workspace: &Workspace, what: &Repeat) -> Result<()> {
    let mut command = emulate::harness(workspace, PROGRAM, None);
    match (what.seed, &what.alone) {
        _ if what.table => {
            command.arg("table");
        }
        (Some(seed), Some(kind)) if !what.list => {
            command.args(["alone", "--seed", &seed.to_string(), "--kind", kind]);
        }
        (Some(seed), None) if !what.list => {
            command.args(["run", "--seed", &seed.to_string(), "--requests", &what.requests.to_string()]);
            if let Some(board) = &what.board {
                command.args(["--board", board]);
            }
            what.kind.iter().for_each(|kind| {
                command.args(["--kind", kind]);
            });
            if what.hiding {
                command.arg("--hiding");
            }
            if let Some(file) = &what.pcap {
                // The file is meant from where the command was given.
                command.arg("--pcap").arg(std::path::absolute(file)?);
            }
        }
        _ => {
            command.arg("kinds");
        }
    }
    run::shown(&mut command)
}

/// Shows that everything holds that must.
pub(crate) fn soak(workspace: &Workspace, how: &Soak) -> Result<()> {
    let mut command = emulate::harness(workspace, PROGRAM, None);
    command.args(["soak", "--seed", &how.seed.to_string(), "--seeds", &how.seeds.to_string()]);
    run::shown(&mut command)?;
    // the flash in memory whose power fails stands in that test
    let cuts = ["test", "--release", "--package", "jointbus-mcu-bridge", "--test", "store"];
    run::shown(workspace.cargo().args(cuts).args(["--", "--nocapture"]))
}
