//! The rest of the world as a serial CAN adapter: SLCAN lines on one side, frames on the other.
//!
//! It is more lenient than such adapters are: the channel is open from the start, bit rates may be set while it is,
//! a line feed ends a line as well, and an empty line is no error. A frame is confirmed (`z`, `Z`) when the
//! controller has acknowledged it and refused (BEL) when nobody has, so that a client can tell whether the firmware
//! is on the bus yet. Time stamps are not offered.

use crate::bus::Event;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::slcan::{self, Command, LineError, LineReader};
use jointbus_protocol::time::Instant;

/// What a client wants that concerns the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// Send this frame.
    Send(Frame),
    /// Expect this bit rate from the controller.
    BitRate(u32),
}

/// State of the channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Channel {
    Closed,
    #[default]
    Open,
    /// Frames come in and none go out.
    Listening,
}

/// One adapter and the client it talks to.
#[derive(Debug, Clone, Default)]
pub struct Adapter {
    reader: LineReader<{ slcan::LINE_MAX }>,
    channel: Channel,
}

/// Bytes of the shortest line that makes a frame.
pub const SHORTEST_FRAME: usize = b"t1230\r".len();

impl Adapter {
    /// Takes a byte from the client and appends the answer to `reply`.
    pub fn take(&mut self, byte: u8, reply: &mut Vec<u8>) -> Option<Request> {
        let byte = if byte == b'\n' { slcan::DONE } else { byte };
        match self.reader.feed(&mut &[byte][..], Instant::default())? {
            slcan::Event::Frame([]) | slcan::Event::Dropped(LineError::Refused) => None,
            slcan::Event::Dropped(LineError::TooLong) => {
                reply.push(slcan::REFUSED);
                None
            }
            slcan::Event::Frame(line) => {
                let command = Command::decode(line);
                self.answer(command.ok(), reply)
            }
        }
    }

    fn answer(&mut self, command: Option<Command>, reply: &mut Vec<u8>) -> Option<Request> {
        let mut request = None;
        let done: Option<&[u8]> = match command {
            // Answered once it has been on the bus.
            Some(Command::Frame(frame)) if self.channel == Channel::Open => {
                return Some(Request::Send(frame));
            }
            Some(Command::SetBitrate(code)) => {
                request = slcan::bit_rate(code).map(Request::BitRate);
                Some(b"")
            }
            Some(Command::SetBitTiming(registers)) => {
                request = Some(Request::BitRate(sja1000_bit_rate(registers)));
                Some(b"")
            }
            Some(Command::Open) => self.switch(Channel::Open),
            Some(Command::Listen) => self.switch(Channel::Listening),
            Some(Command::Close) => self.switch(Channel::Closed),
            Some(Command::Version) => Some(b"V0100"),
            Some(Command::SerialNumber) => Some(b"NJ405"),
            Some(Command::StatusFlags) => Some(b"F00"),
            Some(Command::Timestamp(false)) => Some(b""),
            Some(Command::AcceptanceCode(_) | Command::AcceptanceMask(_)) => Some(b""),
            Some(Command::Frame(_) | Command::Timestamp(true)) | None => None,
        };
        match done {
            Some(text) => {
                reply.extend_from_slice(text);
                reply.push(slcan::DONE);
            }
            None => reply.push(slcan::REFUSED),
        }
        request
    }

    fn switch(&mut self, channel: Channel) -> Option<&'static [u8]> {
        self.channel = channel;
        Some(b"")
    }

    /// Appends what the client is to know of an event on the bus.
    pub fn report(&self, event: Event, out: &mut Vec<u8>) {
        match event {
            Event::Received(_) if self.channel == Channel::Closed => {}
            Event::Received(frame) => {
                out.extend_from_slice(Command::Frame(frame).encode(&mut [0; slcan::ENCODED_MAX]));
            }
            Event::Sent(frame) => out.extend_from_slice(match frame.id() {
                Id::Standard(_) => slcan::SENT_STANDARD,
                Id::Extended(_) => slcan::SENT_EXTENDED,
            }),
            Event::Unacknowledged(_) => out.push(slcan::REFUSED),
        }
    }
}

/// Bit rate of an SJA1000 on its usual 16 MHz crystal, whose prescaler counts in steps of two.
fn sja1000_bit_rate(registers: u16) -> u32 {
    let [timing_0, timing_1] = registers.to_be_bytes();
    let prescaler = u32::from(timing_0 & 0x3f) + 1;
    let quanta = 3 + u32::from(timing_1 & 0xf) + u32::from(timing_1 >> 4 & 0x7);
    8_000_000 / (prescaler * quanta)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn talk(adapter: &mut Adapter, bytes: &[u8]) -> (Vec<Request>, Vec<u8>) {
        let mut reply = Vec::new();
        let requests = bytes.iter().filter_map(|&byte| adapter.take(byte, &mut reply)).collect();
        (requests, reply)
    }

    fn frame() -> Frame {
        Frame::data_frame(Id::Standard(0x123), &[1]).unwrap()
    }

    #[test]
    fn a_client_opens_it_as_it_opens_an_adapter() {
        let (requests, reply) = talk(&mut Adapter::default(), b"\r\rC\rS8\r\rO\rV\rN\rF\r");
        assert_eq!(requests, [Request::BitRate(1_000_000)]);
        assert_eq!(reply, b"\r\r\rV0100\rNJ405\rF00\r");
    }

    #[test]
    fn bit_timing_registers_are_understood() {
        let (requests, _) = talk(&mut Adapter::default(), b"s031C\r");
        assert_eq!(requests, [Request::BitRate(125_000)]);
    }

    #[test]
    fn frames_go_both_ways_without_opening() {
        let mut adapter = Adapter::default();
        assert_eq!(talk(&mut adapter, b"t123101\n"), (vec![Request::Send(frame())], Vec::new()));
        let mut out = Vec::new();
        adapter.report(Event::Sent(frame()), &mut out);
        adapter.report(Event::Unacknowledged(frame()), &mut out);
        adapter.report(Event::Received(frame()), &mut out);
        assert_eq!(out, b"z\r\x07t123101\r");
    }

    #[test]
    fn a_closed_channel_passes_nothing() {
        let mut adapter = Adapter::default();
        assert_eq!(talk(&mut adapter, b"C\rt123101\r"), (Vec::new(), b"\r\x07".to_vec()));
        let mut out = Vec::new();
        adapter.report(Event::Received(frame()), &mut out);
        assert!(out.is_empty());
    }

    #[test]
    fn a_listener_hears_and_does_not_send() {
        let mut adapter = Adapter::default();
        assert_eq!(talk(&mut adapter, b"L\rt123101\r"), (Vec::new(), b"\r\x07".to_vec()));
        let mut out = Vec::new();
        adapter.report(Event::Received(frame()), &mut out);
        assert_eq!(out, b"t123101\r");
    }

    #[test]
    fn nonsense_is_refused_and_survived() {
        let mut adapter = Adapter::default();
        let (requests, reply) = talk(&mut adapter, &[&[b'x'; 100], &b"\rt12\rZ1\rt123101\r"[..]].concat());
        assert_eq!((requests, reply), (vec![Request::Send(frame())], vec![slcan::REFUSED; 3]));
    }
}
