//! Which lines of source the instructions are from.

use std::collections::BTreeMap;
use std::path::Path;

use addr2line::Loader;
use anyhow::{Result, anyhow};

use crate::trace::{Profile, Profiles};

/// Lines shown of each.
const SHOWN: usize = 30;

/// Folders of the project's own code: an inlined function of a library counts for the line that calls it.
const OWN: [&str; 2] = ["mcu-bridge/src/", "protocol/src/"];

/// Prints the lines of source that take most instructions.
pub(crate) fn show(image: &Path, profiles: &Profiles) -> Result<()> {
    let loader = Loader::new(image).map_err(|error| anyhow!("{}: {error}", image.display()))?;
    let all = [
        ("a received byte", &profiles.received_byte),
        ("a request", &profiles.request),
        ("a reply", &profiles.reply),
        ("an idle turn", &profiles.idle_turn),
    ];
    for (name, profile) in all {
        let lines = lines(&loader, profile)?;
        let total: f64 = lines.iter().map(|(_, instructions)| instructions).sum();
        println!("{name}: {total:.0} instructions on average");
        for (line, instructions) in lines.iter().take(SHOWN) {
            println!("{instructions:>8.1} {line}");
        }
    }
    Ok(())
}

/// Lines and their instructions, most first.
fn lines(loader: &Loader, profile: &Profile) -> Result<Vec<(String, f64)>> {
    let mut sums = BTreeMap::<String, f64>::new();
    for (address, share) in profile.shares() {
        *sums.entry(line(loader, address)?).or_default() += share;
    }
    let mut lines: Vec<_> = sums.into_iter().collect();
    lines.sort_by(|(_, a), (_, b)| b.total_cmp(a));
    Ok(lines)
}

/// The innermost line of the project's own code, else the innermost of all.
fn line(loader: &Loader, address: u32) -> Result<String> {
    let fail = |error| anyhow!("{address:#x}: {error}");
    let mut frames = loader.find_frames(address.into()).map_err(fail)?;
    let mut innermost = None;
    while let Some(frame) = frames.next().map_err(|error| anyhow!("{address:#x}: {error}"))? {
        let Some(location) = frame.location else { continue };
        let (file, line) = (location.file.unwrap_or("?"), location.line.unwrap_or(0));
        let own = OWN.iter().find_map(|folder| Some(&file[file.find(folder)?..]));
        if let Some(own) = own {
            return Ok(format!("{own}:{line}"));
        }
        // enough to find it by
        let short = file.rsplitn(4, '/').take(3).collect::<Vec<_>>().into_iter().rev().collect::<Vec<_>>();
        innermost.get_or_insert_with(|| format!("{}:{line}", short.join("/")));
    }
    Ok(innermost.unwrap_or_else(|| "?".to_owned()))
}
