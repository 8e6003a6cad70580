//! Something to watch: a host talks through the bridge to simulated devices.

use anyhow::Result;
use clap::Args;

use crate::workspace::Workspace;
use crate::{emulate, run};

/// How to run the demonstration.
#[derive(Args)]
pub(crate) struct Manner {
    /// Stop after this many seconds; without it, after 10
    #[arg(long)]
    seconds: Option<u64>,
    /// Run the bridge's engine in one process with the devices, without the firmware image
    #[arg(long)]
    in_process: bool,
}

/// Runs the demonstration: on the emulated part, or in one process where that is asked for or where no emulator can be.
pub(crate) fn demo(workspace: &Workspace, manner: &Manner) -> Result<()> {
    let mut command = emulate::harness(workspace, "demo", manner.seconds);
    if manner.in_process || !cfg!(target_os = "linux") {
        command.arg("--in-process");
    } else {
        emulate::prepare(workspace)?.tell(&mut command);
    }
    run::shown(&mut command)
}
