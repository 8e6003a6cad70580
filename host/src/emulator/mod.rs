//! The firmware's image in QEMU, with every port of the board on a TCP socket.
//!
//! [`Emulator::launch`] starts QEMU with the project's plugin, waits until its ports can be connected to, and lets
//! the machine run (or holds it, see [`Options::paused`]). Dropping the [`Emulator`] ends QEMU; so does the end of
//! this process, however it comes.
//!
//! A port serves one connection at a time. What the machine sends while nobody is connected is lost and holds
//! nothing up. **A connected [`Port::Usart1`] has to be read**: after some hundred unread writes QEMU stops the whole
//! machine until they are. [`Emulator::capture`] reads a port into memory. The others never hold the machine up; the
//! plugin drops what a client leaves unread for too long.

mod capture;
mod debugger;
mod monitor;
mod options;
mod process;

pub use capture::Capture;
pub use debugger::Debugger;
pub use options::{Endpoint, Options, QEMU};

use anyhow::{Context, Result, anyhow, bail, ensure};
use monitor::Monitor;
use process::{Messages, start};
use std::fmt;
use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, ExitStatus};
use std::thread;
use std::time::{Duration, Instant};

/// Tries to start QEMU on ports that were free a moment ago.
const ATTEMPTS: usize = 5;
/// Time that QEMU has to end by itself.
const FAREWELL: Duration = Duration::from_secs(5);

/// A way into the emulated board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Port {
    /// USART1: the host.
    Usart1,
    /// USART2: the first RS-485 bus.
    Usart2,
    /// USART3: the second RS-485 bus.
    Usart3,
    /// CAN1, as a serial CAN adapter that speaks SLCAN.
    Can,
    /// The fault console of the plugin.
    Faults,
}

impl Port {
    /// All of them, in the order in which QEMU is told.
    pub const ALL: [Self; 5] = [Self::Usart1, Self::Usart2, Self::Usart3, Self::Can, Self::Faults];

    /// Name of the character device.
    const fn id(self) -> &'static str {
        match self {
            Self::Usart1 => "usart1",
            Self::Usart2 => "usart2",
            Self::Usart3 => "usart3",
            Self::Can => "can0",
            Self::Faults => "canctl",
        }
    }
}

impl fmt::Display for Port {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.id())
    }
}

/// A running QEMU. Dropping it ends QEMU.
#[derive(Debug)]
pub struct Emulator {
    child: Child,
    addresses: [SocketAddr; Port::ALL.len()],
    monitor: Monitor,
    messages: Messages,
    patience: Duration,
    version: String,
}

impl Emulator {
    /// Starts QEMU and waits until its ports can be connected to.
    ///
    /// # Errors
    /// Where QEMU can't be started, ends at once (with what it said), or stays silent.
    pub fn launch(options: &Options) -> Result<Self> {
        for file in [&options.image, &options.plugin] {
            ensure!(file.exists(), "there is no {}", file.display());
        }
        let mut attempt = 1;
        loop {
            match Self::attempt(options) {
                Err(error)
                    if attempt < ATTEMPTS
                        && options.has_free_endpoints()
                        && format!("{error:#}").contains("Address already in use") =>
                {
                    attempt += 1;
                }
                result => return result,
            }
        }
    }

    fn attempt(options: &Options) -> Result<Self> {
        let addresses = options.addresses()?;
        let (ours, theirs) = UnixStream::pair().context("no socket pair for the monitor")?;
        let monitor = theirs.as_raw_fd();
        let (child, messages) = start(options.command(&addresses, monitor), monitor)
            .with_context(|| format!("can't start {}", options.qemu.display()))?;
        // Else the monitor would not close with QEMU.
        drop(theirs);
        let mut emulator = Self {
            child,
            addresses,
            monitor: Monitor::new(ours),
            messages,
            patience: options.patience,
            version: String::new(),
        };
        emulator.greet().map_err(|error| emulator.explain(error))?;
        if !options.paused {
            emulator.resume()?;
        }
        Ok(emulator)
    }

    /// Where a port listens.
    #[must_use]
    pub fn address(&self, port: Port) -> SocketAddr {
        self.addresses[port as usize]
    }

    /// Connects to a port. The connection to USART1 has to be read; see the [module](self).
    ///
    /// # Errors
    /// Where QEMU has ended.
    pub fn connect(&self, port: Port) -> Result<TcpStream> {
        let stream = TcpStream::connect_timeout(&self.address(port), self.patience)
            .with_context(|| format!("can't connect to {port} at {}", self.address(port)))?;
        stream.set_nodelay(true)?;
        Ok(stream)
    }

    /// Connects to a port and keeps all it says.
    ///
    /// # Errors
    /// As [`Self::connect`].
    pub fn capture(&self, port: Port) -> Result<Capture> {
        Capture::new(self.connect(port)?)
    }

    /// Lets a machine that was launched paused run.
    ///
    /// # Errors
    /// Where QEMU has ended or does not answer.
    pub fn resume(&mut self) -> Result<()> {
        self.execute("cont")
    }

    /// Resets the machine; when this returns, the first instruction is still to come or has just been.
    ///
    /// # Errors
    /// Where QEMU has ended or does not answer.
    pub fn reset(&mut self) -> Result<()> {
        let deadline = Instant::now() + self.patience;
        self.monitor.reset(deadline).map_err(|error| self.explain(error))
    }

    /// Gives the fault console a line, as its documentation lists them: `ack 0`, `bus 1`, `err 3`, `lost 1`,
    /// `crystal 0`, `cause pin`, `pin PC0 1`.
    ///
    /// # Errors
    /// Where the console does not answer `ok`.
    pub fn fault(&self, line: &str) -> Result<()> {
        self.ask(line).map(drop)
    }

    /// Asks the fault console, as its documentation lists what can be asked: `level PB5`, `changes PA1`, `sent 2`,
    /// `dac 1`, `pwm 1`.
    ///
    /// # Errors
    /// Where the console does not answer `ok`.
    pub fn ask(&self, line: &str) -> Result<String> {
        let mut console = self.connect(Port::Faults)?;
        console.set_read_timeout(Some(self.patience))?;
        console.write_all(format!("{line}\n").as_bytes())?;
        let mut answer = String::new();
        BufReader::new(&console).read_line(&mut answer).context("the fault console does not answer")?;
        let told = answer.trim_end().strip_prefix("ok");
        Ok(told.with_context(|| format!("the fault console does not know {line:?}"))?.trim_start().to_owned())
    }

    /// Whether QEMU still runs.
    ///
    /// # Errors
    /// Where it has ended, with what it said.
    pub fn check(&mut self) -> Result<()> {
        match self.child.try_wait()? {
            None => Ok(()),
            Some(status) => bail!("QEMU has ended ({status}){}", self.messages.quoted()),
        }
    }

    /// Waits for QEMU to end.
    ///
    /// # Errors
    /// Where the operating system can't say.
    pub fn wait(&mut self) -> Result<ExitStatus> {
        Ok(self.child.wait()?)
    }

    /// What QEMU has said so far, which is nothing as long as all is well.
    #[must_use]
    pub fn messages(&self) -> String {
        self.messages.text()
    }

    /// Release of the running QEMU, such as `7.2.22`.
    #[must_use]
    pub fn version(&self) -> &str {
        &self.version
    }

    /// QEMU's process.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Ends QEMU in order.
    ///
    /// # Errors
    /// Where it doesn't end, or not with success.
    pub fn quit(mut self) -> Result<()> {
        self.execute("quit")?;
        let deadline = Instant::now() + FAREWELL;
        while Instant::now() < deadline {
            if let Some(status) = self.child.try_wait()? {
                ensure!(status.success(), "QEMU ended with {status}{}", self.messages.quoted());
                return Ok(());
            }
            thread::sleep(Duration::from_millis(5));
        }
        bail!("QEMU does not quit");
    }

    fn execute(&mut self, command: &str) -> Result<()> {
        let deadline = Instant::now() + self.patience;
        self.monitor.execute(command, deadline).map_err(|error| self.explain(error))
    }

    /// Takes the monitor into use. QEMU answers it when all ports are open and the machine is complete.
    fn greet(&mut self) -> Result<()> {
        let deadline = Instant::now() + self.patience;
        let greeting = self.monitor.find(&["\"QMP\""], deadline)?;
        self.version = monitor::version(&greeting).context("QEMU does not tell its version")?;
        self.monitor.execute("qmp_capabilities", deadline)?;
        self.monitor.execute("query-status", deadline)
    }

    /// Adds to an error what QEMU has said, and that it has ended if so.
    fn explain(&mut self, error: anyhow::Error) -> anyhow::Error {
        // The last words come right before the end.
        let deadline = Instant::now() + Duration::from_secs(1);
        while matches!(self.child.try_wait(), Ok(None)) && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
        self.messages.wait_for_end(deadline);
        match self.check() {
            Err(ended) => ended,
            Ok(()) => anyhow!("{error:#}{}", self.messages.quoted()),
        }
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        // Fails where QEMU has ended already, which is as good.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_files_are_named() {
        let error = Emulator::launch(&Options::new("/nowhere/image.elf", "/nowhere/plugin.so")).unwrap_err();
        assert!(error.to_string().contains("/nowhere/image.elf"));
    }

    /// Something else in QEMU's place: what it says before it ends is part of the error.
    #[test]
    fn an_early_end_is_explained() {
        let mut options = Options::new("/dev/null", "/dev/null");
        options.qemu = "ls".into();
        let error = Emulator::launch(&options).unwrap_err().to_string();
        assert!(error.contains("QEMU has ended") && error.contains("ls: "), "{error}");
        options.qemu = "/nowhere/qemu".into();
        let error = format!("{:#}", Emulator::launch(&options).unwrap_err());
        assert!(error.contains("can't start /nowhere/qemu"), "{error}");
    }
}
