//! The bridge's image: what it takes, its instructions on the emulator, and what they make of its delays in virtual time.

use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::path::PathBuf;
use std::process::Command;

use anyhow::Result;

use super::figures::Figures;
use super::{MANIFEST, builds};
use crate::workspace::Workspace;
use crate::{firmware, run, setup};

/// The package of the programs.
pub(crate) const PACKAGE: &str = "jointbus-bench-bridge";
const RECORDER: &str = "jointbus-bench-recorder";

/// What all figures are of.
pub(crate) const SUBJECT: &str = "bridge";
/// What the figures are filed under: the image, and virtual time.
pub(crate) const IMAGE: &str = "image";
pub(crate) const WIRE: &str = "wire";

/// Core cycles that an instruction takes on the part at most, on average: a Cortex-M4 with the flash accelerator takes
/// less for code like this.
const CYCLES: f64 = 1.5;
/// Core cycles of an interrupt's entry and return, 12 each where the stack is in memory without wait states (Cortex-M4 TRM,
/// 3.9).
const CYCLES_AN_INTERRUPT: f64 = 24.0;
/// The core's clock in MHz.
const CLOCK: f64 = 168.0;

/// Measures all of it.
pub(crate) fn measure(workspace: &Workspace, figures: &mut Figures) -> Result<()> {
    let image = firmware::build(workspace)?;
    figures.set(IMAGE, SUBJECT, "flash", f64::from(image.usage.flash));
    figures.set(IMAGE, SUBJECT, "static RAM", f64::from(image.usage.static_ram));
    figures.set(IMAGE, SUBJECT, "worst stack", f64::from(image.worst.bytes));
    figures.read(IMAGE, &run::output(&mut recorded(workspace, &image)?)?)?;
    let saturated = |what: &str| figures.get(IMAGE, SUBJECT, &format!("saturated, {what} a second"));
    let cycles = saturated("instructions")? * CYCLES + saturated("interrupts")? * CYCLES_AN_INTERRUPT;
    figures.set(IMAGE, SUBJECT, "saturated, share of the processor, %", cycles / CLOCK / 1e4);
    let mut command = workspace.command(programs(workspace).join("wire"));
    // the main loop takes as long in the simulation, for each way what it takes for that
    for (way, what) in [("request from host to CAN", "request, us"), ("reply from CAN to host", "reply, us")]
    {
        let latency = figures.get(IMAGE, SUBJECT, &format!("{way}, worst"))? * CYCLES / CLOCK;
        figures.set(WIRE, SUBJECT, what, latency);
        command.arg(format!("{:.0}", latency * 1000.0));
    }
    figures.read(WIRE, &run::output(&mut command)?)
}

/// Shows which lines of source the image's instructions are from.
pub(crate) fn profile(workspace: &Workspace) -> Result<()> {
    let image = firmware::build(workspace)?;
    run::shown(recorded(workspace, &image)?.arg("profile"))
}

/// The program that runs the image on the emulator with the recorder.
fn recorded(workspace: &Workspace, image: &firmware::Image) -> Result<Command> {
    let emulator = setup::emulator(workspace)?;
    let mut command = workspace.cargo();
    command.args(["build", "--quiet", "--release", "--manifest-path", MANIFEST, "--target-dir"]);
    command.arg(builds(workspace)).args(["--package", PACKAGE, "--package", RECORDER]);
    run::shown(&mut command)?;
    let folder = programs(workspace);
    let recorder = folder.join(format!("{DLL_PREFIX}{}{DLL_SUFFIX}", RECORDER.replace('-', "_")));
    let mut command = workspace.command(folder.join("image"));
    emulator.tell(&mut command);
    command.arg(&image.elf).arg(emulator.plugin).arg(recorder);
    Ok(command)
}

fn programs(workspace: &Workspace) -> PathBuf {
    builds(workspace).join("release")
}
