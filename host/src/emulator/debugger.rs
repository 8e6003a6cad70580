//! QEMU's debugger port, with as little of the GDB remote protocol as is needed: registers and memory, from outside, of
//! an image that knows nothing of it.

use anyhow::{Context, Result, ensure};
use std::fmt::Write as _;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::Duration;

/// Bytes of memory that are asked for at a time.
const CHUNK: usize = 512;

/// The processor, stopped until it is [`Debugger::resume`]d.
#[derive(Debug)]
pub struct Debugger {
    stream: UnixStream,
}

impl Debugger {
    /// Number of the stack pointer.
    pub const SP: u8 = 13;
    /// Number of the link register.
    pub const LR: u8 = 14;
    /// Number of the program counter.
    pub const PC: u8 = 15;

    /// Stops the processor of a QEMU whose debugger port (`-gdb chardev:ID`) is a Unix socket.
    ///
    /// # Errors
    /// Where nobody listens, or QEMU does not answer in time; so for every method here.
    pub fn stop(socket: &Path, patience: Duration) -> Result<Self> {
        let stream = UnixStream::connect(socket).context("there is no debugger port")?;
        stream.set_read_timeout(Some(patience))?;
        let mut debugger = Self { stream };
        // registers can be written once their description was read
        debugger.ask("qXfer:features:read:target.xml:0,fff")?;
        Ok(debugger)
    }

    /// Reads a register, by its number.
    ///
    /// # Errors
    /// As [`Self::stop`].
    pub fn register(&mut self, number: u8) -> Result<u32> {
        let answer = self.ask(&format!("p{number:x}"))?;
        // in the order of memory
        Ok(u32::from_str_radix(&answer, 16).with_context(|| format!("no register: {answer}"))?.swap_bytes())
    }

    /// Writes a register, by its number.
    ///
    /// # Errors
    /// As [`Self::stop`].
    pub fn set_register(&mut self, number: u8, value: u32) -> Result<()> {
        // in the order of memory
        self.command(&format!("P{number:x}={:08x}", value.swap_bytes()))
    }

    /// Reads memory.
    ///
    /// # Errors
    /// As [`Self::stop`].
    pub fn read(&mut self, address: u32, length: usize) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        while bytes.len() < length {
            let part = CHUNK.min(length - bytes.len());
            let answer = self.ask(&format!("m{:x},{part:x}", address + u32::try_from(bytes.len())?))?;
            ensure!(answer.len() == 2 * part, "no memory at {address:#x}: {answer}");
            for digits in answer.as_bytes().chunks(2) {
                bytes.push(u8::from_str_radix(std::str::from_utf8(digits)?, 16)?);
            }
        }
        Ok(bytes)
    }

    /// Writes memory.
    ///
    /// # Errors
    /// As [`Self::stop`].
    pub fn write(&mut self, mut address: u32, bytes: &[u8]) -> Result<()> {
        for part in bytes.chunks(CHUNK) {
            let mut command = format!("M{address:x},{:x}:", part.len());
            for byte in part {
                write!(command, "{byte:02x}")?;
            }
            self.command(&command)?;
            address += u32::try_from(part.len())?;
        }
        Ok(())
    }

    /// Has the processor run a function of the image, with up to four arguments, until it returns to `back`: an address
    /// that it does not come to otherwise. The first register is what it returns; it stays stopped there.
    ///
    /// # Errors
    /// As [`Self::stop`].
    pub fn call(&mut self, function: u32, arguments: &[u32], back: u32) -> Result<u32> {
        for (number, argument) in (0..).zip(arguments) {
            self.set_register(number, *argument)?;
        }
        // the lowest bit says that the code is Thumb
        self.set_register(Self::LR, back | 1)?;
        self.set_register(Self::PC, function & !1)?;
        self.command(&format!("Z1,{back:x},2"))?;
        self.send("c")?;
        let answer = self.packet()?;
        ensure!(answer.starts_with(['T', 'S']), "the debugger port answers {answer:?} instead of a stop");
        self.command(&format!("z1,{back:x},2"))?;
        let stopped = self.register(Self::PC)?;
        ensure!(stopped == back & !1, "it has stopped at {stopped:#x}");
        self.register(0)
    }

    /// Lets the processor go on.
    ///
    /// # Errors
    /// As [`Self::stop`].
    pub fn resume(mut self) -> Result<()> {
        self.command("D")
    }

    fn command(&mut self, content: &str) -> Result<()> {
        let answer = self.ask(content)?;
        ensure!(answer == "OK", "the debugger port answers {answer:?} to {content:?}");
        Ok(())
    }

    /// Sends a packet; the content of the answer.
    fn ask(&mut self, content: &str) -> Result<String> {
        self.send(content)?;
        loop {
            let answer = self.packet()?;
            // that the processor has stopped is told when it is, asked or not
            if !answer.starts_with(['T', 'S']) {
                return Ok(answer);
            }
        }
    }

    fn send(&mut self, content: &str) -> Result<()> {
        let sum = content.bytes().fold(0u8, u8::wrapping_add);
        self.stream.write_all(format!("${content}#{sum:02x}").as_bytes())?;
        Ok(())
    }

    fn packet(&mut self) -> Result<String> {
        let mut content = String::new();
        // an acknowledgement may stand before it
        while self.byte()? != b'$' {}
        loop {
            match self.byte()? {
                b'#' => break,
                byte => content.push(char::from(byte)),
            }
        }
        for _ in 0..2 {
            self.byte()?;
        }
        self.stream.write_all(b"+")?;
        Ok(content)
    }

    fn byte(&mut self) -> Result<u8> {
        let mut byte = [0];
        self.stream.read_exact(&mut byte).context("the debugger port is silent")?;
        Ok(byte[0])
    }
}
