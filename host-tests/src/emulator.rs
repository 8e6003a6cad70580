//! The firmware's image in QEMU, with every port of the board on a TCP socket.
//!
//! [`Emulator::launch`] starts QEMU with the project's plugin, waits until its ports can be connected to, and lets
//! the machine run (or holds it, see [`Options::paused`]). Dropping the [`Emulator`] ends QEMU; so does the end of
//! this process, however it comes.
//!
//! A port serves one connection at a time. What the machine sends while nobody is connected is lost and holds
//! nothing up. **A connected UART has to be read**: after some hundred unread writes QEMU stops the whole machine
//! until they are. [`Emulator::capture`] reads a port into memory. The CAN port and the fault console never hold
//! the machine up; the plugin drops what a client leaves unread for too long.

use anyhow::{Context, Result, anyhow, bail, ensure};
use std::ffi::{OsStr, OsString};
use std::fmt;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, ChildStderr, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, mpsc};
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

    const fn is_serial(self) -> bool {
        matches!(self, Self::Usart1 | Self::Usart2 | Self::Usart3)
    }
}

impl fmt::Display for Port {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.id())
    }
}

/// Where a port listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Endpoint {
    /// On 127.0.0.1, wherever there is room; [`Emulator::address`] says where.
    #[default]
    Free,
    /// Here.
    At(SocketAddr),
}

/// What to emulate, and how.
#[derive(Debug, Clone)]
pub struct Options {
    /// The firmware, as an ELF file.
    pub image: PathBuf,
    /// The plugin's library.
    pub plugin: PathBuf,
    /// QEMU: a path, or a name to look for in `PATH`.
    pub qemu: PathBuf,
    /// The host's port.
    pub usart1: Endpoint,
    /// The first RS-485 bus.
    pub usart2: Endpoint,
    /// The second RS-485 bus.
    pub usart3: Endpoint,
    /// The CAN bus.
    pub can: Endpoint,
    /// The fault console.
    pub faults: Endpoint,
    /// Whether the board has its crystal.
    pub crystal: bool,
    /// Whether the CAN controller answers.
    pub can_controller: bool,
    /// Whether the independent watchdog bites. In wall time a machine that is busy otherwise lets it starve, so this wants
    /// [`Options::icount`].
    pub watchdog: bool,
    /// File that keeps the flash's sectors 10 and 11, whatever ends QEMU; without one they are erased at the start.
    pub flash: Option<PathBuf>,
    /// With this, an instruction takes 2^N ns of the machine's time, however long the host needs for it.
    pub icount: Option<u8>,
    /// Hold the machine before its first instruction, until [`Emulator::resume`], so that no port misses anything.
    pub paused: bool,
    /// Time that QEMU has to start, and to answer. Generous, for machines that have other things to do.
    pub patience: Duration,
    /// Further arguments for QEMU.
    pub arguments: Vec<OsString>,
}

impl Options {
    /// An image and the plugin; all ports free, a crystal, running in wall time.
    pub fn new(image: impl Into<PathBuf>, plugin: impl Into<PathBuf>) -> Self {
        Self {
            image: image.into(),
            plugin: plugin.into(),
            qemu: "qemu-system-arm".into(),
            usart1: Endpoint::Free,
            usart2: Endpoint::Free,
            usart3: Endpoint::Free,
            can: Endpoint::Free,
            faults: Endpoint::Free,
            crystal: true,
            can_controller: true,
            watchdog: false,
            flash: None,
            icount: None,
            paused: false,
            patience: Duration::from_secs(30),
            arguments: Vec::new(),
        }
    }

    const fn endpoint(&self, port: Port) -> Endpoint {
        match port {
            Port::Usart1 => self.usart1,
            Port::Usart2 => self.usart2,
            Port::Usart3 => self.usart3,
            Port::Can => self.can,
            Port::Faults => self.faults,
        }
    }

    fn has_free_endpoints(&self) -> bool {
        Port::ALL.iter().any(|&port| self.endpoint(port) == Endpoint::Free)
    }

    /// An address for every port.
    fn addresses(&self) -> Result<[SocketAddr; Port::ALL.len()]> {
        // All are held until all are chosen, so that they differ.
        let mut held = Vec::new();
        let mut addresses = [SocketAddr::from((Ipv4Addr::LOCALHOST, 0)); Port::ALL.len()];
        for (address, &port) in addresses.iter_mut().zip(&Port::ALL) {
            *address = match self.endpoint(port) {
                Endpoint::At(address) => address,
                Endpoint::Free => {
                    let listener = TcpListener::bind(*address).context("no free port on 127.0.0.1")?;
                    let address = listener.local_addr()?;
                    held.push(listener);
                    address
                }
            };
        }
        Ok(addresses)
    }

    /// QEMU's command line.
    fn command(&self, addresses: &[SocketAddr], monitor: RawFd) -> Command {
        let mut command = Command::new(&self.qemu);
        command.args(["-M", "netduinoplus2", "-display", "none", "-monitor", "none", "-S"]);
        command.arg("-kernel").arg(&self.image);
        let mut plugin = escaped(self.plugin.as_os_str());
        plugin.push(if self.crystal { ",crystal=on" } else { ",crystal=off" });
        if !self.can_controller {
            plugin.push(",can=off");
        }
        if self.watchdog {
            plugin.push(",watchdog=on");
        }
        if let Some(flash) = &self.flash {
            plugin.push(",flash=");
            plugin.push(escaped(flash.as_os_str()));
        }
        command.arg("-plugin").arg(plugin);
        if let Some(shift) = self.icount {
            command.args(["-icount", &format!("shift={shift}")]);
        }
        command.args(["-chardev", &format!("socket,id=monitor,fd={monitor}")]);
        command.args(["-mon", "chardev=monitor,mode=control"]);
        for (port, address) in Port::ALL.iter().zip(addresses) {
            command.args(["-chardev", &listening(*port, *address)]);
            if port.is_serial() {
                command.args(["-serial", &format!("chardev:{port}")]);
            }
        }
        command.args(&self.arguments);
        command
    }
}

/// A file name inside an option, where a comma would end it.
fn escaped(name: &OsStr) -> OsString {
    name.to_str().map_or_else(|| name.to_owned(), |name| name.replace(',', ",,").into())
}

fn listening(port: Port, address: SocketAddr) -> String {
    let (host, number) = (address.ip(), address.port());
    format!("socket,id={port},host={host},port={number},server=on,wait=off,nodelay=on")
}

/// A running QEMU. Dropping it ends QEMU.
#[derive(Debug)]
pub struct Emulator {
    child: Child,
    addresses: [SocketAddr; Port::ALL.len()],
    monitor: Monitor,
    messages: Messages,
    patience: Duration,
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
        let mut emulator =
            Self { child, addresses, monitor: Monitor::new(ours), messages, patience: options.patience };
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

    /// Connects to a port. A UART's connection has to be read; see the [module](self).
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
    /// `crystal 0`, `cause pin`.
    ///
    /// # Errors
    /// Where the console does not answer `ok`.
    pub fn fault(&self, line: &str) -> Result<()> {
        let mut console = self.connect(Port::Faults)?;
        console.set_read_timeout(Some(self.patience))?;
        console.write_all(format!("{line}\n").as_bytes())?;
        let mut answer = String::new();
        BufReader::new(&console).read_line(&mut answer).context("the fault console does not answer")?;
        ensure!(answer.trim_end() == "ok", "the fault console does not know {line:?}");
        Ok(())
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
        self.monitor.find(&["\"QMP\""], deadline)?;
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

/// Starts QEMU from a thread that lives as long as it does: the operating system ends a child with the *thread* that
/// started it, and that is to be the end of this process, not of the test that called.
fn start(mut command: Command, inherited: RawFd) -> Result<(Child, Messages)> {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    // SAFETY: between fork and exec only functions are called that are safe in a signal handler.
    unsafe { command.pre_exec(move || prepare_child(inherited)) };
    let messages = Messages::default();
    let kept = messages.clone();
    let (sender, receiver) = mpsc::channel();
    thread::Builder::new().name("qemu".into()).spawn(move || {
        let spawned = command.spawn().map(|mut child| (child.stderr.take(), child));
        let stderr = match spawned {
            Ok((stderr, child)) => {
                let _ = sender.send(Ok(child));
                stderr
            }
            Err(error) => {
                let _ = sender.send(Err(error));
                None
            }
        };
        kept.collect(stderr);
    })?;
    let child = receiver.recv()??;
    Ok((child, messages))
}

/// In the child: lets it have the monitor, and has it end with its parent.
fn prepare_child(inherited: RawFd) -> std::io::Result<()> {
    // SAFETY: the descriptor is open; clearing its flags touches no memory.
    if unsafe { libc::fcntl(inherited, libc::F_SETFD, 0) } < 0 {
        return Err(std::io::Error::last_os_error());
    }
    #[cfg(target_os = "linux")]
    // SAFETY: only this process's own setting changes.
    if unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) } < 0 {
        return Err(std::io::Error::last_os_error());
    }
    Ok(())
}

/// What QEMU says on its standard error.
#[derive(Debug, Clone, Default)]
struct Messages(Arc<(Mutex<Collected>, Condvar)>);

#[derive(Debug, Default)]
struct Collected {
    bytes: Vec<u8>,
    ended: bool,
}

impl Messages {
    /// Reads to the end, that is, until QEMU ends.
    fn collect(&self, stderr: Option<ChildStderr>) {
        let mut chunk = [0; 1024];
        if let Some(mut stderr) = stderr {
            while let Ok(length @ 1..) = stderr.read(&mut chunk) {
                lock(&self.0.0).bytes.extend_from_slice(&chunk[..length]);
            }
        }
        lock(&self.0.0).ended = true;
        self.0.1.notify_all();
    }

    fn wait_for_end(&self, deadline: Instant) {
        let left = deadline.saturating_duration_since(Instant::now());
        drop(self.0.1.wait_timeout_while(lock(&self.0.0), left, |collected| !collected.ended));
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&lock(&self.0.0).bytes).into_owned()
    }

    /// To be put behind an error.
    fn quoted(&self) -> String {
        let text = self.text();
        if text.is_empty() { ", without a word".into() } else { format!(": {}", text.trim_end()) }
    }
}

/// A thread that panicked with the lock held has left nothing half done here.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// QEMU's machine protocol, as little of it as is needed: commands without arguments, one line each way.
#[derive(Debug)]
struct Monitor {
    stream: BufReader<UnixStream>,
    line: Vec<u8>,
    /// Resets that QEMU has reported, in answers or between them.
    resets: usize,
}

impl Monitor {
    fn new(stream: UnixStream) -> Self {
        Self { stream: BufReader::new(stream), line: Vec::new(), resets: 0 }
    }

    fn execute(&mut self, command: &str, deadline: Instant) -> Result<()> {
        writeln!(self.stream.get_ref(), "{{\"execute\": \"{command}\"}}").context("QEMU is not there")?;
        let answer = self.find(&["\"return\"", "\"error\""], deadline)?;
        ensure!(!answer.contains("\"error\""), "QEMU does not {command}: {answer}");
        Ok(())
    }

    /// The report of a reset may come before the answer to the command or after it.
    fn reset(&mut self, deadline: Instant) -> Result<()> {
        let before = self.resets;
        self.execute("system_reset", deadline)?;
        while self.resets == before {
            self.read_line(deadline)?;
        }
        Ok(())
    }

    /// The next line with one of these words. Others are events that nobody waits for.
    fn find(&mut self, words: &[&str], deadline: Instant) -> Result<String> {
        loop {
            let line = self.read_line(deadline)?;
            if words.iter().any(|word| line.contains(word)) {
                return Ok(line);
            }
        }
    }

    fn read_line(&mut self, deadline: Instant) -> Result<String> {
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            ensure!(!left.is_zero(), "QEMU does not answer");
            self.stream.get_ref().set_read_timeout(Some(left))?;
            match self.stream.read_until(b'\n', &mut self.line) {
                Ok(0) => bail!("QEMU is gone"),
                Ok(_) if self.line.ends_with(b"\n") => {
                    let line = String::from_utf8_lossy(&std::mem::take(&mut self.line)).into_owned();
                    self.resets += usize::from(line.contains("\"RESET\""));
                    return Ok(line);
                }
                Ok(_) => {}
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
                Err(error) => return Err(error).context("QEMU is not there"),
            }
        }
    }
}

/// A connection whose bytes are read as they come and kept.
#[derive(Debug)]
pub struct Capture {
    stream: TcpStream,
    messages: Arc<(Mutex<Collected>, Condvar)>,
}

impl Capture {
    /// Reads this connection from now on.
    ///
    /// # Errors
    /// Where the operating system has no more sockets or threads.
    pub fn new(stream: TcpStream) -> Result<Self> {
        let messages = Arc::new((Mutex::default(), Condvar::new()));
        let (mut source, sink) = (stream.try_clone()?, Arc::clone(&messages));
        thread::Builder::new().name("capture".into()).spawn(move || {
            let mut chunk = [0; 4096];
            loop {
                let length = source.read(&mut chunk).unwrap_or(0);
                let mut collected: MutexGuard<'_, Collected> = lock(&sink.0);
                collected.bytes.extend_from_slice(&chunk[..length]);
                collected.ended = length == 0;
                sink.1.notify_all();
                if length == 0 {
                    return;
                }
            }
        })?;
        Ok(Self { stream, messages })
    }

    /// Sends bytes the other way.
    ///
    /// # Errors
    /// Where the connection has ended.
    pub fn send(&self, bytes: &[u8]) -> Result<()> {
        (&self.stream).write_all(bytes).context("the port is closed")
    }

    /// Everything so far, and forgets it.
    #[must_use]
    pub fn take(&self) -> Vec<u8> {
        std::mem::take(&mut lock(&self.messages.0).bytes)
    }

    /// Takes everything up to and with `pattern`.
    ///
    /// # Errors
    /// Where it has not come in time, with what has.
    pub fn wait_for(&self, pattern: &[u8], patience: Duration) -> Result<Vec<u8>> {
        let find = |bytes: &[u8]| bytes.windows(pattern.len().max(1)).position(|window| window == pattern);
        let waiting = |collected: &mut Collected| !collected.ended && find(&collected.bytes).is_none();
        let (mut collected, _) = self
            .messages
            .1
            .wait_timeout_while(lock(&self.messages.0), patience, waiting)
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        let Some(start) = find(&collected.bytes) else {
            let seen = collected.bytes.escape_ascii();
            bail!("{:?} has not come; seen: \"{seen}\"", String::from_utf8_lossy(pattern));
        };
        Ok(collected.bytes.drain(..start + pattern.len()).collect())
    }
}

impl Drop for Capture {
    fn drop(&mut self) {
        // Ends the reading thread.
        let _ = self.stream.shutdown(std::net::Shutdown::Both);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_ports_differ_and_fixed_ones_stay() {
        let mut options = Options::new("image", "plugin");
        let fixed = SocketAddr::from((Ipv4Addr::LOCALHOST, 1));
        options.can = Endpoint::At(fixed);
        let addresses = options.addresses().unwrap();
        assert_eq!(addresses[Port::Can as usize], fixed);
        let mut ports: Vec<u16> = addresses.iter().map(SocketAddr::port).collect();
        ports.sort_unstable();
        ports.dedup();
        assert_eq!(ports.len(), Port::ALL.len());
        assert!(!ports.contains(&0));
    }

    #[test]
    fn the_command_line_is_as_documented() {
        let mut options = Options::new("image.elf", "a,b.so");
        options.icount = Some(3);
        options.crystal = false;
        let addresses = [SocketAddr::from((Ipv4Addr::LOCALHOST, 5000)); Port::ALL.len()];
        let command = options.command(&addresses, 9);
        let line: Vec<&str> = command.get_args().map(|argument| argument.to_str().unwrap()).collect();
        let line = line.join(" ");
        assert!(line.starts_with(
            "-M netduinoplus2 -display none -monitor none -S -kernel image.elf -plugin a,,b.so,crystal=off"
        ));
        assert!(line.contains("-icount shift=3"));
        assert!(line.contains(
            "-chardev socket,id=usart1,host=127.0.0.1,port=5000,server=on,wait=off,nodelay=on -serial chardev:usart1"
        ));
        assert!(
            line.ends_with(
                "-chardev socket,id=canctl,host=127.0.0.1,port=5000,server=on,wait=off,nodelay=on"
            )
        );
    }

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

    #[test]
    fn a_capture_is_cut_at_the_pattern() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let capture = Capture::new(TcpStream::connect(listener.local_addr().unwrap()).unwrap()).unwrap();
        let (mut peer, _) = listener.accept().unwrap();
        peer.write_all(b"one\ntwo\nthr").unwrap();
        let patience = Duration::from_secs(10);
        assert_eq!(capture.wait_for(b"two\n", patience).unwrap(), b"one\ntwo\n");
        drop(peer);
        assert!(capture.wait_for(b"three", patience).unwrap_err().to_string().contains("seen: \"thr\""));
        assert_eq!(capture.take(), b"thr");
    }
}
