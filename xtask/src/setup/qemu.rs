//! QEMU: the one that is named, the one in `PATH`, or the system's package, whichever the plugin works in first.

use std::env;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, anyhow};

use super::advice::Advice;
use super::packages::{self, Source};
use super::toolbox::Toolbox;
use crate::run;

const PROGRAM: &str = "qemu-system-arm";

/// Names the QEMU to use, for xtask and for everything that it starts.
pub(crate) const CHOICE: &str = "JOINTBUS_QEMU";

/// A second, on a machine that has nothing else to do.
const SELF_TEST_LIMIT: Duration = Duration::from_secs(60);

const ADVICE: Advice = Advice {
    what: "qemu-system-arm 7.2 or newer, built with loadable modules (as distributions do)",
    purpose: "the emulated board; `cargo xtask demo --in-process` does without",
    debian: "sudo apt-get install qemu-system-arm",
    fedora: "sudo dnf install qemu-system-arm",
    arch: "sudo pacman -S qemu-system-arm",
    macos: "no QEMU that the plugin works in; use Linux, or `cargo xtask demo --in-process`",
};

/// The oldest and the newest release that the plugin is tested with, and Debian's suites that have them.
const ENDS: [(&str, Source); 2] =
    [("7.2", Source::Debian(&["bookworm"])), ("10.0", Source::Debian(&["bookworm", "bookworm-backports"]))];

/// A QEMU in which the plugin has passed its self-test.
pub(crate) fn ensure(toolbox: &Toolbox, plugin: &Path) -> Result<PathBuf> {
    find(toolbox, plugin).map_err(|error| error.context(ADVICE))
}

fn find(toolbox: &Toolbox, plugin: &Path) -> Result<PathBuf> {
    if let Some(chosen) = env::var_os(CHOICE).filter(|chosen| !chosen.is_empty()) {
        let chosen = PathBuf::from(chosen);
        works(&chosen, plugin).with_context(|| format!("{CHOICE} names {}", chosen.display()))?;
        return Ok(chosen);
    }
    let system = match toolbox.find(PROGRAM) {
        Some(path) => works(&path, plugin).map(|()| path),
        None => Err(anyhow!("{PROGRAM} is not in PATH")),
    };
    let reason = match system {
        Ok(path) => return Ok(path),
        Err(reason) => reason,
    };
    unpacked(toolbox, "qemu", Source::System, plugin)
        .with_context(|| format!("{reason:#}, and the system's package is no way out"))
}

/// The releases at both ends of those that are tested, each with its name.
pub(crate) fn ends(toolbox: &Toolbox, plugin: &Path) -> Result<Vec<(&'static str, PathBuf)>> {
    let found = ensure(toolbox, plugin)?;
    let found_is = run::output(Command::new(&found).arg("--version"))?;
    let end = |(release, source): (&'static str, Source)| -> Result<(&'static str, PathBuf)> {
        if found_is.contains(&format!("version {release}.")) {
            return Ok((release, found.clone()));
        }
        let program = unpacked(toolbox, &format!("qemu-{release}"), source, plugin).with_context(|| {
            format!(
                "missing: QEMU {release}, for the tests that touch its internals\n  \
                 Debian:    it is unpacked from the suite that has it\n  \
                 elsewhere: run the tests on Debian, or leave this step out"
            )
        })?;
        Ok((release, program))
    };
    ENDS.into_iter().map(end).collect()
}

/// The one of a package, beside the system.
fn unpacked(toolbox: &Toolbox, name: &str, source: Source, plugin: &Path) -> Result<PathBuf> {
    let root = packages::unpack(toolbox, name, source, &[PROGRAM])?;
    let firmware = root.join("usr/share/qemu");
    let arguments = [OsStr::new("-L"), firmware.as_os_str()];
    let wrapper = if name == "qemu" { PROGRAM.to_owned() } else { format!("{PROGRAM}-{name}") };
    let program = toolbox.wrap(&wrapper, &root, &root.join("usr/bin").join(PROGRAM), &[], &arguments)?;
    works(&program, plugin)?;
    Ok(program)
}

/// Runs the plugin's self-test.
fn works(program: &Path, plugin: &Path) -> Result<()> {
    let plugin = format!("{},selftest=only", plugin.to_string_lossy().replace(',', ",,"));
    let mut command = Command::new(program);
    command.args(["-M", "netduinoplus2", "-display", "none", "-monitor", "none", "-serial", "null", "-S"]);
    run::quiet(command.args(["-plugin", &plugin]), SELF_TEST_LIMIT)
}
