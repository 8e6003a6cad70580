//! What the subjects are asked, and what they have to answer.

use crate::FRAME_MAX;

/// A request: what it is, its frame, and the answer to it.
#[derive(Debug, Clone, Copy)]
pub struct Request {
    /// For the report.
    pub name: &'static str,
    /// The frame without its CRC.
    content: Content,
    /// Whether the CRC is right.
    intact: bool,
    answer: Answer,
}

/// Bytes of a frame: some, and so many zeros behind them.
#[derive(Debug, Clone, Copy)]
struct Content {
    head: &'static [u8],
    zeros: usize,
}

/// What is to come back.
#[derive(Debug, Clone, Copy)]
enum Answer {
    Frame(Content),
    Silence,
    /// So many bytes, which are not in the buffer.
    Count(usize),
    /// Asked only for what it takes of the stack.
    Any,
}

impl Request {
    /// A request and the answer to it, each without its CRC.
    pub(crate) const fn new(name: &'static str, request: &'static [u8], answer: &'static [u8]) -> Self {
        Self::long(name, (request, 0), (answer, 0))
    }

    /// The same with so many zeros behind each.
    pub(crate) const fn long(
        name: &'static str,
        (request, more): (&'static [u8], usize),
        (answer, zeros): (&'static [u8], usize),
    ) -> Self {
        let answer = Answer::Frame(Content { head: answer, zeros });
        Self { name, content: Content { head: request, zeros: more }, intact: true, answer }
    }

    /// A request whose answer does not matter.
    pub(crate) const fn any(request: &'static [u8], zeros: usize) -> Self {
        Self { name: "", content: Content { head: request, zeros }, intact: true, answer: Answer::Any }
    }

    /// A frame with a wrong CRC, which is not answered.
    pub(crate) const fn broken(name: &'static str, request: &'static [u8]) -> Self {
        let content = Content { head: request, zeros: 0 };
        Self { name, content, intact: false, answer: Answer::Silence }
    }

    /// Something to work on, of which so many bytes are handed on.
    pub(crate) const fn counted(name: &'static str, request: &'static [u8], count: usize) -> Self {
        let content = Content { head: request, zeros: 0 };
        Self { name, content, intact: true, answer: Answer::Count(count) }
    }

    /// Writes the frame; its length.
    #[inline(never)]
    pub fn write(&self, frame: &mut [u8; FRAME_MAX]) -> usize {
        write(&self.content, self.intact, frame)
    }

    /// Whether this is the answer that has to come.
    #[inline(never)]
    #[must_use]
    pub fn is_answered_by(&self, length: usize, out: &[u8; FRAME_MAX]) -> bool {
        let mut expected = [0; FRAME_MAX];
        match self.answer {
            Answer::Frame(content) => {
                let count = write(&content, true, &mut expected);
                length == count && out[..length] == expected[..count]
            }
            Answer::Silence => length == 0,
            Answer::Count(count) => length == count,
            Answer::Any => true,
        }
    }
}

fn write(content: &Content, intact: bool, frame: &mut [u8; FRAME_MAX]) -> usize {
    let length = content.head.len() + content.zeros;
    let bytes = content.head.iter().copied().chain(core::iter::repeat_n(0, content.zeros));
    // a CRC of its own: the answers of the servers, ours among them, are checked with it
    let mut crc = 0xFFFF_u16;
    for (place, byte) in frame.iter_mut().zip(bytes) {
        *place = byte;
        crc ^= u16::from(byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 };
        }
    }
    let crc = if intact { crc } else { crc ^ 0x0100 };
    frame[length..length + 2].copy_from_slice(&crc.to_le_bytes());
    length + 2
}

/// What a kind of subject is asked.
#[derive(Debug, Clone, Copy)]
pub struct Requests {
    /// Once, before all others.
    pub first: &'static [Request],
    /// Over and over, for the instructions.
    pub timed: &'static [Request],
    /// The longest, and those that are refused: for the stack.
    pub longest: &'static [Request],
}

/// A kind of subject.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A general server.
    Server,
    /// An NST sensor.
    Nst,
    /// An NXI-6201.
    Nxi,
    /// An NDAM-9010 station.
    Ndam,
    /// NST over CAN.
    Transfer,
    /// The bridge's routing table.
    Routes,
}

/// What each kind is asked, in the order of [`Kind`]. One table for all, so that every image has the same one.
pub static REQUESTS: [Requests; 6] = [SERVER, NST, NXI, NDAM, TRANSFER, ROUTES];

const SERVER: Requests = Requests {
    first: &[
        Request::new(
            "",
            &[1, 0x10, 0, 0, 0, 10, 20, 0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0, 7, 0, 8, 0, 9, 0, 10],
            &[1, 0x10, 0, 0, 0, 10],
        ),
        Request::new("", &[1, 0x0F, 0, 0, 0, 16, 2, 0xCD, 0x6B], &[1, 0x0F, 0, 0, 0, 16]),
    ],
    timed: &[
        Request::new(
            "03 x 10 registers",
            &[1, 0x03, 0, 0, 0, 10],
            &[1, 0x03, 20, 0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0, 7, 0, 8, 0, 9, 0, 10],
        ),
        Request::new(
            "10 x 10 registers",
            &[1, 0x10, 0, 0, 0, 10, 20, 0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0, 7, 0, 8, 0, 9, 0, 10],
            &[1, 0x10, 0, 0, 0, 10],
        ),
        Request::new("01 x 16 coils", &[1, 0x01, 0, 0, 0, 16], &[1, 0x01, 2, 0xCD, 0x6B]),
        Request::broken("wrong CRC", &[1, 0x03, 0, 0, 0, 10]),
    ],
    longest: &[
        Request::long("", (&[1, 0x01, 0, 0, 2, 0], 0), (&[1, 0x01, 64, 0xCD, 0x6B], 62)),
        Request::long("", (&[1, 0x02, 0, 0, 2, 0], 0), (&[1, 0x02, 64], 64)),
        Request::long(
            "",
            (&[1, 0x03, 0, 0, 0, 125], 0),
            (&[1, 0x03, 250, 0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0, 7, 0, 8, 0, 9, 0, 10], 230),
        ),
        Request::long("", (&[1, 0x04, 0, 0, 0, 125], 0), (&[1, 0x04, 250], 250)),
        Request::new("", &[1, 0x06, 0, 1, 0x12, 0x34], &[1, 0x06, 0, 1, 0x12, 0x34]),
        Request::new("", &[1, 0x05, 0, 1, 0xFF, 0], &[1, 0x05, 0, 1, 0xFF, 0]),
        Request::long("", (&[1, 0x0F, 0, 0, 2, 0, 64], 64), (&[1, 0x0F, 0, 0, 2, 0], 0)),
        Request::long("", (&[1, 0x10, 0, 0, 0, 123, 246], 246), (&[1, 0x10, 0, 0, 0, 123], 0)),
        Request::any(&[1, 0x03, 0, 100, 0, 125], 0),
    ],
};

const NST: Requests = Requests {
    first: &[],
    timed: &[Request::long("read of six axes", (&[1, 0x03, 0x02, 0x00, 0x12], 0), (&[1, 0x03, 18], 18))],
    longest: &[
        Request::any(&[1, 3, 0, 0, 249], 0),
        Request::any(&[1, 0x10, 0, 0, 249], 249),
        Request::any(&[1, 0x10, 1, 0x93, 12, 1, 0, 0xC2, 1, 0, 0xE8, 3, 0, 0, 0, 8, 7], 0),
        Request::any(&[1, 0x12, 1, 0xA7, 24], 0),
        Request::any(&[1, 0x18, 0, 0, 1], 0),
    ],
};

const NXI: Requests = Requests {
    first: &[],
    timed: &[Request::new(
        "write of one value",
        &[1, 0x10, 0, 4, 0, 2, 4, 0, 0, 0x40, 0x20],
        &[1, 0x10, 0, 4, 0, 2],
    )],
    longest: &[
        Request::any(&[1, 0x03, 0, 2, 0, 12], 0),
        Request::any(&[1, 0x10, 0, 2, 0, 4, 8], 8),
        Request::any(&[1, 0x10, 0xF3, 0xE4, 0, 2, 4, 0, 1, 0, 0], 0),
        Request::any(&[1, 0x41, 0, 0], 0),
    ],
};

const NDAM: Requests = Requests {
    first: &[],
    timed: &[Request::long("read of 8 AI", (&[1, 0x04, 0, 0x40, 0, 8], 0), (&[1, 0x04, 16], 16))],
    longest: &[
        Request::any(&[1, 0x01, 2, 0, 0, 8], 0),
        Request::any(&[1, 0x05, 2, 0, 0xFF, 0], 0),
        Request::any(&[1, 0x0F, 2, 0, 0, 4, 1], 1),
        Request::any(&[1, 0x10, 0, 0x60, 0, 4, 8], 8),
        Request::any(&[0, 0x06, 0, 0x60, 0, 1], 0),
        Request::any(&[1, 0x03, 0, 0x60, 0, 4], 0),
    ],
};

const TRANSFER: Requests = Requests {
    first: &[],
    timed: &[Request::counted("20 bytes in 3 frames", &crate::transfer::REPLY, 20)],
    longest: &[],
};

const ROUTES: Requests =
    Requests { first: &[], timed: &[Request::counted("the last of the units", &[16], 1)], longest: &[] };
