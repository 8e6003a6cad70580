//! The simulation from the command line: one run of a seed, or the long test of everything that must hold.

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand};
use jointbus_host_tests::sim::properties::{self, Found};
use jointbus_host_tests::sim::{Fault, Plan, Run, SECONDS, SimBoard, Trial};
use std::path::PathBuf;
use std::time::Instant;

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
        /// The board: stm32f405, small or large; unless given, the one whose turn it is in a soak
        #[arg(long, value_name = "NAME", value_parser = board)]
        board: Option<SimBoard>,
        /// Only this kind of fault; can be given more than once
        #[arg(long, value_name = "KIND", value_parser = kind)]
        kind: Vec<Fault>,
        /// Mostly broken bursts with a command inside
        #[arg(long)]
        hiding: bool,
        /// How many requests the host sends
        #[arg(long, default_value_t = 1000)]
        requests: u64,
        /// Record all wires into this file, for Wireshark
        #[arg(long, value_name = "FILE")]
        pcap: Option<PathBuf>,
    },
    /// Show that everything holds that must: a million requests and more
    Soak {
        /// First seed of each property
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// Seeds of a thousand requests each
        #[arg(long, default_value_t = 1100)]
        seeds: u64,
    },
    /// Inject one fault into clean traffic
    Alone {
        /// Everything random follows from it
        #[arg(long)]
        seed: u64,
        /// The fault
        #[arg(long, value_name = "KIND", value_parser = kind)]
        kind: Fault,
    },
    /// Print the table of the kinds of fault
    Table,
    /// List the kinds of fault
    Kinds,
}

fn kind(name: &str) -> Result<Fault, String> {
    Fault::of_name(name).ok_or_else(|| "`cargo xtask sim --list` lists the kinds".to_owned())
}

fn board(name: &str) -> Result<SimBoard, String> {
    SimBoard::of_name(name).ok_or_else(|| {
        let names = SimBoard::ALL.map(|board| board.name());
        format!("the boards are {}", names.join(", "))
    })
}

fn main() -> Result<()> {
    match Arguments::parse().command {
        Command::Run { seed, board, kind, hiding, requests, pcap } => {
            let board = board.unwrap_or_else(|| SimBoard::of_seed(seed));
            let plan = match hiding {
                true => Plan::hiding(board, seed, requests),
                false => Plan::of_seed(board, seed, requests, (!kind.is_empty()).then_some(&kind)),
            };
            run(plan, pcap)
        }
        Command::Soak { seed, seeds } => soak(seed, seeds),
        Command::Alone { seed, kind } => alone(kind, seed),
        Command::Table => {
            print!("{}", Fault::table());
            Ok(())
        }
        Command::Kinds => {
            for fault in Fault::ALL {
                println!("{:<24}{}", fault.name(), fault.about());
            }
            Ok(())
        }
    }
}

fn run(plan: Plan, pcap: Option<PathBuf>) -> Result<()> {
    println!(
        "seed {}, board {}: {:?}, faults before {} of a million requests",
        plan.settings.seed,
        plan.settings.board.name(),
        plan.manner,
        plan.fault_rate
    );
    let mut queues = plan.settings.board.queues();
    let mut run = Run::new(plan, &mut queues);
    if pcap.is_some() {
        run.world.record();
    }
    let started = Instant::now();
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

/// One fault alone.
fn alone(fault: Fault, seed: u64) -> Result<()> {
    let trial = Trial::of(fault, seed);
    println!("{trial:#?}");
    let wrong = trial.raised.len() + trial.service.len();
    if wrong > 0 {
        bail!("{wrong} times what must not happen");
    }
    Ok(())
}

/// Every property, one after the other; fails if one does not hold.
fn soak(seed: u64, seeds: u64) -> Result<()> {
    let mut violated = 0;
    let mut tell = |started: Instant, name: &str, found: &Found| {
        violated += found.violated;
        println!("{name}: {} violations in {:.1} s", found.violated, started.elapsed().as_secs_f64());
        println!("    {found}");
        found.violations.iter().for_each(|violation| println!("    {violation}"));
    };
    let started = Instant::now();
    let found = properties::answers(SimBoard::of_seed, seed..seed + 2 * seeds);
    tell(started, "no wrong answer, all counted, nothing late, nothing twice", &found);
    let started = Instant::now();
    let found = properties::hidden_commands(SimBoard::of_seed, seed..seed + 2 * seeds);
    tell(started, "no bytes inside a frame are executed", &found);
    let started = Instant::now();
    let [counters, service] = properties::each_fault_alone(seed..seed + seeds.div_ceil(4));
    tell(started, "each kind of fault raises its counters and no others", &counters);
    tell(started, "the service returns within the bound of each kind of fault", &service);
    let started = Instant::now();
    let found = properties::dead_devices(SimBoard::of_seed, seed..seed + seeds.div_ceil(10));
    tell(started, "a dead device costs the others little", &found);
    for board in [SimBoard::STM32F405, SimBoard::LARGE] {
        let started = Instant::now();
        let span = (4 * seeds * SECONDS).min(3600 * SECONDS);
        let [calm, rough] = properties::polling_both(board, seed, span);
        let name = board.name();
        tell(started, &format!("polling with 1000 Hz misses nothing on {name}"), &calm);
        tell(started, &format!("polling with 1000 Hz counts what faults make it miss on {name}"), &rough);
    }
    if violated > 0 {
        bail!("{violated} violations");
    }
    Ok(())
}
