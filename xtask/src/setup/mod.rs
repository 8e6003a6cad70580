//! Set-up: every command asks here for what it needs. What is there is used without a word; what is missing is
//! installed with one line about it; where that is not possible the error names what to install. Nothing is skipped.

mod apt;
mod components;
mod libmodbus;
pub(crate) mod nightly;
mod python;
mod target;
mod tools;

use std::path::PathBuf;

use anyhow::Result;

pub(crate) use self::target::{TARGET, Toolchain};
use crate::workspace::Workspace;

/// Everything at once.
pub(crate) fn all(workspace: &Workspace) -> Result<()> {
    components(workspace)?;
    toolchain(workspace)?;
    emulator()?;
    clients(workspace)?;
    libmodbus()?;
    valgrind()?;
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

/// The emulator.
pub(crate) fn emulator() -> Result<()> {
    tools::ensure(&[tools::QEMU])
}

/// The programs and Python packages that the tests use as real masters; the answer is the Python that has them.
pub(crate) fn clients(workspace: &Workspace) -> Result<PathBuf> {
    tools::ensure(&[tools::MBPOLL, tools::SOCAT])?;
    python::ensure(workspace)
}

/// The program that counts instructions on the host.
pub(crate) fn valgrind() -> Result<()> {
    tools::ensure(&[tools::VALGRIND])
}

/// The library that the general server is compared with.
pub(crate) fn libmodbus() -> Result<()> {
    libmodbus::ensure()
}
