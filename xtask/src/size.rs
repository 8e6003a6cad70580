//! What the bridge's image takes, and what a server or a dispatcher costs: images of `probe/` with and without it,
//! measured and run in the emulator.

use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};

use crate::firmware::{self, Usage};
use crate::probe::{FEATURE, PACKAGE};
use crate::run;
use crate::setup::{self, TARGET};
use crate::workspace::Workspace;
use crate::{contributors, emulate, test};

const IMAGE: &str = "measure";
const PROFILE: &str = "firmware";

/// One small image.
const BUILD_LIMIT: Duration = Duration::from_secs(600);

/// The emulated board with an STM32F405 on it.
const MACHINE: &str = "netduinoplus2";

/// The test that paints the image's stack and prints how much of it was used.
const PAINTED: &str = "resets::no_request_uses_more_stack_than_there_is";

/// Seconds after which a run that does not end is ended, by `timeout`.
const RUN_LIMIT: &str = "30";

/// What is measured: the feature of the probe, and what it is.
const SUBJECTS: [(&str, &str); 4] = [
    ("server", "general Modbus RTU server, eight function codes"),
    ("nst", "NST dispatcher, serial"),
    ("nxi", "NXI-6201 dispatcher"),
    ("ndam", "NDAM-9010 dispatcher, a station of one module"),
];

/// What the image says of itself when it runs.
#[derive(Debug, PartialEq, Eq)]
struct Run {
    stack: u32,
    answers: u32,
    requests: u32,
}

/// Measures all and prints a table.
pub(crate) fn size(workspace: &Workspace) -> Result<()> {
    setup::emulator()?;
    image(workspace)?;
    let (empty, idle) = measure(workspace, FEATURE)?;
    println!("{TARGET}, profile {PROFILE} (opt-level s, fat LTO), in bytes:\n");
    println!("{:<50} {:>6} {:>10} {:>6}", "", "flash", "static RAM", "stack");
    for (feature, about) in SUBJECTS {
        let (usage, run) = measure(workspace, &format!("{FEATURE},{feature}"))?;
        ensure!(run.answers > 0, "{about} answered none of {} requests", run.requests);
        let flash = usage.flash.saturating_sub(empty.flash);
        let ram = usage.static_ram.saturating_sub(empty.static_ram);
        println!("{about:<50} {flash:>6} {ram:>10} {:>6}", run.stack);
    }
    println!(
        "\nflash, static RAM: the image less an image whose `serve` does nothing; state and tables included, the\n\
         buffers of 256 bytes for request and response not.\n\
         stack: the deepest that was seen in the emulator ({MACHINE}) over {} requests, the longest reads and writes\n\
         among them, on a painted stack; no bound, but what was used. Interrupts come on top. Below {} it cannot see.",
        idle.requests, idle.stack
    );
    Ok(())
}

/// Prints what the bridge's image takes: in all, at worst on the stack, and by what.
fn image(workspace: &Workspace) -> Result<()> {
    let image = firmware::build(workspace)?;
    image.report();
    println!("\nworst-case stack, in bytes, each function with what is taken when it calls the next:\n");
    println!("{}", image.worst.lines());
    let used = used(workspace, &image)?;
    println!("used of it in a run with the longest requests: {used}\n");
    ensure!(used <= image.worst.bytes, "more than the worst case was used, which therefore is wrong");
    let file = fs::read(&image.elf).with_context(|| format!("cannot read {}", image.elf.display()))?;
    println!("{}", contributors::lines(&file)?);
    Ok(())
}

/// The deepest that the image's stack was seen in the emulator: a test of the image finds out.
fn used(workspace: &Workspace, image: &firmware::Image) -> Result<u32> {
    let plugin = emulate::build_plugin(workspace)?;
    let mut command = workspace.cargo();
    command.env(test::IMAGE, &image.elf).env(test::PLUGIN, plugin);
    command.args(["test", "--package", "jointbus-host-tests", "--test", "image", "--", "--exact", PAINTED]);
    let printed = run::output(command.arg("--nocapture"))?;
    let used = printed
        .lines()
        .find_map(|line| line.split_once(" of ").filter(|(_, rest)| rest.ends_with(" bytes of stack used")));
    let (used, _) = used.with_context(|| format!("{PAINTED} printed `{printed}`"))?;
    Ok(used.trim_start_matches(|character: char| !character.is_ascii_digit()).parse()?)
}

/// Builds the image with these features; what it takes, and what it says when it runs.
fn measure(workspace: &Workspace, features: &str) -> Result<(Usage, Run)> {
    let mut command = setup::toolchain(workspace)?.cargo(workspace, "build");
    command.args(["--profile", PROFILE, "--package", PACKAGE, "--bin", IMAGE, "--features", features]);
    run::quiet(&mut command, BUILD_LIMIT)?;
    let path: PathBuf = workspace.target.join(TARGET).join(PROFILE).join(IMAGE);
    let file = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let usage = firmware::usage(&file).with_context(|| path.display().to_string())?;
    let mut emulator = Command::new("timeout");
    emulator
        .args([RUN_LIMIT, "qemu-system-arm", "-machine", MACHINE, "-display", "none", "-monitor", "none"])
        .args(["-serial", "none", "-chardev", "stdio,id=host"])
        .args(["-semihosting-config", "enable=on,target=native,chardev=host", "-kernel"])
        .arg(&path);
    let printed = run::output(&mut emulator)?;
    Ok((usage, understand(&printed).with_context(|| format!("the image printed `{printed}`"))?))
}

/// The numbers that the image prints.
fn understand(printed: &str) -> Result<Run> {
    let number = |name: &str| -> Result<u32> {
        let line = printed.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        Ok(u32::from_str_radix(line.with_context(|| format!("there is no {name}"))?.trim(), 16)?)
    };
    Ok(Run { stack: number("stack")?, answers: number("answers")?, requests: number("requests")? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_images_words_are_understood() {
        let run = understand("stack 00000090\nanswers 00000015\nrequests 00000016\n").unwrap();
        assert_eq!(run, Run { stack: 0x90, answers: 21, requests: 22 });
        assert!(understand("").is_err());
    }
}
