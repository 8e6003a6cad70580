//! What goes wrong on the host's line.

use super::{BURST_ENDS, Run, SILENCE};
use crate::sim::fault::Fault;
use crate::sim::moment::{MILLIS, Moment};
use crate::sim::question::Question;
use crate::sim::random::Random;
use crate::sim::routes::{is_nst, unit_at};
use crate::sim::station::{flip_bits, reseal};
use jointbus_mcu_bridge::board::{Target, Topology};
use jointbus_protocol::decode::STRAY_MAX;
use jointbus_protocol::modbus::{self, AddressRange, rtu};
use jointbus_protocol::nst::serial::encode_request;
use jointbus_protocol::{checksum, nst};

impl Run<'_> {
    /// One whose frame ends without silence.
    fn plain_question(&mut self) -> (u8, Question) {
        loop {
            let (unit, question) = self.next_question();
            if !question.ends_with_silence() {
                return (unit, question);
            }
        }
    }

    /// Brings a fault of the host's line about; when its last byte ends.
    pub fn host_fault(&mut self, fault: Fault) -> Moment {
        let (unit, question) = self.plain_question();
        let frame = question.frame(unit);
        let cut = 1 + self.random.index(frame.len() - 1);
        match fault {
            Fault::HostShortPause => {
                self.world.host_sends(&frame[..cut]);
                self.world.host_pauses(self.random.between(1, 15) * MILLIS);
                let at = self.world.host_sends(&frame[cut..]);
                self.master.ask(unit, question, at);
                at
            }
            Fault::HostGlued => {
                let at = self.world.host_sends(&frame);
                self.master.ask(unit, question, at);
                let (unit, question) = self.plain_question();
                self.ask(unit, question)
            }
            Fault::HostStrayBytes => {
                let bytes = self.harmless(
                    |run| {
                        let stray = 1 + run.random.index(STRAY_MAX);
                        let stray: Vec<u8> = (0..stray).map(|_| run.random.byte()).collect();
                        [&stray[..], &frame].concat()
                    },
                    &frame,
                );
                let at = self.world.host_sends(&bytes);
                // taken when the line has been silent
                self.master.ask(unit, question, at.saturating_add(BURST_ENDS));
                at
            }
            Fault::HostLongPause => {
                let bytes = self.harmless(|_| frame[cut..].to_vec(), &[]);
                self.spoilt(&frame[..cut]);
                self.world.host_pauses(SILENCE + MILLIS);
                self.spoilt(&bytes)
            }
            Fault::HostFraming => {
                let bytes = self.harmless(
                    |run| {
                        let mut bytes = frame.clone();
                        bytes[cut] ^= 1 + run.random.below(255) as u8;
                        bytes
                    },
                    &[],
                );
                self.spoilt(&bytes[..cut]);
                self.world.host_sends_unframed(bytes[cut]);
                self.world.host_sends(&bytes[cut + 1..])
            }
            // their CRC is right, and nobody takes them for all that
            Fault::HostUnknownUnit | Fault::HostUnknownFunction => {
                let bytes = self.broken(fault, &frame);
                self.spoilt(&bytes)
            }
            Fault::HostHiddenCommand | Fault::HostHiddenBehind | Fault::HostStrayBroadcast => {
                self.master.tally.hidden += 1;
                let bytes = self.harmless(|run| run.broken(fault, &frame), &[]);
                self.spoilt(&bytes)
            }
            _ => {
                let bytes = self.harmless(|run| run.broken(fault, &frame), &[]);
                self.spoilt(&bytes)
            }
        }
    }

    /// Sends bytes in which there is no request.
    fn spoilt(&mut self, bytes: &[u8]) -> Moment {
        let unit = bytes.first().copied().unwrap_or(0);
        let known = unit == 0 || unit == u8::MAX || self.network.route(unit).is_some();
        self.master.tally.unknown += u64::from(!known && !bytes.is_empty());
        self.world.host_sends(bytes)
    }

    /// Bytes in which no CRC is right by coincidence, except that of `meant` at the end and of what is hidden too deep.
    fn harmless(&mut self, mut make: impl FnMut(&mut Self) -> Vec<u8>, meant: &[u8]) -> Vec<u8> {
        let mut tries = 0;
        loop {
            tries += 1;
            let bytes = make(self);
            let coincidence = (0..=STRAY_MAX).any(|start| {
                let end_of = |end: usize| bytes.get(start..end).and_then(checksum::strip_crc).is_some();
                let is_meant = |end: usize| end == bytes.len() && bytes.get(start..) == Some(meant);
                // a broadcast behind stray bytes is right, and not to be taken
                let broadcast = start > 0 && bytes.get(start).is_some_and(|byte| [0, u8::MAX].contains(byte));
                !broadcast && (start + 4..=bytes.len()).any(|end| end_of(end) && !is_meant(end))
            });
            // some frames have a right CRC inside, whatever comes before them: their length byte says that it is none
            if !coincidence || tries > 100 {
                return bytes;
            }
        }
    }

    /// What a fault makes of a request.
    fn broken(&mut self, fault: Fault, frame: &[u8]) -> Vec<u8> {
        let mut bytes = frame.to_vec();
        let end = bytes.len() - 1;
        let mut noise = |least, most| -> Vec<u8> {
            (0..self.random.between(least, most)).map(|_| self.random.byte()).collect()
        };
        match fault {
            Fault::HostGarbage => bytes = noise(1, 300),
            Fault::HostOverlong => {
                bytes.truncate(2);
                bytes.extend(noise(260, 600));
            }
            Fault::HostCut => bytes.truncate(1 + self.random.index(end)),
            Fault::HostWrongCrc => bytes[end] ^= 1 << self.random.below(8),
            Fault::HostBits => flip_bits(&mut bytes, &mut self.random),
            Fault::HostUnknownUnit => {
                bytes[0] = 100 + self.random.below(100) as u8;
                reseal(&mut bytes);
            }
            Fault::HostUnknownFunction => {
                let units = self.questions.units().iter().copied();
                let sensors: Vec<u8> = units.filter(|unit| is_nst(&self.network, *unit)).collect();
                let unit = self.random.pick(&sensors);
                let function = self.random.pick(&[0x00, 0x01, 0x04, 0x06, 0x11, 0x7F, 0x83]);
                bytes = vec![unit, function, 0, 0, 4, 0, 0];
                reseal(&mut bytes);
            }
            Fault::HostStrayBroadcast => {
                let stray = 1 + self.random.index(STRAY_MAX);
                bytes = (0..stray).map(|_| self.random.between(1, 254) as u8).collect();
                let unit = self.random.pick(&[0, u8::MAX]);
                bytes.extend(hidden_command(&self.network, unit, &mut self.random));
            }
            Fault::HostHiddenCommand | Fault::HostHiddenBehind => {
                bytes = self.hiding(fault == Fault::HostHiddenBehind);
            }
            _ => {}
        }
        bytes
    }

    /// The first and the third unit of each route.
    fn first_and_third_units(&self) -> Vec<u8> {
        let rows = self.network.routes.iter().filter(|row| row.is_used());
        rows.flat_map(|row| (row.first_unit..=row.last_unit).step_by(2).take(2)).collect()
    }

    /// The unit that a frame with something hidden inside is sent to: behind an RS485 bus, in either dialect if there are
    /// both.
    fn carrier(&mut self) -> Option<u8> {
        let nst = self.random.below(2) == 0;
        let buses = self.plan.settings.board.serial_buses();
        let units = buses.filter_map(|port| unit_at(&self.network, port, 2));
        let (preferred, others): (Vec<u8>, Vec<u8>) =
            units.partition(|unit| is_nst(&self.network, *unit) == nst);
        self.random.one_of(if preferred.is_empty() { &others } else { &preferred })
    }

    /// A write that is wrong, with a command in its data that is right.
    fn hiding(&mut self, behind: bool) -> Vec<u8> {
        let inner = self.random.pick(&self.first_and_third_units());
        let mut data: Vec<u8> = (0..self.random.below(8)).map(|_| self.random.byte()).collect();
        data.extend(hidden_command(&self.network, inner, &mut self.random));
        if self.random.below(2) == 0 && !behind {
            data.extend((0..self.random.below(8)).map(|_| self.random.byte()));
        }
        if data.len() % 2 == 1 {
            data.insert(0, 0x33);
        }
        let mut buffer = [0; rtu::FRAME_MAX];
        let outer = self.carrier().unwrap_or(0);
        let in_nst = is_nst(&self.network, outer);
        let frame = if in_nst {
            let request = nst::Request::Write { register: 0, data: &data };
            encode_request(outer, &request, &mut buffer)
        } else {
            let range = AddressRange::new(0x60, (data.len() / 2) as u16);
            let request = modbus::Request::WriteMultipleRegisters { range, data: &data };
            rtu::encode_request(outer, &request, &mut buffer)
        };
        let mut bytes = frame.unwrap_or(&[]).to_vec();
        let end = bytes.len() - 1;
        if behind {
            // what follows the frame that the length byte tells is the command, up to the end
            bytes.truncate(end - 1);
            let length = if in_nst { 4 } else { 6 };
            bytes[length] = self.random.below(4) as u8 & !1;
        } else {
            bytes[end] ^= 0x40;
        }
        bytes
    }
}

/// A valid write of a number that nobody asked for.
fn hidden_command(network: &Topology, unit: u8, random: &mut Random) -> Vec<u8> {
    let mut buffer = [0; rtu::FRAME_MAX];
    let token = 0xEE00_0000 | random.next() as u32 & 0x00FF_FFFF;
    if unit == u8::MAX || is_nst(network, unit) {
        let request = nst::Request::Write { register: 0, data: &token.to_be_bytes() };
        encode_request(unit, &request, &mut buffer).unwrap_or(&[]).to_vec()
    } else {
        let to_bridge = network.route(unit).is_some_and(|(_, row)| row.target == Target::Bridge);
        let request = modbus::Request::WriteMultipleRegisters {
            range: AddressRange::new(if to_bridge { 0 } else { 0x60 }, 2),
            data: &token.to_be_bytes(),
        };
        rtu::encode_request(unit, &request, &mut buffer).unwrap_or(&[]).to_vec()
    }
}
