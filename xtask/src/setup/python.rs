//! A virtual environment with the Python packages that the tests use as real masters.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail};

use super::apt;
use crate::run;
use crate::workspace::Workspace;

/// A few wheels of some hundred kilobytes.
const INSTALL_LIMIT: Duration = Duration::from_secs(600);

/// The packages with their versions.
const REQUIREMENTS: &str = include_str!("../../requirements.txt");

/// The system's Python, for when the first one in `PATH` is another one that cannot make virtual environments.
const SYSTEM_PYTHON: &str = "/usr/bin/python3";

/// Makes the environment, or makes it anew when the list of packages has changed; the answer is its Python.
pub(crate) fn ensure(workspace: &Workspace) -> Result<PathBuf> {
    let folder = workspace.target.join("venv");
    let python = folder.join("bin").join("python");
    // Written last, so that an installation that was interrupted is not taken for a whole one.
    let stamp = folder.join("installed-requirements.txt");
    let unchanged = fs::read_to_string(&stamp).is_ok_and(|installed| installed == REQUIREMENTS);
    // The Python that the environment was made with may be gone since.
    if unchanged && run::output(Command::new(&python).arg("--version")).is_ok() {
        return Ok(python);
    }

    let base = base_python().with_context(|| {
        format!(
            "missing: Python 3.10 or newer with its venv module, for {}\n  \
             Debian and Ubuntu: apt-get install python3-venv\n  \
             elsewhere: Python 3 with venv and ensurepip",
            names(REQUIREMENTS).join(", ")
        )
    })?;
    println!("setup: installing {} into {}", names(REQUIREMENTS).join(", "), folder.display());
    let requirements = workspace.root.join("xtask").join("requirements.txt");
    run::quiet(Command::new(base).args(["-m", "venv", "--clear"]).arg(&folder), INSTALL_LIMIT)?;
    let mut pip = Command::new(&python);
    pip.args(["-m", "pip", "install", "--disable-pip-version-check", "--requirement"]).arg(requirements);
    run::quiet(&mut pip, INSTALL_LIMIT)?;
    fs::write(&stamp, REQUIREMENTS).with_context(|| format!("cannot write {}", stamp.display()))?;
    Ok(python)
}

/// A Python that can make virtual environments.
fn base_python() -> Result<&'static Path> {
    let candidates = [Path::new("python3"), Path::new(SYSTEM_PYTHON)];
    if let Some(python) = candidates.into_iter().find(|python| can_make_environments(python)) {
        return Ok(python);
    }
    apt::install(&["python3-venv"])?;
    match candidates.into_iter().find(|python| can_make_environments(python)) {
        Some(python) => Ok(python),
        None => bail!("python3-venv is installed, but neither python3 nor {SYSTEM_PYTHON} can use it"),
    }
}

/// Debian ships Python without `ensurepip`, and then `-m venv` fails halfway.
fn can_make_environments(python: &Path) -> bool {
    let check = "import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 10))";
    run::output(Command::new(python).args(["-c", check])).is_ok()
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
