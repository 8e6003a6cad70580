//! Something to watch: a host talks through the bridge to simulated devices.

use std::path::PathBuf;

use anyhow::Result;

use crate::workspace::Workspace;
use crate::{emulate, firmware, run, setup};

/// Runs the demonstration on the emulated part; where there can be no emulator, says so and runs it in one process.
pub(crate) fn demo(workspace: &Workspace, seconds: Option<u64>) -> Result<()> {
    let mut command = emulate::harness(workspace, "demo", seconds);
    match prepare(workspace) {
        Ok(plugin) => {
            // An image that does not build is our mistake, and nothing to step aside for.
            let image = firmware::build(workspace)?;
            command.arg("--image").arg(image.elf).arg("--plugin").arg(plugin);
        }
        Err(reason) => {
            println!("demo: the firmware image cannot be emulated here: {}", run::explain(&reason));
            println!("demo: so the bridge's engine runs in this process, without the image");
            command.arg("--in-process");
        }
    }
    run::shown(&mut command)
}

/// What the emulation needs beside the image; the answer is the plugin.
fn prepare(workspace: &Workspace) -> Result<PathBuf> {
    setup::toolchain(workspace)?;
    setup::emulator()?;
    emulate::build_plugin(workspace)
}
