//! The one message about something that is missing and that set-up cannot bring: what, for what, and the command.

use std::fmt;

/// How a person installs something.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Advice {
    /// What is missing.
    pub(crate) what: &'static str,
    /// What needs it.
    pub(crate) purpose: &'static str,
    pub(crate) debian: &'static str,
    pub(crate) fedora: &'static str,
    pub(crate) arch: &'static str,
    pub(crate) macos: &'static str,
}

impl fmt::Display for Advice {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(formatter, "missing: {}, for {}", self.what, self.purpose)?;
        writeln!(formatter, "  Debian, Ubuntu: {}", self.debian)?;
        writeln!(formatter, "  Fedora:         {}", self.fedora)?;
        writeln!(formatter, "  Arch:           {}", self.arch)?;
        write!(formatter, "  macOS:          {}", self.macos)
    }
}
