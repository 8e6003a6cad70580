//! A connection whose bytes reach the bridge one by one, as they do on a wire: the emulator's host port takes no time.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::thread;
use std::time::Duration;

/// Time in which the emulated processor has done what a byte brought, and sleeps again. It decides no figure: a byte that
/// finds the processor awake is not counted where that matters.
const PAUSE: Duration = Duration::from_millis(2);

/// A connection that sends a byte at a time.
pub(crate) struct Paced(pub(crate) TcpStream);

impl Read for Paced {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.0.read(buffer)
    }
}

impl Write for Paced {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Some(byte) = bytes.get(..1) else { return Ok(0) };
        thread::sleep(PAUSE);
        self.0.write(byte)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}
