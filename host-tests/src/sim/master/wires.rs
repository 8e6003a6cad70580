//! What the bridge sends to the devices: somebody must have asked for it, and not too long ago.

use super::{Asked, Broadcast, Master};
use crate::sim::moment::{MICROS, Moment, Nanos};
use crate::sim::routes::unit_at;
use jointbus_mcu_bridge::board::{Port, Target};
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::checksum;
use jointbus_protocol::nst::can::{FrameType, Identifier, READ_MAX, WRITE_MAX};
use jointbus_protocol::nst::{SAMPLE_LENGTH, register};

impl Master {
    /// The bridge has sent a frame onto an RS485 line.
    pub fn overhears(&mut self, port: Port, frame: &[u8], start: Moment, now: Moment) {
        self.tally.sent[0] += 1;
        let Some((&remote, body)) = checksum::strip_crc(frame).and_then(<[u8]>::split_first) else {
            return self.tally.violation(now, || format!("the bridge sent a broken frame {frame:02x?}"));
        };
        if remote == 0 || remote == u8::MAX {
            let body = body.to_vec();
            return self.passes_all(port, &body, true, start, now);
        }
        self.passes(port, remote, body, start, now, |asked| asked.body == body);
    }

    /// The bridge has sent a frame on CAN.
    pub fn overhears_frame(&mut self, port: Port, frame: &Frame, start: Moment, now: Moment) {
        self.tally.sent[1] += 1;
        let Id::Extended(raw) = frame.id() else { return };
        let Some(identifier) = Identifier::from_raw(raw) else { return };
        let starts = matches!(identifier.frame_type, FrameType::Single | FrameType::First);
        if identifier.destination == u8::MAX {
            return self.overhears_part(port, &identifier, frame, start, now);
        }
        let [function, high, low, length, ..] = *frame.payload();
        if !starts {
            return;
        }
        let first = u16::from_be_bytes([high, low]);
        let head = [function, high, low, length];
        // the number of a write follows its header
        let payload = *frame.payload();
        let most = if function == 0x10 { WRITE_MAX } else { READ_MAX };
        self.passes(port, identifier.destination, &head, start, now, |asked| {
            let Some(&[asked_function, high, low, whole]) = asked.body.first_chunk::<4>() else {
                return false;
            };
            let Some(moved) = first.checked_sub(u16::from_be_bytes([high, low])) else { return false };
            let rest = u16::from(whole).checked_sub(moved);
            let same = moved > 0 || function != 0x10 || asked.body.get(..8) == Some(&payload);
            asked_function == function
                && same
                && moved % most as u16 == 0
                && rest.is_some_and(|rest| rest.min(most as u16) == u16::from(length))
        });
    }

    /// A frame of a broadcast on CAN: the first one tells which, the last one that all of it was sent.
    fn overhears_part(
        &mut self,
        port: Port,
        identifier: &Identifier,
        frame: &Frame,
        start: Moment,
        now: Moment,
    ) {
        let whole = matches!(identifier.frame_type, FrameType::Single | FrameType::Last);
        if matches!(identifier.frame_type, FrameType::Single | FrameType::First) {
            let head = frame.data().to_vec();
            self.passes_all(port, &head, whole, start, now);
            self.broadcast_heads.insert(port, head);
        } else if whole {
            let head = self.broadcast_heads.remove(&port).unwrap_or_default();
            self.passes_all(port, &head, true, Moment::default(), now);
        }
    }

    /// How long a frame that was begun in time may keep the bus of a CAN port, and a bit more.
    fn frame_time(&self, port: Port) -> Nanos {
        let is_can = self.board.description.is_can(Target::Bus(port));
        let config = self.network.port(port).filter(|_| is_can);
        config.map_or(0, |config| config.can_frames(1).as_micros() * MICROS * 5 / 4)
    }

    /// A frame goes to a device: somebody must have asked for it, and not too long ago.
    fn passes(
        &mut self,
        port: Port,
        remote: u8,
        head: &[u8],
        start: Moment,
        now: Moment,
        is_it: impl Fn(&Asked) -> bool,
    ) {
        let sample = [0x03, 0x02, 0x00, SAMPLE_LENGTH as u8];
        debug_assert_eq!(register::DATA.first, 0x0200);
        let frame = self.frame_time(port);
        let unit = unit_at(&self.network, port, remote);
        let asked = unit.and_then(|unit| {
            let open = &mut self.units[usize::from(unit)].open;
            open.iter_mut().find(|asked| !asked.overtaken && is_it(asked))
        });
        let Some(asked) = asked else {
            if !(self.polls && head == sample) {
                self.tally
                    .violation(now, || format!("{port:?}, device {remote}: nobody asked for {head:02x?}"));
            }
            return;
        };
        // of a split transfer the first part counts
        let first_part = head.get(1..3) == asked.body.get(1..3);
        let limit = asked.expires.saturating_add(frame);
        let question = asked.question;
        if first_part && start > limit {
            self.tally.violation(now, || {
                format!(
                    "{port:?}, device {remote}: {question:?} sent {} us after its time to live",
                    start.saturating_duration_since(limit) / 1000
                )
            });
        }
        asked.sent += u8::from(first_part);
        asked.superseded = None;
        let again = asked.sent > 1 && !question.is_read();
        if let Some(unit) = unit {
            let open = &mut self.units[usize::from(unit)].open;
            for other in open.iter_mut().filter(|other| other.sent > 0 && other.question != question) {
                other.superseded.get_or_insert(now);
            }
        }
        if again {
            self.tally.violation(now, || format!("{port:?}, device {remote}: {question:?} sent again"));
        }
    }

    /// A broadcast goes out: somebody must have asked for it, not too long ago, and once.
    fn passes_all(&mut self, port: Port, head: &[u8], is_whole: bool, start: Moment, now: Moment) {
        let frame = self.frame_time(port);
        let mine =
            |broadcast: &&mut Broadcast| broadcast.to.contains(&port) && broadcast.body.starts_with(head);
        let Some(broadcast) = self.broadcasts.iter_mut().find(mine) else {
            return self.tally.violation(now, || format!("{port:?}: nobody asked to tell all {head:02x?}"));
        };
        let limit = broadcast.expires.saturating_add(frame);
        if is_whole {
            broadcast.to.retain(|to| *to != port);
            self.tally.copies[1] += 1;
        }
        if start > limit {
            let late = start.saturating_duration_since(limit) / 1000;
            self.tally.violation(now, || format!("{port:?}: broadcast {late} us after its time to live"));
        }
    }
}
