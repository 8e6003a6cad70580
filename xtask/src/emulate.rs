//! The image in the emulator, with its ports as TCP sockets.

use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::Command;

use anyhow::{Result, ensure};
use clap::Args;

use crate::progress::Plan;
use crate::workspace::Workspace;
use crate::{firmware, run, setup};

/// The package of the emulator's plugin; its library is called the same with underscores.
const PLUGIN_PACKAGE: &str = "jointbus-emulator";

/// The package whose programs run the emulator.
const HARNESS_PACKAGE: &str = "jointbus-host-tests";

/// Where the ports of the emulated part can be reached.
#[derive(Args)]
pub(crate) struct Ports {
    /// Address of the host port, e.g. 127.0.0.1:5020
    #[arg(long, value_name = "ADDRESS")]
    host: SocketAddr,
    /// Address of the first RS-485 port
    #[arg(long, value_name = "ADDRESS")]
    rs485_a: SocketAddr,
    /// Address of the second RS-485 port
    #[arg(long, value_name = "ADDRESS")]
    rs485_b: SocketAddr,
    /// Address of the CAN port
    #[arg(long, value_name = "ADDRESS")]
    can: SocketAddr,
    /// Address of the console that makes faults and drives pins; emulator/README.md lists its lines
    #[arg(long, value_name = "ADDRESS")]
    control: Option<SocketAddr>,
    /// Stop after this many seconds instead of at Ctrl-C
    #[arg(long)]
    seconds: Option<u64>,
}

/// Builds what is needed and runs it.
pub(crate) fn emulate(workspace: &Workspace, ports: &Ports) -> Result<()> {
    let parts = prepare(workspace)?;
    let mut command = harness(workspace, "emulate", ports.seconds);
    parts.tell(&mut command);
    let addresses = [
        ("--host", ports.host),
        ("--rs485-a", ports.rs485_a),
        ("--rs485-b", ports.rs485_b),
        ("--can", ports.can),
    ];
    for (name, address) in addresses.into_iter().chain(ports.control.map(|address| ("--control", address))) {
        command.args([name, &address.to_string()]);
    }
    run::shown(&mut command)
}

/// What the harness's programs need to run the image.
pub(crate) struct Parts {
    image: PathBuf,
    emulator: setup::Emulator,
}

impl Parts {
    /// Tells a program of the harness.
    pub(crate) fn tell(&self, command: &mut Command) {
        self.emulator.tell(command);
        command.arg("--image").arg(&self.image).arg("--plugin").arg(&self.emulator.plugin);
    }
}

/// Sets up and builds all of it, step by step.
pub(crate) fn prepare(workspace: &Workspace) -> Result<Parts> {
    let mut plan = Plan::new(&[15, 60, 45, 40]);
    plan.step("the toolchain for the microcontroller");
    setup::toolchain(workspace)?;
    plan.step("the emulator and its plugin");
    let emulator = setup::emulator(workspace)?;
    plan.step("the firmware image");
    let image = firmware::build(workspace)?.elf;
    plan.step("the program that runs it");
    Ok(Parts { image, emulator })
}

/// Builds the plugin; the answer is its library.
pub(crate) fn build_plugin(workspace: &Workspace) -> Result<PathBuf> {
    run::shown(workspace.cargo().args(["build", "--release", "--package", PLUGIN_PACKAGE]))?;
    let name = format!("{DLL_PREFIX}{}{DLL_SUFFIX}", PLUGIN_PACKAGE.replace('-', "_"));
    let library = workspace.target.join("release").join(name);
    ensure!(library.exists(), "{PLUGIN_PACKAGE} was built, but there is no {}", library.display());
    Ok(library)
}

/// `cargo run` of a program of the harness, its own arguments still to come.
pub(crate) fn harness(workspace: &Workspace, program: &str, seconds: Option<u64>) -> Command {
    let mut command = workspace.cargo();
    command.args(["run", "--release", "--package", HARNESS_PACKAGE, "--bin", program, "--"]);
    if let Some(seconds) = seconds {
        command.args(["--seconds", &seconds.to_string()]);
    }
    command
}
