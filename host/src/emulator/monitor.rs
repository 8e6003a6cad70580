//! QEMU's machine protocol.

use anyhow::{Context, Result, bail, ensure};
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::os::unix::net::UnixStream;
use std::time::Instant;

/// QEMU's machine protocol, as little of it as is needed: commands without arguments, one line each way.
#[derive(Debug)]
pub(super) struct Monitor {
    stream: BufReader<UnixStream>,
    line: Vec<u8>,
    /// Resets that QEMU has reported, in answers or between them.
    resets: usize,
}

impl Monitor {
    pub(super) fn new(stream: UnixStream) -> Self {
        Self { stream: BufReader::new(stream), line: Vec::new(), resets: 0 }
    }

    pub(super) fn execute(&mut self, command: &str, deadline: Instant) -> Result<()> {
        writeln!(self.stream.get_ref(), "{{\"execute\": \"{command}\"}}").context("QEMU is not there")?;
        let answer = self.find(&["\"return\"", "\"error\""], deadline)?;
        ensure!(!answer.contains("\"error\""), "QEMU does not {command}: {answer}");
        Ok(())
    }

    /// The report of a reset may come before the answer to the command or after it.
    pub(super) fn reset(&mut self, deadline: Instant) -> Result<()> {
        let before = self.resets;
        self.execute("system_reset", deadline)?;
        while self.resets == before {
            self.read_line(deadline)?;
        }
        Ok(())
    }

    /// The next line with one of these words. Others are events that nobody waits for.
    pub(super) fn find(&mut self, words: &[&str], deadline: Instant) -> Result<String> {
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

/// The release in the monitor's greeting, which has the three numbers by name and in any order.
pub(super) fn version(greeting: &str) -> Option<String> {
    let numbers = greeting.split_once("\"qemu\"")?.1;
    let number = |name: &str| {
        let rest = numbers.split_once(&format!("\"{name}\":"))?.1.trim_start();
        let end = rest.find(|character: char| !character.is_ascii_digit())?;
        rest[..end].parse::<u32>().ok()
    };
    Some(format!("{}.{}.{}", number("major")?, number("minor")?, number("micro")?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_release_stands_in_the_greeting() {
        let greeting = r#"{"QMP": {"version": {"qemu": {"micro": 22, "minor": 2, "major": 7}, "package": "Debian 1:7.2"}}}"#;
        assert_eq!(version(greeting).as_deref(), Some("7.2.22"));
        assert_eq!(version(r#"{"QMP": {}}"#), None);
    }
}
