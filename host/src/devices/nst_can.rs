use super::{CanBus, Motion, Sensor, Wiring};
use jointbus_protocol::can::Frame;
use jointbus_protocol::nst::REPLY_DATA_MAX;
use jointbus_protocol::nst::can::{Outcome, Reassembler, segment};
use jointbus_protocol::nst::serial::RESPONSE_MAX;
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::Writer;

/// Hosts whose transfers a sensor takes at once.
const HOSTS: usize = 4;

/// NST sensors on one CAN bus; a sensor's address is its node. Acknowledging frames is the controller's business.
#[derive(Debug)]
pub struct NstCan {
    limit: Duration,
    nodes: Vec<Node>,
}

#[derive(Debug)]
struct Node {
    sensor: Sensor,
    reassembler: Reassembler<HOSTS>,
}

impl NstCan {
    /// A bus with nothing on it; the frames of a transfer come at most `limit` apart.
    #[must_use]
    pub const fn new(limit: Duration) -> Self {
        Self { limit, nodes: Vec::new() }
    }

    /// Puts a sensor on the bus as this node, its motion the one of that number.
    #[must_use]
    pub fn with_sensor(self, node: u8) -> Self {
        self.with(Sensor::new(node, Wiring::Can, Motion::new(node)))
    }

    /// Puts this sensor on the bus.
    #[must_use]
    pub fn with(mut self, sensor: Sensor) -> Self {
        let reassembler = Reassembler::new(sensor.address(), self.limit);
        self.nodes.push(Node { sensor, reassembler });
        self
    }

    /// The sensors, in the order in which they were put on.
    pub fn sensors(&mut self) -> impl Iterator<Item = &mut Sensor> {
        self.nodes.iter_mut().map(|node| &mut node.sensor)
    }

    /// The first sensor that uses this node.
    pub fn sensor(&mut self, node: u8) -> Option<&mut Sensor> {
        self.sensors().find(|sensor| sensor.address() == node)
    }
}

impl Node {
    /// Takes a frame; adds the answer's frames.
    fn receive(&mut self, frame: &Frame, now: Instant, out: &mut Vec<Frame>) {
        if !self.sensor.is_plugged() {
            self.reassembler.clear();
            return;
        }
        let node = self.sensor.address();
        let report = self.reassembler.push(frame, now);
        let Some(Outcome::Complete { source, destination, body }) = report.outcome else { return };
        let mut buffer = [0; RESPONSE_MAX];
        let reply = self.sensor.answer(body, now, |daq| {
            let mut data = [0; REPLY_DATA_MAX];
            let reply = daq.serve(destination, body, &mut data)?;
            let mut writer = Writer::new(&mut buffer);
            // the buffer holds the longest reply
            reply.encode(&mut writer).map_err(|_| jointbus_protocol::nst::NoResponse::NoSpace)?;
            Ok(writer.finish())
        });
        // what does not fit a transfer can't be sent: the sensor stays silent
        if let Some(frames) = reply.and_then(|body| segment(node, source, body).ok()) {
            out.extend(frames);
        }
        if self.sensor.address() != node {
            self.reassembler.set_node(self.sensor.address());
        }
    }
}

impl CanBus for NstCan {
    fn receive(&mut self, frame: &Frame, now: Instant) -> Vec<Frame> {
        let mut out = Vec::new();
        for node in &mut self.nodes {
            node.receive(frame, now, &mut out);
        }
        out
    }
}
