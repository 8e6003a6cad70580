//! Programs: the system's where they work, else unpacked from its packages.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};

use super::advice::Advice;
use super::packages::{self, Source};
use super::toolbox::Toolbox;
use crate::run;

/// A program that says its version takes no time; valgrind's check runs another program under it.
const CHECK_LIMIT: Duration = Duration::from_secs(60);

/// A program, and how to get it.
#[derive(Clone, Copy)]
pub(crate) struct Tool {
    /// The name in `PATH`.
    pub(crate) program: &'static str,
    /// Arguments with which it succeeds where it works.
    check: &'static [&'static str],
    /// Debian's and Ubuntu's package. A tool without one belongs to the compiler, which people choose themselves.
    package: Option<&'static str>,
    /// Where the package has the program itself.
    unpacked: &'static str,
    /// Folders of the package that the program is told of by variables.
    folders: &'static [(&'static str, &'static str)],
    advice: Advice,
}

#[cfg(test)]
impl Tool {
    /// A program that needs no more than to be there.
    pub(crate) const fn example(program: &'static str, package: Option<&'static str>) -> Self {
        Self { program, package, check: &[], unpacked: "usr/bin/a-program-that-nobody-has", ..SOCAT }
    }
}

/// A Modbus master on the command line.
pub(crate) const MBPOLL: Tool = Tool {
    program: "mbpoll",
    check: &["-V"],
    package: Some("mbpoll"),
    unpacked: "usr/bin/mbpoll",
    folders: &[],
    advice: Advice {
        what: "mbpoll, the command-line Modbus master",
        purpose: "the tests with real clients",
        debian: "sudo apt-get install mbpoll",
        fedora: "no package; build mbpoll 1.5 with `sudo dnf install libmodbus-devel cmake gcc`",
        arch: "mbpoll from the AUR, e.g. yay -S mbpoll",
        macos: "brew install mbpoll",
    },
};

/// Joins sockets and pseudo-terminals.
pub(crate) const SOCAT: Tool = Tool {
    program: "socat",
    check: &["-V"],
    package: Some("socat"),
    unpacked: "usr/bin/socat",
    folders: &[],
    advice: Advice {
        what: "socat, the relay between sockets and terminals",
        purpose: "the tests with real clients",
        debian: "sudo apt-get install socat",
        fedora: "sudo dnf install socat",
        arch: "sudo pacman -S socat",
        macos: "brew install socat",
    },
};

/// Counts the instructions of a program.
pub(crate) const VALGRIND: Tool = Tool {
    program: "valgrind",
    check: &["--quiet", "--tool=callgrind", "--callgrind-out-file=/dev/null", "true"],
    package: Some("valgrind"),
    // what Debian has as `valgrind` is a script that looks for this one at its usual place
    unpacked: "usr/bin/valgrind.bin",
    folders: &[("VALGRIND_LIB", "usr/libexec/valgrind")],
    advice: Advice {
        what: "Valgrind with callgrind",
        purpose: "the benchmark, which counts instructions",
        debian: "sudo apt-get install valgrind",
        fedora: "sudo dnf install valgrind",
        arch: "sudo pacman -S valgrind",
        macos: "not available for current releases; run the benchmark on Linux",
    },
};

/// Makes bare systems.
pub(crate) const DEBOOTSTRAP: Tool = Tool {
    program: "debootstrap",
    check: &["--version"],
    package: Some("debootstrap"),
    unpacked: "usr/sbin/debootstrap",
    folders: &[("DEBOOTSTRAP_DIR", "usr/share/debootstrap")],
    advice: Advice {
        what: "debootstrap",
        purpose: "the bare systems on which set-up is tried",
        debian: "sudo apt-get install debootstrap",
        fedora: "sudo dnf install debootstrap",
        arch: "sudo pacman -S debootstrap",
        macos: "not available; use Linux",
    },
};

/// Compiles the fuzzer's runtime.
pub(crate) const CXX: Tool = Tool {
    program: "c++",
    check: &["-x", "c++", "-include", "vector", "-fsyntax-only", "/dev/null"],
    package: None,
    unpacked: "",
    folders: &[],
    advice: Advice {
        what: "a C++ compiler called c++",
        purpose: "the fuzzer",
        debian: "sudo apt-get install g++",
        fedora: "sudo dnf install gcc-c++",
        arch: "sudo pacman -S gcc",
        macos: "xcode-select --install",
    },
};

/// Makes each of the programs one that can be called by its name, if [`Toolbox::programs`] comes first in `PATH`.
pub(crate) fn ensure(toolbox: &Toolbox, tools: &[Tool]) -> Result<()> {
    for tool in tools {
        ensure_one(toolbox, tool).map_err(|error| error.context(tool.advice))?;
    }
    Ok(())
}

fn ensure_one(toolbox: &Toolbox, tool: &Tool) -> Result<()> {
    let own = toolbox.programs().join(tool.program);
    let system = match toolbox.find(tool.program) {
        Some(path) => works(&path, tool),
        None => Err(anyhow!("{} is not in PATH", tool.program)),
    };
    let Err(reason) = system else {
        // One that was brought before must not stand in its way.
        let _ = std::fs::remove_file(own);
        return Ok(());
    };
    if own.exists() && works(&own, tool).is_ok() {
        return Ok(());
    }
    let Some(package) = tool.package else { return Err(reason) };
    let root = packages::unpack(toolbox, tool.program, Source::System, &[package])
        .with_context(|| format!("{reason:#}, and it cannot be unpacked from a package"))?;
    let folders: Vec<_> = tool.folders.iter().map(|(name, folder)| (*name, root.join(folder))).collect();
    let program = root.join(tool.unpacked);
    if !program.exists() {
        bail!("the package {package} has no {}", tool.unpacked);
    }
    let program = toolbox.wrap(tool.program, &root, &program, &folders, &[])?;
    works(&program, tool).context("it was unpacked from its package, but does not work")
}

/// Runs the tool's check.
fn works(program: &Path, tool: &Tool) -> Result<()> {
    run::quiet(Command::new(program).args(tool.check), CHECK_LIMIT)
}
