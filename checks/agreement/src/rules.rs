//! Every difference between the two servers, and why it is there.

use core::fmt;

use jointbus_protocol::modbus::BROADCAST;

/// A request that was not answered, or not carried out, alike.
pub(crate) struct Case<'a> {
    pub(crate) frame: &'a [u8],
    /// Our answer; empty for none.
    pub(crate) ours: &'a [u8],
    /// Theirs.
    pub(crate) theirs: &'a [u8],
    pub(crate) we_changed: bool,
    pub(crate) they_changed: bool,
    /// Whether the request before this one was to another unit.
    pub(crate) after_foreign: bool,
}

/// Why two servers may differ.
pub(crate) struct Rule {
    pub(crate) name: &'static str,
    pub(crate) reason: &'static str,
    pub(crate) explains: fn(&Case<'_>) -> bool,
}

/// The function codes that libmodbus has as a server.
const THEIR_FUNCTIONS: [u8; 12] = [0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x0F, 0x10, 0x11, 0x16, 0x17];

/// The first rule that explains a difference counts.
pub(crate) static RULES: [Rule; 8] = [
    Rule {
        name: "missing reply",
        reason: "after a request to another unit libmodbus takes the next frame for that unit's reply and drops it, \
                 whatever it is; here a server that does not answer is not waited for",
        explains: |case| case.after_foreign && case.they_are_silent(),
    },
    Rule {
        name: "code of a response",
        reason: "a function code of 0 or from 0x80 is none of a request (protocol specification, 4.1): here nobody \
                 answers; libmodbus refuses it with a code that overflows into that of a good response",
        explains: |case| matches!(case.function(), 0 | 0x80..) && case.ours.is_empty() && !case.they_changed,
    },
    Rule {
        name: "unknown code",
        reason: "libmodbus takes a request with a code that it does not know for complete after four bytes, so the \
                 CRC fails and it is silent; here silence ends it, and it is refused (exception 01)",
        explains: |case| {
            !THEIR_FUNCTIONS.contains(&case.function()) && case.we_refuse_with(1) && case.they_are_silent()
        },
    },
    Rule {
        name: "four bytes",
        reason: "where the first four bytes of a request with such a code have a right CRC, libmodbus refuses them; \
                 here the code's own length or silence ends it, and what then has no right CRC is dropped",
        explains: |case| {
            !THEIR_FUNCTIONS.contains(&case.function()) && case.ours.is_empty() && case.they_refuse_with(1)
        },
    },
    Rule {
        name: "exception status",
        reason: "libmodbus takes function code 07 and neither answers nor refuses it; tables in memory have no \
                 status (exception 01)",
        explains: |case| case.function() == 0x07 && case.we_refuse_with(1) && case.they_are_silent(),
    },
    Rule {
        name: "server ID",
        reason: "libmodbus answers function code 11 with a text of its own; tables in memory have no ID \
                 (exception 01)",
        explains: |case| case.function() == 0x11 && case.we_refuse_with(1) && !case.they_changed,
    },
    Rule {
        name: "value before address",
        reason: "the state diagram of function code 05 (6.5) judges the value first (exception 03), libmodbus the \
                 address (exception 02)",
        explains: |case| {
            case.function() == 0x05
                && !matches!(case.word(4), 0x0000 | 0xFF00)
                && case.we_refuse_with(3)
                && case.they_refuse_with(2)
        },
    },
    Rule {
        name: "byte count",
        reason: "the byte count of function code 0F must fit the quantity (6.11, exception 03); libmodbus does not \
                 compare them, and writes coils that nobody sent",
        explains: |case| {
            case.function() == 0x0F
                && usize::from(case.byte(6)) != usize::from(case.word(4)).div_ceil(8)
                && (case.we_refuse_with(3) || case.is_broadcast() && !case.we_changed)
        },
    },
];

impl Case<'_> {
    /// The function code, or 0.
    fn function(&self) -> u8 {
        self.frame.get(1).copied().unwrap_or(0)
    }

    /// Two bytes of the frame, the high one first.
    fn word(&self, at: usize) -> u16 {
        self.frame.get(at..at + 2).map_or(0, |pair| u16::from_be_bytes([pair[0], pair[1]]))
    }

    /// A byte of the frame.
    fn byte(&self, at: usize) -> u8 {
        self.frame.get(at).copied().unwrap_or(0)
    }

    /// Whether nobody may answer.
    fn is_broadcast(&self) -> bool {
        self.frame.first() == Some(&BROADCAST) && self.ours.is_empty() && self.theirs.is_empty()
    }

    fn they_are_silent(&self) -> bool {
        self.theirs.is_empty() && !self.they_changed
    }

    fn we_refuse_with(&self, exception: u8) -> bool {
        refuses(self.ours, exception) && !self.we_changed
    }

    fn they_refuse_with(&self, exception: u8) -> bool {
        refuses(self.theirs, exception) && !self.they_changed
    }
}

/// Whether an answer is this exception.
fn refuses(answer: &[u8], exception: u8) -> bool {
    matches!(answer, [_, function, code, _, _] if function & 0x80 != 0 && *code == exception)
}

impl fmt::Display for Case<'_> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(formatter, "request {:02x?}", self.frame)?;
        writeln!(
            formatter,
            "we      {:02x?}{}",
            self.ours,
            if self.we_changed { " and a change" } else { "" }
        )?;
        write!(
            formatter,
            "they    {:02x?}{}",
            self.theirs,
            if self.they_changed { " and a change" } else { "" }
        )
    }
}
