//! Images for a bare Cortex-M4: what a subject adds to one without it, and what it takes while it runs in the emulator.

use std::fs;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};

use super::figures::Figures;
use super::{MANIFEST, builds};
use crate::setup::{self, TARGET};
use crate::workspace::Workspace;
use crate::{firmware, run};

const PACKAGE: &str = "jointbus-bench-m4";

/// The image without a subject.
const EMPTY: &str = "empty";

/// Ours.
pub(crate) const OURS: [&str; 11] = [
    "server",
    "server_sliced",
    "server_small",
    "server_bitwise",
    "nst",
    "nxi",
    "ndam",
    "can_join",
    "can_cut",
    "routes_one",
    "routes_all",
];

/// The servers of others.
pub(crate) const OTHERS: [&str; 3] = ["rmodbus", "modbus_core", "mbus"];

/// Optimised for size and for speed: the profile, and what the figures are filed under.
pub(crate) const PROFILES: [(&str, &str); 2] = [("firmware", "m4 size"), ("firmware-fast", "m4 speed")];

/// Some crates with link-time optimisation, an image each.
const BUILD_LIMIT: Duration = Duration::from_secs(900);

/// The emulated board with an STM32F405 on it.
const MACHINE: &str = "netduinoplus2";

/// Seconds after which a run that does not end is ended, by `timeout`.
const RUN_LIMIT: &str = "60";

/// Ticks of the system timer in a thousand calls are instructions in one: the emulator lets an instruction take 1 ns, and
/// the timer tick with 168 MHz.
const TICKS_AN_INSTRUCTION: f64 = 168.0;

/// Builds and runs all images; with others' only if asked for.
pub(crate) fn measure(workspace: &Workspace, others: bool, figures: &mut Figures) -> Result<()> {
    for (profile, place) in PROFILES {
        let subjects: Vec<&str> = OURS.into_iter().chain(OTHERS.into_iter().filter(|_| others)).collect();
        measure_some(workspace, &subjects, others, (profile, place), figures)?;
    }
    Ok(())
}

/// Builds and runs the images of these subjects with one profile.
pub(crate) fn measure_some(
    workspace: &Workspace,
    subjects: &[&str],
    others: bool,
    (profile, place): (&str, &str),
    figures: &mut Figures,
) -> Result<()> {
    let emulator = setup::emulator(workspace)?;
    let mut command = setup::toolchain(workspace)?.cargo(workspace, "build");
    command.args(["--quiet", "--manifest-path", MANIFEST, "--package", PACKAGE, "--profile", profile]);
    command.arg("--target-dir").arg(builds(workspace));
    if others {
        command.args(["--features", "others"]);
    }
    for image in subjects.iter().chain([&EMPTY]) {
        command.args(["--bin", image]);
    }
    run::quiet(&mut command, BUILD_LIMIT)?;
    let folder = builds(workspace).join(TARGET).join(profile);
    let usage = |image: &str| -> Result<firmware::Usage> {
        let path = folder.join(image);
        let file = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        firmware::usage(&file).with_context(|| path.display().to_string())
    };
    let empty = usage(EMPTY)?;
    for image in subjects {
        let usage = usage(image)?;
        figures.set(place, image, "flash", f64::from(usage.flash.saturating_sub(empty.flash)));
        figures.set(place, image, "static RAM", f64::from(usage.static_ram.saturating_sub(empty.static_ram)));
        let mut run = Command::new("timeout");
        run.arg(RUN_LIMIT)
            .arg(&emulator.qemu)
            .args(["-machine", MACHINE, "-display", "none", "-monitor", "none"])
            .args(["-serial", "none", "-icount", "shift=0", "-chardev", "stdio,id=host"])
            .args(["-semihosting-config", "enable=on,target=native,chardev=host", "-kernel"])
            .arg(folder.join(image));
        let printed = run::output(&mut run)?;
        understand(&printed, (place, image), figures)
            .with_context(|| format!("{image} printed `{printed}`"))?;
    }
    Ok(())
}

/// The lines that an image prints: a name and a hexadecimal number each.
fn understand(printed: &str, (place, image): (&str, &str), figures: &mut Figures) -> Result<()> {
    let mut wrong = None;
    for line in printed.lines() {
        let (name, number) = line.rsplit_once(' ').context("a line without a number")?;
        let number = f64::from(u32::from_str_radix(number.trim(), 16)?);
        match name {
            "wrong" => wrong = Some(number),
            "stack" | "state" => figures.set(place, image, name, number),
            request => figures.set(place, image, request, (number / TICKS_AN_INSTRUCTION).round()),
        }
    }
    let wrong = wrong.context("it did not come to its end")?;
    ensure!(wrong == 0.0, "{wrong} wrong answers");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_images_words_are_understood() {
        let mut figures = Figures::default();
        let words = "03 x 10 registers 0000a800\nstack 00000078\nstate 00000280\nwrong 00000000\n";
        understand(words, ("m4", "server"), &mut figures).unwrap();
        assert_eq!(figures.get("m4", "server", "03 x 10 registers").unwrap(), 256.0);
        assert_eq!(figures.get("m4", "server", "stack").unwrap(), 120.0);
        assert!(understand("stack 00000078\n", ("m4", "server"), &mut figures).is_err(), "cut off");
        assert!(understand("wrong 00000001\n", ("m4", "server"), &mut figures).is_err(), "a wrong answer");
    }
}
