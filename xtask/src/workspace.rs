//! Where things are: the repository, its build directory, and the cargo that runs this program.

use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};

/// The repository and its build directory, both absolute.
pub(crate) struct Workspace {
    /// The folder of the workspace's `Cargo.toml`.
    pub(crate) root: PathBuf,
    /// Where cargo builds: `CARGO_TARGET_DIR`, or `target` in the repository.
    pub(crate) target: PathBuf,
}

impl Workspace {
    /// Found from the manifest of this crate, so that commands work from any folder of the repository.
    pub(crate) fn locate() -> Result<Self> {
        let manifest = env::var_os("CARGO_MANIFEST_DIR").context("run this program as `cargo xtask`")?;
        let root = Path::new(&manifest).parent().context("xtask has no parent folder")?.to_path_buf();
        let target = match env::var_os("CARGO_TARGET_DIR") {
            Some(directory) => env::current_dir().context("the current folder is gone")?.join(directory),
            None => root.join("target"),
        };
        Ok(Self { root, target })
    }

    /// The cargo that started this program, at work in the repository.
    pub(crate) fn cargo(&self) -> Command {
        self.command(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
    }

    /// Any program, at work in the repository; a cargo that it starts builds where [`Workspace::target`] says.
    pub(crate) fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new(program);
        command.current_dir(&self.root);
        if env::var_os("CARGO_TARGET_DIR").is_some() {
            // It may have been relative to the folder that `cargo xtask` was called from.
            command.env("CARGO_TARGET_DIR", &self.target);
        }
        command
    }
}
