//! A port that is read into memory.

use super::process::{Collected, lock};
use anyhow::{Context, Result, bail};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread;
use std::time::Duration;

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
    use std::net::{Ipv4Addr, TcpListener};

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
