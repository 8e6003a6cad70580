//! How each kind of fault is brought about on the buses.

use super::{BRIDGE, TO_BUS_OFF, World};
use crate::sim::can_wire::Disturbance;
use crate::sim::fault::{Fault, Place};
use crate::sim::line::Tamper;
use crate::sim::moment::{MICROS, MILLIS, Moment, Nanos};
use crate::sim::routes;
use crate::sim::settings::Settings;
use jointbus_mcu_bridge::board::Port;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::nst::can::segment;

/// Longest that a device stays dead, a line cut, or a bus dominant: mostly, and now and then.
const LONG: Nanos = 400 * MILLIS;
const LONGEST: Nanos = 4000 * MILLIS;

impl World<'_> {
    /// Brings a fault about on some bus, now or with the next frame that it concerns. The answer is when it is over, as
    /// far as that can be told by now; [`World::is_armed`] tells whether it still waits for a frame. Faults of the host's
    /// line are the host's business, and those of a bus that the board does not have don't come.
    pub fn inject(&mut self, fault: Fault) -> Moment {
        let Settings { board, network, .. } = &self.settings;
        let fits = |port: &Port| fault != Fault::ReplyException || routes::speaks_modbus(network, *port);
        let serial: Vec<Port> = board.serial_buses().filter(fits).collect();
        let can: Vec<Port> = board.can_buses().collect();
        let (serial, can) = (self.random.one_of(&serial), self.random.one_of(&can));
        let bus = match fault.place() {
            Place::Serial => serial,
            Place::Can => can,
            Place::Host => None,
        };
        bus.map_or(self.now, |bus| self.inject_at(fault, bus))
    }

    /// The same, on this bus.
    ///
    /// # Panics
    /// Where the fault is none of such a bus.
    pub fn inject_at(&mut self, fault: Fault, port: Port) -> Moment {
        match fault.place() {
            Place::Serial => self.inject_serial(fault, self.line_of(port)),
            Place::Can => self.inject_can(fault, self.net_of(port)),
            Place::Host => self.now,
        }
    }

    /// Takes the power of a device, or one module of a station, until that moment.
    pub fn set_absent(&mut self, port: Port, index: usize, until: Moment) {
        if let Some(bus) = self.lines.iter_mut().find(|bus| bus.port == port) {
            match &mut bus.devices[..] {
                [station] if !bus.is_nst => station.without = (until > self.now).then_some(index),
                sensors => sensors[index].absent = until,
            }
        } else {
            self.darken(self.net_of(port), &[index], until);
        }
    }

    fn line_of(&self, port: Port) -> usize {
        let place = self.lines.iter().position(|bus| bus.port == port);
        place.unwrap_or_else(|| panic!("{port:?} is no RS485 bus"))
    }

    fn net_of(&self, port: Port) -> usize {
        let place = self.nets.iter().position(|net| net.port == port);
        place.unwrap_or_else(|| panic!("{port:?} is no CAN bus"))
    }

    /// Whether a fault still waits for a frame that it concerns.
    #[must_use]
    pub fn is_armed(&self) -> bool {
        let serial = self
            .lines
            .iter()
            .any(|bus| !bus.armed.is_empty() || bus.line.is_tampered() || bus.hold > 0 || bus.mute > 0);
        serial || self.nets.iter().any(|net| !net.armed.is_empty() || !net.wire.disturbances.is_empty())
    }

    fn inject_serial(&mut self, fault: Fault, line: usize) -> Moment {
        let (now, span) = (self.now, self.span());
        let byte = self.lines[line].line.byte_time();
        let index = self.random.index(8);
        match fault {
            Fault::RequestBits => {
                let bits = (0..self.random.between(1, 3)).fold(0, |bits, _| bits | 1 << self.random.below(8));
                self.lines[line].line.tamper(BRIDGE, index, Tamper::Flip(bits));
            }
            Fault::RequestByteLost => self.lines[line].line.tamper(BRIDGE, index, Tamper::Lose),
            Fault::RequestByteDoubled => self.lines[line].line.tamper(BRIDGE, index, Tamper::Double),
            Fault::DriverLate => self.lines[line].mute = self.random.between(1, 5 * byte),
            Fault::DriverHeld => self.lines[line].hold = self.random.between(byte, 5 * MILLIS),
            Fault::Noise => {
                let noise: Vec<u8> = (0..self.random.between(1, 300)).map(|_| self.random.byte()).collect();
                let end = now.saturating_add(noise.len() as u64 * byte);
                self.lines[line].noise.extend(noise);
                self.enter_noise(line, now);
                return end;
            }
            Fault::LineCut | Fault::LineBreak => {
                if fault == Fault::LineBreak {
                    self.lines[line].noise.push(0);
                    let intruder = self.lines[line].devices.len() + 1;
                    self.lines[line].line.tamper(intruder, 0, Tamper::Framing);
                    self.enter_noise(line, now);
                }
                let end = now.saturating_add(span);
                // the break itself is heard
                let cut = if fault == Fault::LineBreak { now.saturating_add(byte) } else { now };
                self.lines[line].line.cut(cut, end);
                return end;
            }
            Fault::DeviceDead => {
                let device = self.random.index(self.lines[line].devices.len());
                let end = now.saturating_add(span);
                self.lines[line].devices[device].absent = end;
                return end;
            }
            Fault::DeviceBabbles => {
                let end = now.saturating_add(span);
                let bytes = span / byte;
                let noise: Vec<u8> = (0..bytes).map(|_| self.random.byte()).collect();
                self.lines[line].noise.extend(noise);
                self.enter_noise(line, now);
                return end;
            }
            _ => self.lines[line].armed.push_back(fault),
        }
        now
    }

    /// How long something lasts.
    const fn span(&mut self) -> Nanos {
        let longest = if self.random.chance(100_000) { LONGEST } else { LONG };
        self.random.between(MILLIS, longest)
    }

    fn inject_can(&mut self, fault: Fault, can: usize) -> Moment {
        let (now, span) = (self.now, self.span());
        let net = &mut self.nets[can];
        let sender = self.random.index(1 + net.nodes.len());
        let intruder = net.nodes.len() + 1;
        let own = self.settings.network.ports[net.port.index()].node;
        match fault {
            Fault::CanBit => {
                let at = self.random.between(1, 120);
                net.wire.disturbances.push_back((sender, Disturbance::Bit(at)));
            }
            Fault::CanBusOff => {
                let at = self.random.between(1, 60);
                let bits = std::iter::repeat_n((BRIDGE, Disturbance::Bit(at)), TO_BUS_OFF);
                net.wire.disturbances.extend(bits);
            }
            Fault::CanFrameLost => net.wire.disturbances.push_back((sender, Disturbance::Lost)),
            // the bridge's own frame arriving twice would be a command carried out twice, and nobody's fault but CAN's
            Fault::CanFrameDoubled => {
                net.wire.disturbances.push_back((sender.max(1), Disturbance::Doubled));
            }
            Fault::CanNoAcknowledgement => {
                let all: Vec<usize> = (0..net.nodes.len()).collect();
                self.darken(can, &all, now.saturating_add(span));
                return now.saturating_add(span);
            }
            Fault::CanDeviceDead => {
                let node = self.random.index(net.nodes.len());
                self.darken(can, &[node], now.saturating_add(span));
                return now.saturating_add(span);
            }
            Fault::CanDominant => {
                let end = now.saturating_add(span);
                self.hold_can(can, end);
                return end;
            }
            Fault::CanForeignTraffic
            | Fault::CanForeignFrames
            | Fault::CanStandardFrames
            | Fault::CanForeignTransfer => {
                let frames = self.foreign_frames(fault, own);
                let wire = &mut self.nets[can].wire;
                let end = now.saturating_add(wire.bits(160) * frames.len() as u64);
                wire.controllers[intruder].outbox.extend(frames);
                self.move_can(can);
                return end;
            }
            _ => net.armed.push_back(fault),
        }
        now
    }

    /// Frames of nodes that the bridge does not know.
    fn foreign_frames(&mut self, fault: Fault, own: u8) -> Vec<Frame> {
        let mut data = [0; 40];
        data.iter_mut().for_each(|byte| *byte = self.random.byte());
        match fault {
            Fault::CanStandardFrames => (0..self.random.between(1, 20))
                .filter_map(|_| {
                    Frame::data_frame(Id::Standard(self.random.below(1 << 11) as u16), &data[..8]).ok()
                })
                .collect(),
            Fault::CanForeignTraffic => (0..self.random.between(10, 300))
                .filter_map(|_| {
                    // from node 0x40 and up to node 0x60 and up, all kinds of frames
                    let id = 0x0040_6000 | (self.random.next() as u32 & 0x001F_0FFF);
                    let length = self.random.index(9);
                    Frame::data_frame(Id::Extended(id), &data[..length]).ok()
                })
                .collect(),
            Fault::CanForeignFrames => (0..self.random.between(1, 20))
                .filter_map(|_| {
                    let id = 0x0040_0000 | u32::from(own) << 8 | (self.random.next() as u32 & 0x001F_00FF);
                    let length = self.random.index(9);
                    Frame::data_frame(Id::Extended(id), &data[..length]).ok()
                })
                .collect(),
            _ => {
                // what a reply looks like, but from a node that was not asked
                data[..2].copy_from_slice(&[0x03, 18]);
                let length = self.random.pick(&[2usize, 20, 40]);
                let source = 0x40 + self.random.below(8) as u8;
                segment(source, own, &data[..length]).map(Iterator::collect).unwrap_or_default()
            }
        }
    }

    /// Holds a CAN bus dominant until `end`.
    fn hold_can(&mut self, can: usize, end: Moment) {
        if let Some(victim) = self.nets[can].wire.hold_dominant(self.now, end) {
            self.failed_frame(can, victim);
        }
        self.nets[can].released = Some(end);
        self.can_looks_again(can, end);
        // the bus is looked at again when it is idle
        self.can_looks_again(can, end.saturating_add(20 * MICROS));
    }
}
