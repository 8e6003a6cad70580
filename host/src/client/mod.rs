//! A small host for tests and demonstrations: Modbus RTU and NST master over any byte stream.
//!
//! One question at a time, each bounded by a timeout. Stray bytes in front of a reply are skipped; what comes after a
//! timeout is thrown away before the next question, as far as it has come by then, so that a late reply is not taken
//! for another one.

mod modbus;
mod nst;
mod value;

pub use modbus::Modbus;
pub use nst::Nst;
pub use value::{RegisterValue, WordOrder};

use crate::devices::attach::is_pause;
use jointbus_protocol::decode::{Match, ResponseMatcher};
use jointbus_protocol::modbus::ExceptionCode;
use std::fmt;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

/// How long one read of a connection waits.
const TICK: Duration = Duration::from_millis(10);

/// More than the longest reply of either protocol.
const SEARCHED: usize = 512;

/// Most bytes that are thrown away before a question.
const DISCARDED_MAX: usize = 1 << 16;

/// Why a question has no answer.
#[derive(Debug)]
pub enum Error {
    /// None came in time.
    Timeout,
    /// A Modbus server refused.
    Exception(ExceptionCode),
    /// The question does not fit a frame, or the arguments don't fit each other.
    Question,
    /// The answer has the right form and an impossible content.
    Answer,
    /// The stream has ended or failed.
    Stream(io::Error),
}

impl fmt::Display for Error {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Timeout => formatter.write_str("no answer in time"),
            Self::Exception(code) => {
                write!(formatter, "refused with exception {:02X}: {code:?}", code.code())
            }
            Self::Question => formatter.write_str("the question fits no frame"),
            Self::Answer => formatter.write_str("the answer makes no sense"),
            Self::Stream(error) => write!(formatter, "the connection failed: {error}"),
        }
    }
}

impl std::error::Error for Error {}

impl From<io::Error> for Error {
    fn from(error: io::Error) -> Self {
        Self::Stream(error)
    }
}

/// A master on a stream.
///
/// A read of the stream has to come back after a while even if nothing has come: with `WouldBlock` or `TimedOut`, as
/// a socket with a read timeout does.
#[derive(Debug)]
pub struct Client<S> {
    stream: S,
    timeout: Duration,
    /// The last question got no answer, or more than that.
    disturbed: bool,
}

/// A connection to this address as a [`Client`] wants it.
///
/// # Errors
/// Where nobody listens there.
pub fn connect(address: SocketAddr) -> io::Result<TcpStream> {
    let stream = TcpStream::connect(address)?;
    prepare(&stream)?;
    Ok(stream)
}

/// Sets a connection up as a [`Client`] wants it.
///
/// # Errors
/// Where the connection is gone.
pub fn prepare(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(TICK))
}

impl<S: Read + Write> Client<S> {
    /// A master that waits so long for each answer.
    pub const fn new(stream: S, timeout: Duration) -> Self {
        Self { stream, timeout, disturbed: false }
    }

    /// The time that a device has to answer.
    #[must_use]
    pub const fn timeout(&self) -> Duration {
        self.timeout
    }

    /// Changes the time that each answer may take.
    pub const fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    /// The stream.
    pub const fn stream(&mut self) -> &mut S {
        &mut self.stream
    }

    /// Questions to a Modbus unit.
    pub const fn modbus(&mut self, unit: u8) -> Modbus<'_, S> {
        Modbus::new(self, unit)
    }

    /// Questions to an NST sensor.
    pub const fn nst(&mut self, address: u8) -> Nst<'_, S> {
        Nst::new(self, address)
    }

    /// Sends what is not answered.
    ///
    /// # Errors
    /// Where the stream fails.
    pub fn send(&mut self, frame: &[u8]) -> Result<(), Error> {
        self.stream.write_all(frame)?;
        Ok(self.stream.flush()?)
    }

    /// Throws away what has come without a question.
    ///
    /// # Errors
    /// Where the stream fails.
    pub fn discard(&mut self) -> Result<(), Error> {
        let mut chunk = [0; 1024];
        let mut discarded = 0;
        while discarded < DISCARDED_MAX {
            match self.receive(&mut chunk)? {
                0 => break,
                length => discarded += length,
            }
        }
        self.disturbed = false;
        Ok(())
    }

    /// Sends a frame and waits for the reply; `ends_at_silence` tells of a frame that only silence ended whether it is
    /// the reply.
    fn exchange<const L: usize>(
        &mut self,
        frame: &[u8],
        expected: &impl Match<L>,
        ends_at_silence: impl Fn(&[u8]) -> bool,
    ) -> Result<Vec<u8>, Error> {
        if self.disturbed {
            self.discard()?;
        }
        self.disturbed = true;
        self.send(frame)?;
        let deadline = Instant::now() + self.timeout;
        let mut search = ResponseMatcher::<SEARCHED, L>::default();
        let mut chunk = [0; 1024];
        loop {
            let length = self.receive(&mut chunk)?;
            let mut bytes = chunk.get(..length).unwrap_or_default();
            if let Some((_, reply)) = search.feed(expected, &mut bytes) {
                self.disturbed = !bytes.is_empty();
                return Ok(reply.to_vec());
            }
            if length == 0
                && let Some(reply) = search.end_of_frame(&ends_at_silence)
            {
                self.disturbed = false;
                return Ok(reply.to_vec());
            }
            if Instant::now() >= deadline {
                return Err(Error::Timeout);
            }
        }
    }

    /// Bytes that have come; none where a read paused.
    fn receive(&mut self, chunk: &mut [u8]) -> Result<usize, Error> {
        match self.stream.read(chunk) {
            Ok(0) => Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
            Ok(length) => Ok(length),
            Err(error) if is_pause(error.kind()) => Ok(0),
            Err(error) => Err(error.into()),
        }
    }
}
