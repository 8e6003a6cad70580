//! The library that the general server is compared with.

use std::process::Command;

use anyhow::{Context, Result, ensure};

use super::advice::Advice;
use super::packages::{self, Source};
use super::toolbox::{Toolbox, library_path};
use crate::run;

const PACKAGE: &str = "libmodbus-dev";
const ADVICE: Advice = Advice {
    what: "libmodbus 3.1 with its development files",
    purpose: "the comparison with our Modbus server",
    debian: "sudo apt-get install libmodbus-dev",
    fedora: "sudo dnf install libmodbus-devel",
    arch: "sudo pacman -S libmodbus",
    macos: "brew install libmodbus",
};

/// Where the library is, for those who link against it and run with it.
#[derive(Clone, Debug)]
pub(crate) struct Libmodbus {
    /// Folders of libraries, one behind the other; nothing where the linker finds it by itself.
    folders: Option<String>,
}

impl Libmodbus {
    /// Has a command, and what it starts, find the library.
    pub(crate) fn tell(&self, command: &mut Command) {
        if let Some(folders) = &self.folders {
            command.env("LIBRARY_PATH", folders).env("LD_LIBRARY_PATH", folders);
        }
    }
}

/// The system's, or one that is unpacked beside it.
pub(crate) fn ensure(toolbox: &Toolbox) -> Result<Libmodbus> {
    let system = Libmodbus { folders: None };
    if links(&system) {
        return Ok(system);
    }
    unpacked(toolbox).context(ADVICE)
}

fn unpacked(toolbox: &Toolbox) -> Result<Libmodbus> {
    let root = packages::unpack(toolbox, "libmodbus", Source::System, &[PACKAGE])?;
    let library = Libmodbus { folders: Some(library_path(&root)) };
    ensure!(links(&library), "{PACKAGE} is unpacked, but the linker does not find the library");
    Ok(library)
}

/// Whether a program can be linked against it.
fn links(library: &Libmodbus) -> bool {
    let Ok(folder) = tempfile::tempdir() else { return false };
    let mut command = Command::new("cc");
    command.args(["-shared", "-o"]).arg(folder.path().join("probe")).args(["-Wl,--no-as-needed", "-lmodbus"]);
    library.tell(&mut command);
    run::output(&mut command).is_ok()
}
