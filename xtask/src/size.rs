//! What the bridge's image takes, and what a server or a dispatcher costs: the benchmark's images with and without it,
//! measured and run in the emulator.

use std::fs;

use anyhow::{Context, Result, ensure};

use crate::bench::{Figures, m4};
use crate::setup::{self, TARGET};
use crate::workspace::Workspace;
use crate::{contributors, firmware, run, test};

/// The test that paints the image's stack and prints how much of it was used.
const PAINTED: &str = "resets::no_request_uses_more_stack_than_there_is";

/// What is measured: the image of the benchmark, and what it is.
const SUBJECTS: [(&str, &str); 6] = [
    ("server", "general Modbus RTU server, CRC table of 512 bytes"),
    ("server_small", "the same, CRC table of 32 bytes"),
    ("server_bitwise", "the same, no CRC table"),
    ("nst", "NST dispatcher, serial"),
    ("nxi", "NXI-6201 dispatcher"),
    ("ndam", "NDAM-9010 dispatcher, a station of one module"),
];

/// Measures all and prints a table.
pub(crate) fn size(workspace: &Workspace) -> Result<()> {
    setup::emulator(workspace)?;
    image(workspace)?;
    let (profile, place) = m4::PROFILES[0];
    let mut figures = Figures::default();
    m4::measure_some(workspace, &SUBJECTS.map(|(image, _)| image), false, (profile, place), &mut figures)?;
    println!("{TARGET}, profile {profile} (opt-level s, fat LTO), in bytes:\n");
    println!("{:<50} {:>6} {:>10} {:>6} {:>6}", "", "flash", "static RAM", "state", "stack");
    for (image, about) in SUBJECTS {
        let figure = |what| figures.get(place, image, what);
        let (flash, ram, state, stack) =
            (figure("flash")?, figure("static RAM")?, figure("state")?, figure("stack")?);
        println!("{about:<50} {flash:>6} {ram:>10} {state:>6} {stack:>6}");
    }
    println!(
        "\nflash, static RAM: the image less an image without a server; tables of constants included.\n\
         state: what the server or device is itself, its registers included.\n\
         stack: the deepest that was seen in the emulator over the longest reads and writes among others, on a\n\
         painted stack; no bound, but what was used. Interrupts come on top. Below 64 it cannot see."
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
    let emulator = setup::emulator(workspace)?;
    let mut command = workspace.cargo();
    emulator.tell(&mut command);
    command.env(test::IMAGE, &image.elf).env(test::PLUGIN, emulator.plugin);
    command.args(["test", "--package", "jointbus-host-tests", "--test", "image", "--", "--exact", PAINTED]);
    let printed = run::output(command.arg("--nocapture"))?;
    let used = printed
        .lines()
        .find_map(|line| line.split_once(" of ").filter(|(_, rest)| rest.ends_with(" bytes of stack used")));
    let (used, _) = used.with_context(|| format!("{PAINTED} printed `{printed}`"))?;
    Ok(used.trim_start_matches(|character: char| !character.is_ascii_digit()).parse()?)
}
