//! Set-up: every command asks here for what it needs. What is there and works is used without a word; what is missing is
//! brought into the build directory, with its progress shown; where that is not possible the error names what to install.
//! Nothing is skipped, nothing is installed in the system, nothing needs root.

mod advice;
mod components;
#[cfg(all(test, unix))]
mod fake;
mod libmodbus;
pub(crate) mod nightly;
mod packages;
mod python;
mod qemu;
mod target;
mod toolbox;
mod tools;

use std::env;
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

use anyhow::Result;

pub(crate) use self::libmodbus::Libmodbus;
pub(crate) use self::target::{TARGET, TARGETS, Toolchain};
use self::toolbox::Toolbox;
use crate::emulate;
use crate::workspace::Workspace;

/// Everything at once.
pub(crate) fn all(workspace: &Workspace) -> Result<()> {
    components(workspace)?;
    toolchain(workspace)?;
    emulator(workspace)?;
    emulators(workspace)?;
    clients(workspace)?;
    libmodbus(workspace)?;
    valgrind(workspace)?;
    nightly::fuzzer(workspace)?;
    nightly::miri(workspace)?;
    Ok(())
}

/// `cargo fmt` and `cargo clippy`.
pub(crate) fn components(workspace: &Workspace) -> Result<()> {
    components::ensure(workspace)
}

/// A toolchain that builds for the bare-metal target.
pub(crate) fn toolchain(workspace: &Workspace) -> Result<Toolchain> {
    target::ensure(workspace)
}

/// QEMU and the plugin that works in it.
#[derive(Clone, Debug)]
pub(crate) struct Emulator {
    pub(crate) qemu: PathBuf,
    pub(crate) plugin: PathBuf,
}

impl Emulator {
    /// Has a command, and what it starts, use this QEMU.
    pub(crate) fn tell(&self, command: &mut Command) {
        command.env(qemu::CHOICE, &self.qemu);
    }
}

/// The emulator, its plugin built and tested in it.
pub(crate) fn emulator(workspace: &Workspace) -> Result<Emulator> {
    static FOUND: OnceLock<Emulator> = OnceLock::new();
    if let Some(found) = FOUND.get() {
        return Ok(found.clone());
    }
    let plugin = emulate::build_plugin(workspace)?;
    let qemu = qemu::ensure(&Toolbox::new(workspace), &plugin)?;
    Ok(FOUND.get_or_init(|| Emulator { qemu, plugin }).clone())
}

/// The oldest and the newest QEMU that the plugin is made for, by their releases.
pub(crate) fn emulators(workspace: &Workspace) -> Result<Vec<(&'static str, Emulator)>> {
    let plugin = emulate::build_plugin(workspace)?;
    let ends = qemu::ends(&Toolbox::new(workspace), &plugin)?;
    Ok(ends.into_iter().map(|(release, qemu)| (release, Emulator { qemu, plugin: plugin.clone() })).collect())
}

/// The programs and Python packages that the tests use as real masters; the answer is the Python that has them.
pub(crate) fn clients(workspace: &Workspace) -> Result<PathBuf> {
    let toolbox = Toolbox::new(workspace);
    tools::ensure(&toolbox, &[tools::MBPOLL, tools::SOCAT])?;
    python::ensure(workspace, &toolbox)
}

/// The program that counts instructions on the host.
pub(crate) fn valgrind(workspace: &Workspace) -> Result<()> {
    tools::ensure(&Toolbox::new(workspace), &[tools::VALGRIND])
}

/// The program that makes bare systems.
pub(crate) fn debootstrap(workspace: &Workspace) -> Result<Command> {
    let toolbox = Toolbox::new(workspace);
    tools::ensure(&toolbox, &[tools::DEBOOTSTRAP])?;
    let mut command = Command::new("env");
    tell_programs(workspace, &mut command);
    command.arg(tools::DEBOOTSTRAP.program);
    Ok(command)
}

/// The mirror of Debian that this system is installed from.
pub(crate) fn debian_mirror(workspace: &Workspace) -> Result<String> {
    packages::debian_mirror(&Toolbox::new(workspace))
}

/// The library that the general server is compared with.
pub(crate) fn libmodbus(workspace: &Workspace) -> Result<Libmodbus> {
    libmodbus::ensure(&Toolbox::new(workspace))
}

/// Has a command, and what it starts, find the programs that set-up has brought before those of the system.
pub(crate) fn tell_programs(workspace: &Workspace, command: &mut Command) {
    let folders = [Toolbox::new(workspace).programs()].into_iter();
    let path = env::var_os("PATH").unwrap_or_default();
    if let Ok(path) = env::join_paths(folders.chain(env::split_paths(&path))) {
        command.env("PATH", path);
    }
}
