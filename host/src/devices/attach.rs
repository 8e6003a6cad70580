//! Devices behind a TCP connection, in a thread of their own and in wall time.

use super::{CanBus, SerialLine};
use crate::clock::Clock;
use jointbus_protocol::slcan::{Command, ENCODED_MAX, Event, LINE_MAX, LineReader};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// How often an idle connection looks at the time.
const TICK: Duration = Duration::from_millis(20);

/// Devices that answer on a connection. Dropping it ends the connection and the thread.
#[derive(Debug)]
pub struct Attached<L> {
    line: Arc<Mutex<L>>,
    stopped: Arc<AtomicBool>,
    stream: TcpStream,
    thread: Option<JoinHandle<io::Result<()>>>,
}

/// Puts the devices of a serial line on a connection that carries its bytes.
///
/// # Errors
/// Where the operating system refuses a thread or the connection is gone.
pub fn serial<L: SerialLine + 'static>(stream: TcpStream, line: L, clock: Clock) -> io::Result<Attached<L>> {
    Attached::start(stream, line, move |line, bytes| {
        let now = clock.now();
        if bytes.is_empty() { line.poll(now) } else { line.receive(bytes, now) }
    })
}

/// Puts the devices of a CAN bus on a connection that carries its frames as SLCAN lines.
///
/// Nothing is sent to open the channel: the far end is open from the start. Confirmations and refusals are ignored.
///
/// # Errors
/// Where the operating system refuses a thread or the connection is gone.
pub fn can<B: CanBus + 'static>(stream: TcpStream, bus: B, clock: Clock) -> io::Result<Attached<B>> {
    let mut reader = LineReader::<LINE_MAX>::new();
    Attached::start(stream, bus, move |bus, mut bytes| {
        let mut out = Vec::new();
        while let Some(event) = reader.feed(&mut bytes, clock.now()) {
            let Event::Frame(line) = event else { continue };
            let Ok(Command::Frame(frame)) = Command::decode(line) else { continue };
            for reply in bus.receive(&frame, clock.now()) {
                out.extend_from_slice(Command::Frame(reply).encode(&mut [0; ENCODED_MAX]));
            }
        }
        out
    })
}

impl<L: Send + 'static> Attached<L> {
    /// Runs `answer`, which gets no bytes where only time has passed.
    fn start(
        stream: TcpStream,
        line: L,
        mut answer: impl FnMut(&mut L, &[u8]) -> Vec<u8> + Send + 'static,
    ) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(TICK))?;
        let (line, stopped) = (Arc::new(Mutex::new(line)), Arc::new(AtomicBool::new(false)));
        let (shared, told) = (Arc::clone(&line), Arc::clone(&stopped));
        let mut connection = stream.try_clone()?;
        let thread = thread::Builder::new().name("devices".into()).spawn(move || {
            let mut chunk = [0; 4096];
            while !told.load(Ordering::Relaxed) {
                let length = match connection.read(&mut chunk) {
                    Ok(0) => return Ok(()),
                    Ok(length) => length,
                    Err(error) if is_pause(error.kind()) => 0,
                    Err(error) => return Err(error),
                };
                let bytes = chunk.get(..length).unwrap_or_default();
                let reply = answer(&mut lock(&shared), bytes);
                connection.write_all(&reply)?;
            }
            Ok(())
        })?;
        Ok(Self { line, stopped, stream, thread: Some(thread) })
    }
}

impl<L> Attached<L> {
    /// The devices, which hear nothing while they are held: unplug them, look at what they told.
    pub fn lock(&self) -> MutexGuard<'_, L> {
        lock(&self.line)
    }

    /// Whether the connection still stands.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Ends the connection and waits for the thread.
    ///
    /// # Errors
    /// What ended the connection before, unless it was its orderly end.
    pub fn stop(mut self) -> io::Result<()> {
        self.end()
    }

    fn end(&mut self) -> io::Result<()> {
        let Some(thread) = self.thread.take() else { return Ok(()) };
        let was_running = !thread.is_finished();
        self.stopped.store(true, Ordering::Relaxed);
        // the far end may be gone already, which is as good
        let _ = self.stream.shutdown(Shutdown::Both);
        let outcome = thread.join().unwrap_or_else(|_| Err(io::Error::other("a simulated device panicked")));
        // an error that the shutdown caused is none
        if was_running { Ok(()) } else { outcome }
    }
}

impl<L> Drop for Attached<L> {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

/// A read that brought nothing, but may the next time.
pub(crate) const fn is_pause(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

/// A thread that panicked with the lock held left devices that still answer something; tests see the panic itself.
fn lock<L>(line: &Mutex<L>) -> MutexGuard<'_, L> {
    line.lock().unwrap_or_else(PoisonError::into_inner)
}
