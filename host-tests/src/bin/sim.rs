//! The simulation from the command line: one run of a seed, or the long test of everything that must hold.

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand};
use jointbus_host_tests::sim::{Fault, Plan, Run};
use jointbus_mcu_bridge::io::serial::Queues;
use std::path::PathBuf;

/// A bridge, its host and its devices in virtual time, with faults.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Repeat the run of a seed
    Run {
        /// Everything random follows from it
        #[arg(long)]
        seed: u64,
        /// Only this kind of fault; can be given more than once
        #[arg(long, value_name = "KIND", value_parser = kind)]
        kind: Vec<Fault>,
        /// How many requests the host sends
        #[arg(long, default_value_t = 1000)]
        requests: u64,
        /// Record all wires into this file, for Wireshark
        #[arg(long, value_name = "FILE")]
        pcap: Option<PathBuf>,
    },
    /// List the kinds of fault
    Kinds,
}

fn kind(name: &str) -> Result<Fault, String> {
    Fault::of_name(name).ok_or_else(|| "`cargo xtask sim --kinds` lists the kinds".to_owned())
}

fn main() -> Result<()> {
    match Arguments::parse().command {
        Command::Run { seed, kind, requests, pcap } => run(seed, &kind, requests, pcap),
        Command::Kinds => {
            for fault in Fault::ALL {
                println!("{:<24}{}", fault.name(), fault.about());
            }
            Ok(())
        }
    }
}

fn run(seed: u64, kinds: &[Fault], requests: u64, pcap: Option<PathBuf>) -> Result<()> {
    let plan = Plan::of_seed(seed, requests, (!kinds.is_empty()).then_some(kinds));
    println!("seed {seed}: {:?}, faults before {} of a million requests", plan.manner, plan.fault_rate);
    let mut queues = [Queues::new(), Queues::new(), Queues::new()];
    let mut run = Run::new(plan, &mut queues);
    if pcap.is_some() {
        run.world.record();
    }
    let started = std::time::Instant::now();
    run.to_the_end();
    let tally = &run.master.tally;
    println!("{tally:#?}");
    println!(
        "{:.3} s of virtual time in {:.3} s",
        run.world.now().as_nanos() as f64 / 1e9,
        started.elapsed().as_secs_f64()
    );
    let violated = tally.violated;
    if let Some(path) = pcap {
        let recording = run.world.recording().unwrap_or_default();
        std::fs::write(&path, recording).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if violated > 0 {
        bail!("{violated} times what must not happen");
    }
    Ok(())
}
