//! The CAN buses: what becomes of frames, and what the nodes hear and answer.

use super::{Event, Notice, World};
use crate::sim::can_wire::{Ended, Ending};
use crate::sim::fault::Fault;
use crate::sim::firmware::CONTROLLER;
use crate::sim::moment::Moment;
use crate::sim::station::{self, timeout_of};
use jointbus_protocol::can::Frame;

impl World<'_> {
    /// Lets a bus go on, and looks again when something ends there.
    pub(super) fn move_can(&mut self, can: usize) {
        while let Some(ended) = self.nets[can].wire.end(self.now) {
            self.frame_ended(can, &ended);
        }
        let net = &mut self.nets[can];
        let next = net.wire.start(self.now).or_else(|| net.wire.recovery(self.now));
        if let Some(next) = next.map(|next| next.max(self.now.saturating_add(1)))
            && net.due.is_none_or(|due| next < due)
        {
            net.due = Some(next);
            self.agenda.enter(next, Event::Can { can });
        }
    }

    fn frame_ended(&mut self, can: usize, ended: &Ended) {
        let own = ended.sender == CONTROLLER;
        let port = self.nets[can].port;
        let Ending::Acknowledged { times } = ended.ending else {
            self.firmware.on_error(can, own);
            self.interrupt();
            return;
        };
        if let Some(recorder) = &mut self.recorder {
            recorder.frame(port, self.now, &ended.frame);
        }
        if own {
            self.firmware.on_sent(can, self.now.instant());
            self.interrupt();
            self.notices.push_back(Notice::CanFrame { port, frame: ended.frame, start: ended.start });
        }
        for _ in 0..times {
            if !own && self.firmware.on_frame(can, &ended.frame, self.now.instant()) {
                self.interrupt();
                self.notices.push_back(Notice::BridgeHears { port, frame: ended.frame });
            }
            for node in 0..self.nets[can].nodes.len() {
                if node + 1 != ended.sender && self.nets[can].wire.controllers[node + 1].powered {
                    self.node_hears(can, node, &ended.frame);
                }
            }
        }
    }

    fn node_hears(&mut self, can: usize, node: usize, frame: &Frame) {
        let net = &mut self.nets[can];
        let station = &mut net.nodes[node];
        let mut reply = station.hear(frame, self.now);
        if let Some((address, order)) = station.new_orders() {
            self.notices.push_back(Notice::Ordered { port: net.port, address, order });
        }
        if reply.is_empty() {
            return;
        }
        let function = reply.first().and_then(|first| first.payload().first().copied());
        let timeout = timeout_of(true, function);
        let mut delay = station.delay.draw(timeout, &mut self.random);
        let mut again = None;
        // these two need a reply of their kind
        let fits = |fault: Fault| match fault {
            Fault::CanFramesSwapped => reply.len() > 1,
            Fault::CanQuirk => function == Some(0x03),
            _ => true,
        };
        let fault = match net.armed.front() {
            Some(fault) if fits(*fault) => net.armed.pop_front(),
            _ => None,
        };
        if let Some(fault) = fault {
            delay += station::spoil_frames(fault, &mut reply, timeout, &mut again, &mut self.random);
        }
        // nobody could tell a reply that is later than this from the next one
        let latest = self.now.saturating_add(3 * timeout);
        let copy = again.map(|later| (self.now.saturating_add(delay + later), reply.clone()));
        for (at, reply) in [Some((self.now.saturating_add(delay), reply)), copy].into_iter().flatten() {
            if let Some(at) = station.queue(at, latest, reply) {
                self.agenda.enter(at, Event::NodeReply { can, node });
            }
        }
    }

    /// A frame of this controller was destroyed.
    pub(super) fn failed_frame(&mut self, can: usize, sender: usize) {
        self.firmware.on_error(can, sender == CONTROLLER);
        self.interrupt();
        self.nets[can].due = None;
    }

    /// Has a bus looked at again at that moment.
    pub(super) fn can_looks_again(&mut self, can: usize, at: Moment) {
        self.agenda.enter(at, Event::CanBack { can });
    }

    /// Takes the power of some nodes until `end`.
    pub(super) fn darken(&mut self, can: usize, nodes: &[usize], end: Moment) {
        for node in nodes {
            self.nets[can].nodes[*node].absent = end;
        }
        self.power_nodes(can);
        self.agenda.enter(end, Event::CanBack { can });
    }

    pub(super) fn power_nodes(&mut self, can: usize) {
        let net = &mut self.nets[can];
        // devices give up what they could not send meanwhile; nobody could tell it from the next reply
        let released = net.released.take_if(|end| self.now >= *end).is_some();
        let mut anybody = false;
        for (node, controller) in net.nodes.iter().zip(net.wire.controllers.iter_mut().skip(1)) {
            controller.powered = self.now >= node.absent;
            anybody |= controller.powered;
            if !controller.powered || released {
                controller.outbox.clear();
            }
        }
        // the intruder listens only where somebody else does
        if let Some(intruder) = net.wire.controllers.last_mut() {
            intruder.powered = anybody;
        }
        self.move_can(can);
    }
}
