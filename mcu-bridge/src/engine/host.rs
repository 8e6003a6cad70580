//! The host port: which frames come in, and the replies on their way out.

use super::config::{Network, Protocol};
use super::counters::{Counters, count};
use jointbus_protocol::deframe::{BurstDeframer, Format, FrameLength, STRAY_MAX};
use jointbus_protocol::modbus::{self, ExceptionCode, FunctionCode, Response, rtu};
use jointbus_protocol::wire::{NoSpace, Writer};
use jointbus_protocol::{checksum, nst};

/// Longest frame of the host: NST and Modbus agree.
pub(super) const FRAME_MAX: usize = rtu::FRAME_MAX;
const _: () = assert!(nst::serial::REQUEST_MAX == FRAME_MAX && nst::serial::REPLY_MAX <= FRAME_MAX + 1);

/// Frames of the host out of its bytes.
pub(super) type HostDeframer = BurstDeframer<{ FRAME_MAX + STRAY_MAX }>;

/// The unit address selects the route, the route the codec, the codec the frame's length.
pub(super) struct HostFormat<'a>(pub(super) &'a Network);

impl Format for HostFormat<'_> {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        match prefix.first() {
            Some(&modbus::BROADCAST) => rtu::request_length(prefix),
            Some(&nst::BROADCAST) => FrameLength::UntilSilence,
            Some(&unit) => match self.0.route(unit).map(|(_, route)| route.protocol) {
                Some(Protocol::ModbusRtu | Protocol::ModbusAscii) => rtu::request_length(prefix),
                Some(Protocol::Nst | Protocol::NstOverCan) => nst::serial::request_length(prefix),
                None => FrameLength::Impossible,
            },
            None => FrameLength::AtLeast(1),
        }
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        frame.len() >= rtu::FRAME_MIN && checksum::verify(frame).is_some()
    }

    fn is_broadcast(&self, frame: &[u8]) -> bool {
        matches!(frame.first(), Some(&modbus::BROADCAST | &nst::BROADCAST))
    }
}

/// Room for one reply of each bus, one of the board's own units, and a heap of exceptions.
const OUTPUT: usize = 5 * FRAME_MAX;

/// Replies on their way to the host.
///
/// A transaction reserves room for its reply before it starts, so that a slow host link holds requests back and loses
/// no reply.
#[derive(Debug)]
pub(super) struct Output {
    buffer: [u8; OUTPUT],
    start: usize,
    end: usize,
    reserved: usize,
}

impl Output {
    pub(super) const fn new() -> Self {
        Self { buffer: [0; OUTPUT], start: 0, end: 0, reserved: 0 }
    }

    /// What is to be sent next.
    pub(super) fn pending(&self) -> &[u8] {
        self.buffer.get(self.start..self.end).unwrap_or(&[])
    }

    /// So many of the pending bytes were taken.
    pub(super) fn consume(&mut self, taken: usize) {
        self.start = self.start.saturating_add(taken).min(self.end);
        if self.start == self.end {
            self.start = 0;
            self.end = 0;
        }
    }

    /// Whether a reply of any length fits beside those that are reserved for.
    pub(super) fn has_room(&self) -> bool {
        // one reply's worth stays free for exceptions
        const USABLE: usize = OUTPUT - FRAME_MAX;
        self.pending().len().saturating_add(self.reserved).saturating_add(FRAME_MAX) <= USABLE
    }

    pub(super) const fn reserve(&mut self) {
        self.reserved = self.reserved.saturating_add(FRAME_MAX);
    }

    pub(super) const fn release(&mut self) {
        self.reserved = self.reserved.saturating_sub(FRAME_MAX);
    }

    /// Queues a Modbus response.
    pub(super) fn respond(&mut self, counters: &mut Counters, unit: u8, response: &Response<'_>) {
        self.put(counters, unit, |writer| response.encode(writer));
    }

    /// Queues the refusal of a Modbus request.
    pub(super) fn refuse(&mut self, counters: &mut Counters, unit: u8, function: u8, why: ExceptionCode) {
        self.respond(counters, unit, &Response::exception(FunctionCode::from_code(function), why));
    }

    /// Queues a reply whose data unit or body came from a bus.
    pub(super) fn relay(&mut self, counters: &mut Counters, unit: u8, content: &[u8]) {
        self.put(counters, unit, |writer| writer.slice(content));
    }

    fn put(
        &mut self,
        counters: &mut Counters,
        unit: u8,
        write: impl FnOnce(&mut Writer<'_>) -> Result<(), NoSpace>,
    ) {
        if OUTPUT.saturating_sub(self.end) <= FRAME_MAX && self.start > 0 && self.start <= self.end {
            self.buffer.copy_within(self.start..self.end, 0);
            self.end = self.end.saturating_sub(self.start);
            self.start = 0;
        }
        let mut writer = Writer::new(self.buffer.get_mut(self.end..).unwrap_or(&mut []));
        let written = writer
            .u8(unit)
            .and_then(|()| write(&mut writer))
            .and_then(|()| checksum::seal(&mut writer))
            .map(|()| writer.finish().len());
        match written {
            Ok(length) => {
                self.end = self.end.saturating_add(length);
                count(&mut counters.sent);
            }
            Err(NoSpace) => count(&mut counters.overruns),
        }
    }
}
