use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How long a read of a [`Turn`] waits.
const WAIT: Duration = Duration::from_millis(5);

/// Bytes from the bridge that are kept for whoever has the line; more than any reply.
const KEPT: usize = 1 << 16;

/// The connection to the bridge. It is always read: an emulated port that nobody reads holds the machine up.
#[derive(Debug)]
pub(super) struct Line {
    bridge: TcpStream,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<u8>,
    closed: bool,
    /// Number that the next caller draws, and the number whose turn it is.
    next: u64,
    now_serving: u64,
}

/// The line, while it belongs to one.
#[derive(Debug)]
pub struct Turn<'l> {
    line: &'l Line,
}

impl Line {
    pub(super) fn new(bridge: TcpStream) -> Self {
        Self { bridge, state: Mutex::default(), changed: Condvar::new() }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads the bridge until it goes or `stopped` is set.
    pub(super) fn collect(&self, mut reader: TcpStream, stopped: &AtomicBool) {
        let mut chunk = [0; 4096];
        while !stopped.load(Ordering::Relaxed) {
            match reader.read(&mut chunk) {
                Ok(0) => break,
                Ok(length) => {
                    let waiting = &mut self.state().waiting;
                    waiting.extend(&chunk[..length]);
                    let surplus = waiting.len().saturating_sub(KEPT);
                    waiting.drain(..surplus);
                }
                Err(error) if crate::devices::attach::is_pause(error.kind()) => continue,
                Err(_) => break,
            }
            self.changed.notify_all();
        }
        self.state().closed = true;
        self.changed.notify_all();
    }

    /// Ends the connection; those who read find its end.
    pub(super) fn close(&self) {
        self.state().closed = true;
        let _ = self.bridge.shutdown(Shutdown::Both);
        self.changed.notify_all();
    }

    /// Waits for this caller's turn.
    pub(super) fn turn(&self) -> Turn<'_> {
        let mut state = self.state();
        let mine = state.next;
        state.next += 1;
        let mut state = self
            .changed
            .wait_while(state, |state| state.now_serving != mine)
            .unwrap_or_else(PoisonError::into_inner);
        // what has come since is nobody's
        state.waiting.clear();
        drop(state);
        Turn { line: self }
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        self.line.state().now_serving += 1;
        self.line.changed.notify_all();
    }
}

impl Read for Turn<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let nothing = |state: &mut State| state.waiting.is_empty() && !state.closed;
        let (mut state, _) = self
            .line
            .changed
            .wait_timeout_while(self.line.state(), WAIT, nothing)
            .unwrap_or_else(PoisonError::into_inner);
        if state.waiting.is_empty() && !state.closed {
            return Err(ErrorKind::WouldBlock.into());
        }
        state.waiting.read(buffer)
    }
}

impl Write for Turn<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        (&self.line.bridge).write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        (&self.line.bridge).flush()
    }
}
