//! The bridge's engine in this process, with the ports of its board on TCP sockets, as the emulator has them.
//!
//! It is the engine that the firmware runs, without the firmware: no board, no bit times (what a port sends has left
//! at once), and a CAN bus on which a frame is acknowledged as soon as somebody is connected. A port serves one
//! connection, the newest.

use crate::clock::Clock;
use anyhow::{Context, Result, ensure};
use jointbus_mcu_bridge::board::{Port, Target};
use jointbus_mcu_bridge::boards::stm32f405;
use jointbus_mcu_bridge::engine::{Action, AnyEngine, Identity, ResetCause, STORED_LENGTH, Settings};
use jointbus_protocol::can::Id;
use jointbus_protocol::slcan::{self, Event, LineReader};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// How often an idle thread looks whether it is to end.
const TICK: Duration = Duration::from_millis(20);

/// Longest time until a connection is accepted.
const PATIENCE: Duration = Duration::from_secs(30);

/// Chunks that wait for the engine; connections are not read beyond that.
const CHUNKS: usize = 64;

/// A running engine. Dropping it ends its connections and threads.
#[derive(Debug)]
pub struct InProcess {
    addresses: Vec<SocketAddr>,
    connections: Arc<Connections>,
    stopped: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// Bytes of a port.
type Chunk = (Port, Vec<u8>);

/// The connection of each port, if there is one.
#[derive(Debug)]
struct Connections(Vec<Mutex<Option<TcpStream>>>);

/// Makes the engine of a board, at the start and after each reboot.
pub type MakeEngine = fn(Identity, jointbus_protocol::time::Instant) -> Box<dyn AnyEngine>;

impl InProcess {
    /// Starts the reference board's engine with its default configuration, which reports this package's version.
    ///
    /// # Errors
    /// Where there are no free ports or no threads.
    pub fn start(clock: Clock) -> Result<Self> {
        Self::start_board(clock, |identity, now| Box::new(stm32f405::Engine::new(identity, now)))
    }

    /// Starts the engine of any board, likewise.
    ///
    /// # Errors
    /// As [`InProcess::start`].
    pub fn start_board(clock: Clock, make: MakeEngine) -> Result<Self> {
        let board = start(make, clock, ResetCause::PowerOn).board();
        let stopped = Arc::new(AtomicBool::new(false));
        let connections = Arc::new(Connections(board.ports().map(|_| Mutex::new(None)).collect()));
        let (sender, receiver) = sync_channel(CHUNKS);
        let mut running = Self {
            addresses: vec![SocketAddr::from((Ipv4Addr::LOCALHOST, 0)); board.ports.len()],
            connections: Arc::clone(&connections),
            stopped: Arc::clone(&stopped),
            threads: Vec::new(),
        };
        for (port, address) in board.ports().zip(&mut running.addresses) {
            let listener = TcpListener::bind(*address).context("no free port on 127.0.0.1")?;
            listener.set_nonblocking(true)?;
            *address = listener.local_addr()?;
            let (sender, connections, stopped) =
                (sender.clone(), Arc::clone(&connections), Arc::clone(&stopped));
            let serve = move || serve(port, &listener, &connections, &sender, &stopped);
            running.threads.push(thread::Builder::new().name("port".into()).spawn(serve)?);
        }
        let run = move || Driver::new(make, clock, connections).run(&receiver, &stopped);
        running.threads.push(thread::Builder::new().name("engine".into()).spawn(run)?);
        Ok(running)
    }

    /// Where a port of the board listens.
    ///
    /// # Panics
    /// Where the board does not have it.
    #[must_use]
    pub fn address(&self, port: Port) -> SocketAddr {
        self.addresses[port.index()]
    }

    /// Connects to a port. What the engine sends from now on is not lost.
    ///
    /// # Errors
    /// Where the engine has ended.
    pub fn connect(&self, port: Port) -> Result<TcpStream> {
        let stream = TcpStream::connect(self.address(port))?;
        stream.set_nodelay(true)?;
        let here = stream.local_addr()?;
        let deadline = Instant::now() + PATIENCE;
        while self.connections.peer(port) != Some(here) {
            ensure!(Instant::now() < deadline, "the engine does not take the connection");
            thread::sleep(Duration::from_millis(1));
        }
        Ok(stream)
    }
}

impl Drop for InProcess {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

impl Connections {
    fn of(&self, port: Port) -> MutexGuard<'_, Option<TcpStream>> {
        self.0[port.index()].lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Who is connected to a port.
    fn peer(&self, port: Port) -> Option<SocketAddr> {
        self.of(port).as_ref().and_then(|stream| stream.peer_addr().ok())
    }

    /// Sends bytes; whether somebody is there to take them.
    fn send(&self, port: Port, bytes: &[u8]) -> bool {
        let mut place = self.of(port);
        let sent = place.as_mut().is_some_and(|stream| stream.write_all(bytes).is_ok());
        if !sent && let Some(stream) = place.take() {
            let _ = stream.shutdown(Shutdown::Both);
        }
        sent
    }
}

/// Accepts the connections of a port, and reads the newest one.
fn serve(
    port: Port,
    listener: &TcpListener,
    connections: &Connections,
    sender: &SyncSender<Chunk>,
    stopped: &AtomicBool,
) {
    let mut reading: Option<TcpStream> = None;
    let mut chunk = [0; 4096];
    while !stopped.load(Ordering::Relaxed) {
        if let Ok((stream, _)) = listener.accept()
            && let Ok(reader) = prepare(&stream)
        {
            if let Some(former) = connections.of(port).replace(stream) {
                let _ = former.shutdown(Shutdown::Both);
            }
            reading = Some(reader);
        }
        let Some(stream) = &mut reading else {
            thread::sleep(TICK);
            continue;
        };
        match stream.read(&mut chunk) {
            Ok(length @ 1..) => {
                if sender.send((port, chunk[..length].to_vec())).is_err() {
                    return;
                }
            }
            Err(error) if crate::devices::attach::is_pause(error.kind()) => {}
            Ok(_) | Err(_) => {
                reading = None;
                connections.of(port).take();
            }
        }
    }
}

/// Sets a connection up; a second handle to read it by.
fn prepare(stream: &TcpStream) -> std::io::Result<TcpStream> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(TICK))?;
    stream.set_write_timeout(Some(Duration::from_secs(1)))?;
    stream.try_clone()
}

/// What the firmware is to the engine: carries bytes, frames and the time to and fro.
struct Driver {
    engine: Box<dyn AnyEngine>,
    make: MakeEngine,
    /// What the host saved; it survives a reboot and not the process.
    stored: Option<Settings>,
    clock: Clock,
    connections: Arc<Connections>,
    /// For each port; a serial one has no use for it.
    lines: Vec<LineReader<{ slcan::LINE_MAX }>>,
}

impl Driver {
    fn new(make: MakeEngine, clock: Clock, connections: Arc<Connections>) -> Self {
        let engine = start(make, clock, ResetCause::PowerOn);
        let lines = engine.board().ports().map(|_| LineReader::new()).collect();
        Self { engine, make, stored: None, clock, connections, lines }
    }

    fn run(&mut self, chunks: &Receiver<Chunk>, stopped: &AtomicBool) {
        while !stopped.load(Ordering::Relaxed) {
            match chunks.recv_timeout(self.pause()) {
                Ok((port, bytes)) if self.engine.board().is_can(Target::Bus(port)) => {
                    self.receive_lines(port, &bytes);
                }
                Ok((port, bytes)) => self.engine.receive(port, &bytes, self.clock.now()),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            let mut rebooting = false;
            while let Some(action) = self.engine.poll(self.clock.now()) {
                match action {
                    Action::Store => {
                        let mut stored = [0; STORED_LENGTH];
                        self.engine.encode_settings(&mut stored);
                        self.stored = Settings::decode(&stored, self.engine.board());
                        self.engine.saved(self.stored.is_some());
                    }
                    Action::AbortCan(port) => self.engine.frames_aborted(port, self.clock.now()),
                    Action::Reboot => rebooting = true,
                    // nobody hears the outputs, a socket has no baud rate, and this CAN bus is never off
                    Action::Outputs | Action::Configure(_) | Action::RestartCan(_) => {}
                }
            }
            self.send();
            if rebooting {
                self.engine = start(self.make, self.clock, ResetCause::Software);
                if let Some(settings) = &self.stored {
                    self.engine.restore(settings, self.clock.now());
                }
            }
        }
    }

    /// Time until the engine has something to do by itself.
    fn pause(&self) -> Duration {
        let deadline = self.engine.poll_at();
        let due = deadline
            .map(|at| Duration::from_micros(at.saturating_duration_since(self.clock.now()).as_micros()));
        due.map_or(TICK, |due| due.min(TICK))
    }

    fn receive_lines(&mut self, port: Port, mut bytes: &[u8]) {
        while let Some(event) = self.lines[port.index()].feed(&mut bytes, self.clock.now()) {
            let Event::Frame(line) = event else { continue };
            let Ok(slcan::Command::Frame(frame)) = slcan::Command::decode(line) else { continue };
            self.engine.receive_frame(port, &frame, self.clock.now());
            let confirmation = match frame.id() {
                Id::Standard(_) => slcan::SENT_STANDARD,
                Id::Extended(_) => slcan::SENT_EXTENDED,
            };
            self.connections.send(port, confirmation);
        }
    }

    /// Sends all that the engine has to send.
    fn send(&mut self) {
        for port in self.engine.board().ports() {
            while !self.engine.output(port).is_empty() {
                // a line has no listener that it knows of: without one, the bytes are gone
                self.connections.send(port, self.engine.output(port));
                self.engine.advance(port, self.engine.output(port).len());
                self.engine.transmit_complete(port, self.clock.now());
            }
            while self.connections.of(port).is_some()
                && let Some(frame) = self.engine.next_frame(port)
            {
                let line = slcan::Command::Frame(frame);
                if self.connections.send(port, line.encode(&mut [0; slcan::ENCODED_MAX])) {
                    self.engine.frame_sent(port, self.clock.now());
                }
            }
        }
    }
}

fn start(make: MakeEngine, clock: Clock, reset_cause: ResetCause) -> Box<dyn AnyEngine> {
    make(Identity { version: crate::version(), reset_cause }, clock.now())
}
