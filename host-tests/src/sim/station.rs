//! The devices on the wires: those of [`devices`](jointbus::devices), with reply times and bad habits.

use super::delay::Delay;
use super::fault::Fault;
use super::framing;
use super::moment::{MILLIS, Moment, Nanos};
use super::random::Random;
use jointbus::devices::{
    CanBus, Motion, NdamLine, NstCan, NstSerial, Order, PROMPT, Sensor, SerialLine, Wiring,
};
use jointbus_mcu_bridge::board::Port;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::checksum;
use jointbus_protocol::modbus::ascii;
use jointbus_protocol::ndam9010::Layout;
use jointbus_protocol::time::{Duration, Instant};
use std::collections::VecDeque;

/// Modules of the station.
pub const MODULES: usize = 5;

/// Channels of each module.
pub const LAYOUT: Layout =
    Layout { digital_inputs: 16, digital_outputs: 16, analog_inputs: 16, analog_outputs: 16 };

/// Registers of a sensor that hold a pattern and are never written.
pub const PATTERN: std::ops::Range<u16> = 0x0040..0x0173;

/// Registers of a sensor that are written.
pub const SCRATCH: std::ops::Range<u16> = 0x0000..0x0040;

/// The number of a device, which no other one has, on whatever bus.
#[must_use]
pub const fn device_number(port: Port, address: u8) -> u8 {
    port.number() << 5 | address & 0x1F
}

/// What a sensor has in a register of [`PATTERN`]: three bytes in a row name their place. The device is a
/// [`device_number`].
#[must_use]
pub const fn pattern(device: u8, register: u16) -> u8 {
    let mixed =
        (register as u32).wrapping_mul(0x9E37_79B1).wrapping_add((device as u32).wrapping_mul(0x85EB_CA6B));
    ((mixed ^ mixed >> 15).wrapping_mul(0x2C1B_3C6D) >> 24) as u8
}

/// A sensor for the simulation: its axes spell the moment, its registers hold [`pattern`].
fn sensor(port: Port, address: u8, wiring: Wiring) -> Sensor {
    let mut sensor = Sensor::new(address, wiring, Motion::spelling());
    let bytes: Vec<u8> = PATTERN.map(|register| pattern(device_number(port, address), register)).collect();
    let written = sensor.daq().hardware().settings.write(PATTERN.start, &bytes);
    assert!(written.is_ok(), "registers that are never written hold anything");
    sensor
}

/// What is on an RS485 line.
#[derive(Debug)]
pub enum SerialDevice {
    /// A sensor.
    Sensor(Box<NstSerial>),
    /// A station.
    Station(Box<NdamLine<MODULES>>),
}

/// A device on an RS485 line.
#[derive(Debug)]
pub struct SerialStation {
    /// The device.
    pub device: SerialDevice,
    /// How long it takes to answer.
    pub delay: Delay,
    /// Without power until then.
    pub absent: Moment,
    /// The module of a station that does not answer.
    pub without: Option<usize>,
    /// When it is to be told the time; one entry of the agenda at most.
    pub(super) polled: Option<Moment>,
    /// The line speaks Modbus ASCII: what is between its characters and the device.
    ascii: Option<ascii::Decoder>,
    replies: VecDeque<(Moment, Vec<u8>)>,
    orders_seen: u64,
}

impl SerialStation {
    /// A sensor at `address` on the bus of a port, for which `silence` ends a burst.
    #[must_use]
    pub fn sensor(port: Port, address: u8, silence: Duration, delay: Delay) -> Self {
        let line = NstSerial::new(silence).with(sensor(port, address, Wiring::Rs485));
        Self::new(SerialDevice::Sensor(Box::new(line)), delay)
    }

    /// A station whose modules are the units from 1, in Modbus RTU or ASCII.
    #[must_use]
    pub fn station(delay: Delay, is_ascii: bool) -> Self {
        let line =
            NdamLine::new(LAYOUT, 1, PROMPT).unwrap_or_else(|_| unreachable!("eight modules fit from 1"));
        let ascii = is_ascii.then(ascii::Decoder::new);
        Self { ascii, ..Self::new(SerialDevice::Station(Box::new(line.spelling())), delay) }
    }

    fn new(device: SerialDevice, delay: Delay) -> Self {
        let (absent, replies) = (Moment::default(), VecDeque::new());
        Self { device, delay, absent, without: None, polled: None, ascii: None, replies, orders_seen: 0 }
    }

    fn line(&mut self) -> &mut dyn SerialLine {
        match &mut self.device {
            SerialDevice::Sensor(line) => &mut **line,
            SerialDevice::Station(line) => &mut **line,
        }
    }

    /// Takes a byte, or with none the time; what it answers.
    pub(super) fn hear(&mut self, byte: Option<u8>, now: Moment) -> Vec<u8> {
        if now < self.absent {
            return Vec::new();
        }
        let reply = match (byte, &mut self.ascii) {
            (Some(byte), None) => self.line().receive(&[byte], now.instant()),
            (Some(byte), Some(decoder)) => {
                let frame = match decoder.feed(&mut &[byte][..], now.instant()) {
                    Some(ascii::Event::Frame(frame)) => framing::sealed(&frame),
                    _ => return Vec::new(),
                };
                self.line().receive(&frame, now.instant())
            }
            (None, _) => self.line().poll(now.instant()),
        };
        let dead = self.without.map(|index| index as u8 + 1);
        if dead.is_some() && reply.first().copied() == dead { Vec::new() } else { reply }
    }

    /// When it wants to be told the time.
    pub(super) fn deadline(&mut self) -> Option<Instant> {
        self.line().deadline()
    }

    /// The orders carried out since this was asked last, each with the address that was meant.
    pub(super) fn new_orders(&mut self) -> Option<(u8, Order)> {
        let (total, newest) = match &mut self.device {
            SerialDevice::Sensor(line) => {
                let sensor = line.sensors().first()?;
                let address = sensor.address();
                (sensor.orders().total(), sensor.orders().newest().map(|(_, order)| (address, *order)))
            }
            SerialDevice::Station(line) => {
                (line.orders().total(), line.orders().newest().map(|(_, order)| *order))
            }
        };
        let new = total > self.orders_seen;
        self.orders_seen = total;
        newest.filter(|_| new)
    }

    /// Has a reply sent at that moment, or behind those before it; not at all if that is later than `latest`.
    pub(super) fn queue(&mut self, at: Moment, latest: Moment, reply: Vec<u8>) -> Option<Moment> {
        let at = self.replies.back().map_or(at, |(before, _)| at.max(*before));
        let reply = if self.ascii.is_some() { framing::in_characters(&reply) } else { reply };
        (at <= latest).then(|| {
            self.replies.push_back((at, reply));
            at
        })
    }

    /// The reply that is due; none from a device that lost its power meanwhile.
    pub(super) fn due(&mut self, now: Moment) -> Option<Vec<u8>> {
        let (_, reply) = self.replies.pop_front()?;
        (now >= self.absent).then_some(reply)
    }
}

/// A device on a CAN bus.
#[derive(Debug)]
pub struct CanStation {
    /// Its node.
    pub node: u8,
    /// The device.
    pub device: NstCan,
    /// How long it takes to answer.
    pub delay: Delay,
    /// Without power until then.
    pub absent: Moment,
    replies: VecDeque<(Moment, Vec<Frame>)>,
    orders_seen: u64,
}

impl CanStation {
    /// A sensor as this node of the bus of a port.
    #[must_use]
    pub fn sensor(port: Port, node: u8, delay: Delay) -> Self {
        let device = NstCan::new(PROMPT).with(sensor(port, node, Wiring::Can));
        Self { node, device, delay, absent: Moment::default(), replies: VecDeque::new(), orders_seen: 0 }
    }

    /// Takes a frame; what it answers.
    pub(super) fn hear(&mut self, frame: &Frame, now: Moment) -> Vec<Frame> {
        self.device.receive(frame, now.instant())
    }

    pub(super) fn new_orders(&mut self) -> Option<(u8, Order)> {
        let node = self.node;
        let orders = self.device.sensors().next()?.orders();
        let new = orders.total() > self.orders_seen;
        self.orders_seen = orders.total();
        orders.newest().filter(|_| new).map(|(_, order)| (node, *order))
    }

    pub(super) fn queue(&mut self, at: Moment, latest: Moment, reply: Vec<Frame>) -> Option<Moment> {
        let at = self.replies.back().map_or(at, |(before, _)| at.max(*before));
        (at <= latest).then(|| {
            self.replies.push_back((at, reply));
            at
        })
    }

    pub(super) fn due(&mut self, now: Moment) -> Option<Vec<Frame>> {
        let (_, reply) = self.replies.pop_front()?;
        (now >= self.absent).then_some(reply)
    }
}

/// How long the default bridge waits for the reply that starts with this function code.
pub(super) const fn timeout_of(nst: bool, function: Option<u8>) -> Nanos {
    match (nst, function) {
        (true, Some(0x03 | 0x15)) => 50 * MILLIS,
        (false, Some(1..=4 | 0x81..=0x84)) => 200 * MILLIS,
        _ => 500 * MILLIS,
    }
}

/// How late a reply comes that is beyond its timeout: one to three times that.
pub(super) const fn too_late(timeout: Nanos, random: &mut Random) -> Nanos {
    timeout + random.below(2 * timeout)
}

/// What a bad habit makes of a reply: how much later it starts, and what is sent.
pub(super) fn spoil(
    fault: Fault,
    reply: &mut Vec<u8>,
    timeout: Nanos,
    again: &mut Option<Nanos>,
    random: &mut Random,
) -> Nanos {
    let place = random.index(reply.len());
    match fault {
        Fault::ReplyBits => flip_bits(reply, random),
        Fault::ReplyByteLost => {
            reply.remove(place);
        }
        Fault::ReplyByteDoubled => reply.insert(place, reply[place]),
        Fault::ReplyCut => reply.truncate(place.max(1)),
        Fault::NoiseBefore => {
            let noise: Vec<u8> = (0..random.between(1, 20)).map(|_| random.byte()).collect();
            reply.splice(0..0, noise);
        }
        Fault::NoiseAfter => (0..random.between(1, 20)).for_each(|_| reply.push(random.byte())),
        Fault::ReplyLate => return too_late(timeout, random),
        Fault::ReplyTwice => *again = Some(0),
        Fault::ReplyOtherUnit => {
            reply[0] = reply[0] % 16 + 1;
            reseal(reply);
        }
        Fault::ReplyOtherFunction => {
            reply[1] = random.pick(
                &[0x03, 0x04, 0x06, 0x10, 0x12, 0x19, 0x55].map(|other| other + u8::from(other == reply[1])),
            );
            reseal(reply);
        }
        Fault::ReplyOtherLength => {
            let length = reply.len() - checksum::CRC_LENGTH;
            reply.truncate(length);
            match random.below(2) {
                0 => reply.push(random.byte()),
                _ => reply.truncate((length - 1).max(2)),
            }
            reply.extend([0; checksum::CRC_LENGTH]);
            if let Some(count) = reply.get_mut(2).filter(|_| random.below(2) == 0) {
                *count = (length as u8).wrapping_sub(3);
            }
            reseal(reply);
        }
        Fault::ReplyException => {
            let [unit, function] = [reply[0], reply[1] | 0x80];
            *reply = vec![unit, function, random.pick(&[4, 5]), 0, 0];
            reseal(reply);
        }
        Fault::WrongBaud => {
            let length = random.between(1, 2 * reply.len() as u64);
            *reply = (0..length).map(|_| random.byte()).collect();
        }
        _ => {}
    }
    0
}

/// Makes one to three bits wrong.
pub(super) fn flip_bits(bytes: &mut [u8], random: &mut Random) {
    let before = bytes.to_vec();
    while *bytes == *before {
        for _ in 0..random.between(1, 3) {
            let place = random.index(bytes.len());
            bytes[place] ^= 1 << random.below(8);
        }
    }
}

/// Puts the right CRC at the end.
pub(super) fn reseal(frame: &mut [u8]) {
    if let Some((content, crc)) = frame.split_last_chunk_mut::<{ checksum::CRC_LENGTH }>() {
        *crc = checksum::crc16(content).to_le_bytes();
    }
}

/// The same for a reply on CAN.
pub(super) fn spoil_frames(
    fault: Fault,
    reply: &mut Vec<Frame>,
    timeout: Nanos,
    again: &mut Option<Nanos>,
    random: &mut Random,
) -> Nanos {
    let place = random.index(reply.len());
    let raw = |frame: &Frame| match frame.id() {
        Id::Extended(raw) => raw,
        Id::Standard(raw) => raw.into(),
    };
    let renamed = |frame: &Frame, id: u32| {
        Frame::from_parts(Id::Extended(id), false, frame.dlc(), *frame.payload()).unwrap_or(*frame)
    };
    let chosen = reply[place];
    match fault {
        Fault::CanFramesSwapped if reply.len() > 1 => {
            let place = place.min(reply.len() - 2);
            reply.swap(place, place + 1);
        }
        Fault::CanWrongCounter => {
            reply[place] = renamed(&chosen, raw(&chosen) ^ (1 + random.below(15) as u32))
        }
        Fault::CanWrongType => reply[place] = renamed(&chosen, raw(&chosen) & !0xF0 | 0x30),
        Fault::CanWrongDestination => reply[place] = renamed(&chosen, raw(&chosen) ^ 0x100),
        Fault::CanLongCode => {
            let code = random.between(9, 15) as u8;
            reply[place] = Frame::from_parts(chosen.id(), false, code, *chosen.payload()).unwrap_or(chosen);
        }
        Fault::CanQuirk => {
            let mut data = *reply[0].payload();
            if data[0] == 0x03 {
                data[0] = 0x10;
                reply[0] = Frame::from_parts(reply[0].id(), false, reply[0].dlc(), data).unwrap_or(reply[0]);
            }
        }
        Fault::CanRemoteFrames => {
            if let Ok(remote) = Frame::from_parts(chosen.id(), true, chosen.dlc(), [0; 8]) {
                reply.insert(place, remote);
            }
        }
        Fault::CanReplyLate => return too_late(timeout, random),
        Fault::CanReplyTwice => *again = Some(0),
        _ => {}
    }
    0
}
