//! The firmware's image on the emulated board, each of its ports a TCP server, for any program that wants to talk to
//! it. Prints `ready` on a line of its own once the bridge answers inside. Ends after a time, at Ctrl-C or SIGTERM.

use anyhow::Result;
use clap::Parser;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Runs the firmware on the emulated board, its ports on TCP.
///
/// A port serves one client after another. A client of a serial port has to read what it gets.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// The firmware, as an ELF file
    #[arg(long, value_name = "ELF")]
    image: PathBuf,
    /// The emulator's plugin
    #[arg(long, value_name = "LIBRARY")]
    plugin: PathBuf,
    /// Address of the host port, e.g. 127.0.0.1:5020
    #[arg(long, value_name = "ADDRESS")]
    host: SocketAddr,
    /// Address of the first RS485 port
    #[arg(long, value_name = "ADDRESS")]
    rs485_a: SocketAddr,
    /// Address of the second RS485 port
    #[arg(long, value_name = "ADDRESS")]
    rs485_b: SocketAddr,
    /// Address of the CAN port, which speaks SLCAN
    #[arg(long, value_name = "ADDRESS")]
    can: SocketAddr,
    /// Address of the console that makes faults and drives pins; emulator/README.md lists its lines
    #[arg(long, value_name = "ADDRESS")]
    control: Option<SocketAddr>,
    /// End after this many seconds instead of at Ctrl-C
    #[arg(long)]
    seconds: Option<u64>,
}

#[cfg(unix)]
fn main() -> Result<()> {
    use anyhow::Context;
    use jointbus::bench::START;
    use jointbus::bridge;
    use jointbus::client::{self, Client};
    use jointbus::emulator::{Emulator, Endpoint, Options, Port};
    use std::sync::mpsc::{RecvTimeoutError, channel};
    use std::time::{Duration, Instant};

    /// How often the emulator is asked whether it still runs.
    const TICK: Duration = Duration::from_millis(200);

    let arguments = Arguments::parse();
    let (sender, stop) = channel();
    ctrlc::set_handler(move || {
        // a second signal finds nobody who listens, which is as good
        let _ = sender.send(());
    })
    .context("can't catch Ctrl-C")?;

    let mut options = Options::new(&arguments.image, &arguments.plugin);
    options.usart1 = Endpoint::At(arguments.host);
    options.usart2 = Endpoint::At(arguments.rs485_a);
    options.usart3 = Endpoint::At(arguments.rs485_b);
    options.can = Endpoint::At(arguments.can);
    if let Some(address) = arguments.control {
        options.faults = Endpoint::At(address);
    }
    let mut emulator = Emulator::launch(&options)?;

    let stream = emulator.connect(Port::Usart1)?;
    client::prepare(&stream)?;
    let answered = bridge::wait(&mut Client::new(stream, Duration::from_millis(500)), START);
    emulator.check()?;
    answered.context("the bridge does not answer")?;
    println!("ready");

    let end = arguments.seconds.map(|seconds| Instant::now() + Duration::from_secs(seconds));
    loop {
        let left = end.map_or(TICK, |end| end.saturating_duration_since(Instant::now()).min(TICK));
        match stop.recv_timeout(left) {
            Ok(()) | Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) if end.is_some_and(|end| Instant::now() >= end) => break,
            Err(RecvTimeoutError::Timeout) => emulator.check()?,
        }
    }
    emulator.quit()
}

#[cfg(not(unix))]
fn main() -> Result<()> {
    drop(Arguments::parse());
    anyhow::bail!("there is no emulator for this system")
}
