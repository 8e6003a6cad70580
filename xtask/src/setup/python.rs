//! A virtual environment with the Python packages that the tests use as real masters.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail, ensure};

use super::advice::Advice;
use super::packages::{self, Source};
use super::toolbox::{Toolbox, library_path};
use crate::progress;
use crate::run;
use crate::workspace::Workspace;

/// A few wheels of some hundred kilobytes.
const INSTALL_LIMIT: Duration = Duration::from_secs(600);
/// What that takes on a common line.
const EXPECTED: Duration = Duration::from_secs(20);

/// The packages with their versions.
const REQUIREMENTS: &str = include_str!("../../requirements.txt");

/// The system's Python, for when the first one in `PATH` is another one that cannot make virtual environments.
const SYSTEM_PYTHON: &str = "/usr/bin/python3";

const ADVICE: Advice = Advice {
    what: "Python 3.10 or newer with its venv module",
    purpose: "the tests with real clients",
    debian: "sudo apt-get install python3-venv",
    fedora: "sudo dnf install python3",
    arch: "sudo pacman -S python",
    macos: "brew install python",
};

/// A Python, and what it takes to start it.
struct Python {
    program: PathBuf,
    /// Its libraries, where they are not the system's.
    root: Option<PathBuf>,
    /// A wheel of pip, for a Python that has none to put into a new environment.
    pip: Option<PathBuf>,
}

impl Python {
    fn command(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        if let Some(root) = &self.root {
            command.env("LD_LIBRARY_PATH", library_path(root));
        }
        command
    }
}

/// Makes the environment, or makes it anew when the list of packages has changed; the answer is its Python.
pub(crate) fn ensure(workspace: &Workspace, toolbox: &Toolbox) -> Result<PathBuf> {
    let folder = workspace.target.join("venv");
    // Written last, so that an installation that was interrupted is not taken for a whole one.
    let stamp = folder.join("installed-requirements.txt");
    let unchanged = fs::read_to_string(&stamp).is_ok_and(|installed| installed == REQUIREMENTS);
    // The Python that the environment was made with may be gone since.
    let program = folder.join("jointbus-python");
    if unchanged && works(&program) {
        return Ok(program);
    }
    let base = base_python(toolbox).context(ADVICE)?;
    let what = format!("installing {} into {}", names(REQUIREMENTS).join(", "), toolbox.shown(&folder));
    progress::during(&what, EXPECTED, || make(workspace, toolbox, &base, &folder))?;
    ensure!(works(&program), "{} has been made and does not work", program.display());
    fs::write(&stamp, REQUIREMENTS).with_context(|| format!("cannot write {}", stamp.display()))?;
    Ok(program)
}

/// Makes the environment.
fn make(workspace: &Workspace, toolbox: &Toolbox, base: &Python, folder: &Path) -> Result<()> {
    let mut command = base.command(&base.program);
    command.args(["-m", "venv", "--clear"]);
    if base.pip.is_some() {
        command.arg("--without-pip");
    }
    run::quiet(command.arg(folder), INSTALL_LIMIT)?;
    let python = folder.join("bin").join("python");
    let mut command = base.command(&python);
    match &base.pip {
        Some(wheel) => command.arg(wheel.join("pip")),
        None => command.args(["-m", "pip"]),
    };
    command.args(["install", "--disable-pip-version-check", "--requirement"]);
    run::quiet(command.arg(workspace.root.join("xtask").join("requirements.txt")), INSTALL_LIMIT)?;
    match &base.root {
        Some(root) => {
            let wrapped = toolbox.wrap("jointbus-python", root, &python, &[], &[])?;
            fs::rename(wrapped, folder.join("jointbus-python")).context("cannot move a script")
        }
        None => link(&python, &folder.join("jointbus-python")),
    }
}

/// A second name for the environment's Python, which must find the environment by the first one.
fn link(python: &Path, name: &Path) -> Result<()> {
    let script = format!("#!/bin/sh\nexec {} \"$@\"\n", run::quoted(&python.to_string_lossy()));
    super::toolbox::write_script(name, &script)
}

fn works(python: &Path) -> bool {
    run::output(Command::new(python).args(["-c", "import pymodbus, serial, can"])).is_ok()
}

/// A Python that can make virtual environments: the system's, with the help of a wheel of pip where it lacks one, or one
/// that is unpacked beside it.
fn base_python(toolbox: &Toolbox) -> Result<Python> {
    let candidates: Vec<PathBuf> =
        toolbox.find("python3").into_iter().chain([SYSTEM_PYTHON.into()]).collect();
    let found = |modules: &str| candidates.iter().find(|python| has(python, modules)).cloned();
    if let Some(program) = found("ensurepip, venv") {
        return Ok(Python { program, root: None, pip: None });
    }
    let system = found("venv, zipimport");
    let package = if system.is_some() { "python3-pip-whl" } else { "python3" };
    let reason = anyhow!("no Python in PATH can make virtual environments");
    let root = packages::unpack(toolbox, "python", Source::System, &[package, "python3-pip-whl"])
        .with_context(|| format!("{reason}, and none can be unpacked"))?;
    let pip = Some(wheel(&root)?);
    Ok(match system {
        Some(program) => Python { program, root: None, pip },
        None => Python { program: root.join("usr/bin/python3"), root: Some(root), pip },
    })
}

/// The wheel that Debian puts into new environments.
fn wheel(root: &Path) -> Result<PathBuf> {
    let folder = root.join("usr/share/python-wheels");
    let entries = fs::read_dir(&folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let wheels = entries.flatten().map(|entry| entry.path());
    let is_pip =
        |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("pip-"));
    match wheels.into_iter().find(is_pip) {
        Some(wheel) => Ok(wheel),
        None => bail!("there is no pip in {}", folder.display()),
    }
}

/// Whether a Python is new enough and has these modules. Debian ships it without `ensurepip`, and then `-m venv` fails
/// halfway.
fn has(python: &Path, modules: &str) -> bool {
    let check = format!("import {modules}, sys; sys.exit(sys.version_info < (3, 10))");
    run::output(Command::new(python).args(["-c", &check])).is_ok()
}

/// The names in a list of requirements.
fn names(requirements: &str) -> Vec<&str> {
    let lines = requirements.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    lines.map(|line| line.split_once("==").map_or(line, |(name, _version)| name)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_package_is_pinned() {
        let lines = REQUIREMENTS.lines().filter(|line| !line.is_empty() && !line.starts_with('#'));
        for line in lines {
            assert!(line.contains("=="), "{line}");
        }
    }

    #[test]
    fn names_are_told_from_comments_and_versions() {
        assert_eq!(names("# why\n\none==1.0\ntwo\n"), ["one", "two"]);
    }
}
