//! Lets several hosts take turns at the one host port of a bridge: this process, TCP clients, and programs that open
//! a pseudo terminal as if it were a serial port.
//!
//! A client's burst of bytes goes to the bridge in one piece when it is a whole request, or when a pause ends it. The
//! line then belongs to that client until the reply to the request has come; for a burst that is no request known here,
//! until a pause ends what comes back. A time limit bounds both. It has to exceed the time that the bridge takes to give
//! up, or a late reply would reach the next client. A broadcast, which nobody answers, holds the line for a moment only.
//! Whoever waits longest is next.

mod end;
mod reply;
mod turn;

pub use turn::Turn;

use end::{Arrival, End};
use reply::ReplyEnd;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};
use turn::Line;

/// Pause that ends a burst which is no whole request.
const BURST_PAUSE: Duration = Duration::from_millis(50);
/// Pause that ends a reply which is not known by its form.
const REPLY_PAUSE: Duration = Duration::from_millis(100);
/// How long a broadcast holds the line: longer than the silence that ends a burst at the bridge.
const BROADCAST_HOLD: Duration = Duration::from_millis(50);
/// Longest burst; what is longer is passed in pieces.
const BURST_MAX: usize = 1024;
/// How often an idle thread looks whether it is to end.
const TICK: Duration = Duration::from_millis(50);

/// The host port of a bridge and those who share it. Dropping it ends all connections and threads.
#[derive(Debug)]
pub struct Share {
    common: Arc<Common>,
}

/// What the threads have in common.
#[derive(Debug)]
struct Common {
    line: Line,
    limit: Duration,
    stopped: AtomicBool,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

impl Share {
    /// Shares this connection to a bridge; a client without a reply has the line for `limit`.
    ///
    /// # Errors
    /// Where the operating system refuses a thread or the connection is gone.
    pub fn start(bridge: TcpStream, limit: Duration) -> io::Result<Self> {
        bridge.set_nodelay(true)?;
        bridge.set_read_timeout(Some(TICK))?;
        let reader = bridge.try_clone()?;
        let common = Arc::new(Common {
            line: Line::new(bridge),
            limit,
            stopped: AtomicBool::new(false),
            threads: Mutex::default(),
        });
        common.spawn("share", move |common| common.line.collect(reader, &common.stopped))?;
        Ok(Self { common })
    }

    /// Waits until the line is this caller's, and gives it away when the [`Turn`] is dropped. A turn is a stream: a
    /// [`Client`](crate::client::Client) can ask through it.
    #[must_use]
    pub fn turn(&self) -> Turn<'_> {
        self.common.line.turn()
    }

    /// Opens a TCP port on 127.0.0.1 for any number of clients.
    ///
    /// # Errors
    /// Where there is no free port.
    pub fn listen(&self) -> io::Result<SocketAddr> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        self.common.spawn("share-listener", move |common| common.accept(&listener))?;
        Ok(address)
    }

    /// Opens a pseudo terminal for programs that want a serial port; its path.
    ///
    /// # Errors
    /// Where the operating system has none.
    #[cfg(unix)]
    pub fn terminal(&self) -> io::Result<std::path::PathBuf> {
        let (terminal, path) = end::Terminal::open()?;
        self.common.spawn("share-terminal", move |common| common.serve(terminal))?;
        Ok(path)
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.common.stopped.store(true, Ordering::Relaxed);
        self.common.line.close();
        // a thread that is about to end may still have started another one
        loop {
            let threads = std::mem::take(&mut *self.common.threads());
            if threads.is_empty() {
                break;
            }
            for thread in threads {
                let _ = thread.join();
            }
        }
    }
}

impl Common {
    fn threads(&self) -> std::sync::MutexGuard<'_, Vec<JoinHandle<()>>> {
        self.threads.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn spawn(self: &Arc<Self>, name: &str, run: impl FnOnce(&Arc<Self>) + Send + 'static) -> io::Result<()> {
        let common = Arc::clone(self);
        let thread = thread::Builder::new().name(name.into()).spawn(move || run(&common))?;
        let mut threads = self.threads();
        threads.retain(|thread| !thread.is_finished());
        threads.push(thread);
        Ok(())
    }

    fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    fn accept(self: &Arc<Self>, listener: &TcpListener) {
        while !self.is_stopped() {
            match listener.accept() {
                Ok((stream, _)) => {
                    if end::prepare(&stream).is_ok() {
                        // without a thread for it, the client finds its connection closed
                        let _ = self.spawn("share-client", move |common| {
                            common.serve(&stream);
                            let _ = stream.shutdown(Shutdown::Both);
                        });
                    }
                }
                Err(_) => thread::sleep(TICK),
            }
        }
    }

    /// Passes a client's requests and their replies on until it goes.
    fn serve(&self, client: impl End) {
        while !self.is_stopped() {
            let Some((burst, end)) = self.burst(&client) else { return };
            if !burst.is_empty() && self.exchange(&client, &burst, end).is_err() {
                return;
            }
        }
    }

    /// What a client sends: a whole request, or what it sends without a pause, nothing if it is silent; `None` when it
    /// has gone.
    fn burst(&self, client: &impl End) -> Option<(Vec<u8>, ReplyEnd)> {
        let mut burst = vec![0; BURST_MAX];
        let (mut used, mut end) = (0, ReplyEnd::Pause);
        while used < BURST_MAX && !end.is_known() {
            let wait = if used == 0 { TICK } else { BURST_PAUSE };
            match client.receive(&mut burst[used..], wait) {
                Arrival::Bytes(length) => used += length,
                Arrival::Nothing => break,
                Arrival::Gone if used == 0 => return None,
                Arrival::Gone => break,
            }
            end = ReplyEnd::of(&burst[..used]);
        }
        burst.truncate(used);
        Some((burst, end))
    }

    fn exchange(&self, client: &impl End, burst: &[u8], mut end: ReplyEnd) -> io::Result<()> {
        let mut turn = self.line.turn();
        turn.write_all(burst)?;
        let hold = if matches!(end, ReplyEnd::Never) { BROADCAST_HOLD } else { self.limit };
        let mut until = Instant::now() + hold;
        let mut chunk = [0; BURST_MAX];
        while Instant::now() < until && !self.is_stopped() {
            match turn.read(&mut chunk) {
                Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                Ok(length) => {
                    client.send(&chunk[..length])?;
                    if end.is_in(&chunk[..length]) {
                        break;
                    }
                    if !end.is_known() {
                        until = Instant::now() + REPLY_PAUSE;
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}
