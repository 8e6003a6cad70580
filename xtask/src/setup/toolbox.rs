//! The folder of tools in the build directory, and the programs of the system.

use std::env;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};

use crate::run;
use crate::workspace::Workspace;

/// Where set-up looks for programs, and where it puts those that are missing.
pub(crate) struct Toolbox {
    /// Where everything goes that set-up brings.
    pub(crate) folder: PathBuf,
    /// The system's programs, as in `PATH`.
    pub(crate) path: OsString,
    /// What is left out of a path that is shown.
    root: PathBuf,
}

impl Toolbox {
    /// The one of the workspace, with the programs that `PATH` leads to.
    pub(crate) fn new(workspace: &Workspace) -> Self {
        let path = env::var_os("PATH").unwrap_or_default();
        Self { folder: workspace.target.join("tools"), path, root: workspace.root.clone() }
    }

    /// Another folder, another system.
    #[cfg(test)]
    pub(crate) fn fake(folder: &Path, path: impl Into<OsString>) -> Self {
        Self { folder: folder.to_path_buf(), path: path.into(), root: folder.to_path_buf() }
    }

    /// Where a program of the system is, if it is.
    pub(crate) fn find(&self, program: &str) -> Option<PathBuf> {
        run::find_in(&self.path, program)
    }

    /// A program of the system.
    pub(crate) fn command(&self, program: &str) -> Result<Command> {
        let path = self.find(program).with_context(|| format!("there is no {program} here"))?;
        let mut command = Command::new(path);
        // Messages are read.
        command.env("PATH", &self.path).env("LC_ALL", "C");
        Ok(command)
    }

    /// The folder of the programs that set-up has brought, each by its name.
    pub(crate) fn programs(&self) -> PathBuf {
        self.folder.join("bin")
    }

    /// A path without the part that everybody knows.
    pub(crate) fn shown(&self, path: &Path) -> String {
        path.strip_prefix(&self.root).unwrap_or(path).display().to_string()
    }

    /// Makes an unpacked program one that can be called from anywhere by its name: a script that names its libraries.
    pub(crate) fn wrap(
        &self,
        name: &str,
        root: &Path,
        program: &Path,
        variables: &[(&str, PathBuf)],
        arguments: &[&OsStr],
    ) -> Result<PathBuf> {
        let mut script = String::from(
            "#!/bin/sh\n# Made by `cargo xtask`: the unpacked program with its own libraries.\n",
        );
        let mut export = |name: &str, value: &str| {
            script.push_str(&format!("export {name}={}\n", run::quoted(value)));
        };
        for (name, value) in variables {
            export(name, &value.to_string_lossy());
        }
        export("LD_LIBRARY_PATH", &library_path(root));
        script.push_str(&format!("exec {}", run::quoted(&program.to_string_lossy())));
        for argument in arguments {
            script.push_str(&format!(" {}", run::quoted(&argument.to_string_lossy())));
        }
        script.push_str(" \"$@\"\n");
        let folder = self.programs();
        fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
        let path = folder.join(name);
        write_script(&path, &script)?;
        Ok(path)
    }
}

/// Writes a program for the shell, in one step: another process may be starting the former one.
pub(crate) fn write_script(path: &Path, script: &str) -> Result<()> {
    let draft = path.with_extension("new");
    fs::write(&draft, script).with_context(|| format!("cannot write {}", draft.display()))?;
    make_executable(&draft)?;
    fs::rename(&draft, path).with_context(|| format!("cannot write {}", path.display()))
}

/// The folders of an unpacked system that hold libraries, as `LD_LIBRARY_PATH` lists them.
pub(crate) fn library_path(root: &Path) -> String {
    library_folders(root).iter().map(|folder| folder.to_string_lossy()).collect::<Vec<_>>().join(":")
}

/// `/lib`, `/usr/lib` and their folders for a processor.
pub(crate) fn library_folders(root: &Path) -> Vec<PathBuf> {
    let mut folders = Vec::new();
    for base in [root.join("usr/lib"), root.join("lib")] {
        let Ok(entries) = fs::read_dir(&base) else { continue };
        let triplets = entries.flatten().map(|entry| entry.path());
        folders
            .extend(triplets.filter(|path| path.is_dir() && path.to_string_lossy().contains("-linux-gnu")));
        folders.push(base);
    }
    folders
}

#[cfg(unix)]
fn make_executable(path: &Path) -> Result<()> {
    use std::os::unix::fs::PermissionsExt;
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).context("cannot make a script executable")
}

#[cfg(not(unix))]
fn make_executable(_: &Path) -> Result<()> {
    Ok(())
}
