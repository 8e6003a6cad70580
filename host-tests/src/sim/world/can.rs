//! The CAN bus: what becomes of frames, and what the nodes hear and answer.

use super::{Event, Notice, World};
use crate::sim::board::CONTROLLER;
use crate::sim::can_wire::{Ended, Ending};
use crate::sim::fault::Fault;
use crate::sim::moment::Moment;
use crate::sim::station::{self, timeout_of};
use jointbus_mcu_bridge::boards::stm32f405::CAN;
use jointbus_protocol::can::Frame;

impl World<'_> {
    /// Lets the bus go on, and looks again when something ends there.
    pub(super) fn move_can(&mut self) {
        while let Some(ended) = self.can.end(self.now) {
            self.frame_ended(&ended);
        }
        let next = self.can.start(self.now).or_else(|| self.can.recovery(self.now));
        if let Some(next) = next.map(|next| next.max(self.now.saturating_add(1)))
            && self.can_due.is_none_or(|due| next < due)
        {
            self.can_due = Some(next);
            self.agenda.enter(next, Event::Can);
        }
    }

    fn frame_ended(&mut self, ended: &Ended) {
        let own = ended.sender == CONTROLLER;
        let Ending::Acknowledged { times } = ended.ending else {
            self.board.on_error(own);
            self.interrupt();
            return;
        };
        if let Some(recorder) = &mut self.recorder {
            recorder.frame(self.now, &ended.frame);
        }
        if own {
            self.board.on_sent(self.now.instant());
            self.interrupt();
            self.notices.push_back(Notice::CanFrame { frame: ended.frame, start: ended.start });
        }
        for _ in 0..times {
            if !own && self.board.on_frame(&ended.frame, self.now.instant()) {
                self.interrupt();
                self.notices.push_back(Notice::BridgeHears(ended.frame));
            }
            for node in 0..self.nodes.len() {
                if node + 1 != ended.sender && self.can.controllers[node + 1].powered {
                    self.node_hears(node, &ended.frame);
                }
            }
        }
    }

    fn node_hears(&mut self, node: usize, frame: &Frame) {
        let station = &mut self.nodes[node];
        let mut reply = station.hear(frame, self.now);
        if let Some((address, order)) = station.new_orders() {
            self.notices.push_back(Notice::Ordered { port: CAN, address, order });
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
        let fault = match self.can_armed.front() {
            Some(fault) if fits(*fault) => self.can_armed.pop_front(),
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
                self.agenda.enter(at, Event::NodeReply { node });
            }
        }
    }

    /// A frame of this controller was destroyed.
    pub(super) fn failed_frame(&mut self, sender: usize) {
        self.board.on_error(sender == CONTROLLER);
        self.interrupt();
        self.can_due = None;
    }

    /// Has the bus looked at again at that moment.
    pub(super) fn can_looks_again(&mut self, at: Moment) {
        self.agenda.enter(at, Event::CanBack);
    }

    /// Takes the power of some nodes until `end`.
    pub(super) fn darken(&mut self, nodes: &[usize], end: Moment) {
        for node in nodes {
            self.nodes[*node].absent = end;
        }
        self.power_nodes();
        self.agenda.enter(end, Event::CanBack);
    }

    pub(super) fn power_nodes(&mut self) {
        // devices give up what they could not send meanwhile; nobody could tell it from the next reply
        let released = self.can_released.take_if(|end| self.now >= *end).is_some();
        let mut anybody = false;
        for (node, controller) in self.nodes.iter().zip(self.can.controllers.iter_mut().skip(1)) {
            controller.powered = self.now >= node.absent;
            anybody |= controller.powered;
            if !controller.powered || released {
                controller.outbox.clear();
            }
        }
        // the intruder listens only where somebody else does
        if let Some(intruder) = self.can.controllers.last_mut() {
            intruder.powered = anybody;
        }
        self.move_can();
    }
}
