//! Something to watch: a host asks simulated devices through the bridge and checks every value.
//!
//! The bridge is the firmware's image on the emulated board, or its engine in this process. The host port stays open
//! for other programs while the demonstration runs. It ends with success only if every answer was right and every
//! device was read.

mod poll;
mod show;

use anyhow::{Context, Result, bail};
use clap::{Args, Parser};
use jointbus::bench::{Bench, Bridge};
use poll::Poller;
use show::Screen;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Polls simulated devices through the bridge and checks every value.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// How long to poll
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    seconds: u64,
    #[command(flatten)]
    bridge: BridgeArguments,
}

#[derive(Args)]
#[group(required = true, multiple = true)]
struct BridgeArguments {
    /// The firmware, as an ELF file, to run on the emulated board
    #[arg(long, value_name = "ELF", requires = "plugin", conflicts_with = "in_process")]
    image: Option<PathBuf>,
    /// The emulator's plugin
    #[arg(long, value_name = "LIBRARY", requires = "image", conflicts_with = "in_process")]
    plugin: Option<PathBuf>,
    /// Run the bridge's engine in this process instead of the firmware
    #[arg(long)]
    in_process: bool,
}

fn main() -> Result<ExitCode> {
    let arguments = Arguments::parse();
    let stopped = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&stopped);
    ctrlc::set_handler(move || stop.store(true, Ordering::Relaxed)).context("can't catch Ctrl-C")?;

    let mut bench = boot(&arguments.bridge)?;
    let share = bench.share()?;
    println!("the host port, for your own programs:");
    println!("  TCP       {}", share.listen()?);
    #[cfg(unix)]
    match share.terminal() {
        Ok(path) => println!("  terminal  {}", path.display()),
        Err(error) => println!("  terminal  none: this system gives no pseudo-terminal ({error})"),
    }
    println!("polling for {} s", arguments.seconds);

    let mut poller = Poller::new(&bench, &share);
    let mut screen = Screen::new();
    let start = Instant::now();
    let end = start + Duration::from_secs(arguments.seconds);
    // one round at least, however short the time
    loop {
        if !poller.round() {
            break;
        }
        screen.update(start.elapsed(), poller.readings());
        if Instant::now() >= end || stopped.load(Ordering::Relaxed) {
            break;
        }
    }
    let elapsed = start.elapsed();
    screen.last(elapsed, poller.readings());
    let right = poller.summary(elapsed);
    drop(poller);
    drop(share);
    bench.bridge.check()?;
    let verdict = if right { "every answer was right" } else { "NOT every answer was right" };
    println!("{verdict}; it came from {}", origin(&bench.bridge, arguments.bridge.image.as_deref()));
    Ok(if right { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Names what has answered.
fn origin(bridge: &Bridge, image: Option<&Path>) -> String {
    match bridge {
        #[cfg(unix)]
        Bridge::Emulated(emulator) => format!(
            "the firmware image {} on the emulated STM32F405 (QEMU {})",
            image.and_then(Path::file_name).unwrap_or_default().display(),
            emulator.version()
        ),
        Bridge::InProcess(_) => "the bridge's engine in this process, without a firmware image".into(),
    }
}

fn boot(arguments: &BridgeArguments) -> Result<Bench> {
    match (&arguments.image, &arguments.plugin) {
        (Some(image), Some(plugin)) => emulated(image, plugin),
        _ if arguments.in_process => {
            println!("starting the bridge's engine in this process");
            Bench::in_process()
        }
        _ => bail!("either --image and --plugin, or --in-process"),
    }
}

#[cfg(unix)]
fn emulated(image: &Path, plugin: &Path) -> Result<Bench> {
    println!("booting {} on the emulated STM32F405", image.display());
    Bench::emulated(&jointbus::emulator::Options::new(image, plugin))
}

#[cfg(not(unix))]
fn emulated(_: &Path, _: &Path) -> Result<Bench> {
    bail!("there is no emulator for this system; --in-process runs everywhere")
}
