//! A client's end of the share: a TCP connection or a pseudo terminal.

use crate::devices::attach::is_pause;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// Longest wait for a client that does not take its reply.
const PATIENCE: Duration = Duration::from_secs(1);

/// What waiting for a client brought.
pub(super) enum Arrival {
    /// So many bytes.
    Bytes(usize),
    /// Nothing in time.
    Nothing,
    /// It is gone.
    Gone,
}

impl Arrival {
    fn of(result: io::Result<usize>) -> Self {
        match result {
            Ok(0) => Self::Gone,
            Ok(length) => Self::Bytes(length),
            Err(error) if is_pause(error.kind()) => Self::Nothing,
            Err(_) => Self::Gone,
        }
    }
}

pub(super) trait End {
    /// Waits so long at most.
    fn receive(&self, buffer: &mut [u8], wait: Duration) -> Arrival;

    /// Sends all of it, or fails after a while.
    fn send(&self, bytes: &[u8]) -> io::Result<()>;
}

/// Sets a connection up to be an [`End`].
pub(super) fn prepare(stream: &TcpStream) -> io::Result<()> {
    // on some systems it takes after its listener
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(PATIENCE))
}

impl End for &TcpStream {
    fn receive(&self, buffer: &mut [u8], wait: Duration) -> Arrival {
        let mut stream = *self;
        Arrival::of(stream.set_read_timeout(Some(wait)).and_then(|()| stream.read(buffer)))
    }

    fn send(&self, bytes: &[u8]) -> io::Result<()> {
        let mut stream = *self;
        stream.write_all(bytes)
    }
}

#[cfg(unix)]
pub(super) use terminal::Terminal;

#[cfg(unix)]
mod terminal {
    use super::{Arrival, End, PATIENCE};
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    use rustix::fd::OwnedFd;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
    use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
    use std::ffi::OsStr;
    use std::fs::{File, OpenOptions};
    use std::io;
    use std::os::unix::ffi::OsStrExt;
    use std::path::PathBuf;
    use std::time::Duration;

    /// A pseudo terminal in raw mode. Programs may open and close it as often as they like.
    #[derive(Debug)]
    pub(in super::super) struct Terminal {
        controller: OwnedFd,
        /// Held open, so that the controller never finds the terminal closed.
        _terminal: File,
    }

    impl Terminal {
        /// A new one, and its path.
        pub(in super::super) fn open() -> io::Result<(Self, PathBuf)> {
            let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
            grantpt(&controller)?;
            unlockpt(&controller)?;
            let name = ptsname(&controller, Vec::new())?;
            let path = PathBuf::from(OsStr::from_bytes(name.to_bytes()));
            let terminal = OpenOptions::new().read(true).write(true).open(&path)?;
            let mut settings = tcgetattr(&terminal)?;
            settings.make_raw();
            tcsetattr(&terminal, OptionalActions::Now, &settings)?;
            rustix::io::ioctl_fionbio(&controller, true)?;
            Ok((Self { controller, _terminal: terminal }, path))
        }

        fn is_ready(&self, what: PollFlags, wait: Duration) -> io::Result<bool> {
            let wait = Timespec::try_from(wait).map_err(io::Error::other)?;
            Ok(poll(&mut [PollFd::new(&self.controller, what)], Some(&wait))? > 0)
        }
    }

    impl End for Terminal {
        fn receive(&self, buffer: &mut [u8], wait: Duration) -> Arrival {
            match self.is_ready(PollFlags::IN, wait) {
                Ok(false) => Arrival::Nothing,
                Ok(true) => Arrival::of(rustix::io::read(&self.controller, buffer).map_err(io::Error::from)),
                Err(error) => Arrival::of(Err(error)),
            }
        }

        /// What nobody takes is dropped, as on a line.
        fn send(&self, mut bytes: &[u8]) -> io::Result<()> {
            while !bytes.is_empty() && self.is_ready(PollFlags::OUT, PATIENCE)? {
                match rustix::io::write(&self.controller, bytes) {
                    Ok(length) => bytes = &bytes[length..],
                    Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => return Ok(()),
                    Err(error) => return Err(error.into()),
                }
            }
            Ok(())
        }
    }
}
