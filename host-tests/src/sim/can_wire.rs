//! The CAN bus: who sends when, what becomes of a frame, and what the controllers count.

use super::can_bits::{self, ERROR_FRAME, IDLE, INTERMISSION, SUSPEND};
use super::moment::{Moment, Nanos};
use jointbus_protocol::can::Frame;
use std::collections::VecDeque;

/// Transmit errors above which a controller is error passive.
const PASSIVE: u16 = 127;

/// Transmit errors above which a controller is bus-off.
const BUS_OFF: u16 = 255;

/// What one error adds to the errors of the sender.
const TRANSMIT_PENALTY: u16 = 8;

/// Idle sequences that end bus-off.
const RECOVERY: u64 = 128;

/// A CAN controller with its error counters (ISO 11898-1, 8.3).
#[derive(Debug, Default)]
pub struct Controller {
    /// Frames to send, in order.
    pub outbox: VecDeque<Frame>,
    /// Whether it is on the bus at all; one that is not acknowledges nothing.
    pub powered: bool,
    /// Transmit error counter.
    pub transmit_errors: u16,
    /// Receive error counter.
    pub receive_errors: u16,
    /// Whether it stays bus-off until its owner restarts it.
    pub waits_for_restart: bool,
    /// Idle sequences until it is no longer bus-off.
    recovery: Option<u64>,
    /// Bus-off, and not restarted.
    halted: bool,
    /// Not before: an error passive sender lets others go first.
    suspended: Moment,
    /// The frame on the wire is not sent again if it fails.
    given_up: bool,
}

impl Controller {
    /// Whether it is bus-off.
    #[must_use]
    pub const fn is_bus_off(&self) -> bool {
        self.recovery.is_some()
    }

    const fn takes_part(&self) -> bool {
        self.powered && !self.is_bus_off()
    }

    /// Notes a failed attempt to send; the counter stands still where `counts` is false.
    fn failed(&mut self, counts: bool) {
        if std::mem::take(&mut self.given_up) {
            self.outbox.pop_front();
        }
        if counts {
            self.transmit_errors += TRANSMIT_PENALTY;
        }
        if self.transmit_errors > BUS_OFF {
            (self.transmit_errors, self.receive_errors) = (0, 0);
            self.recovery = Some(RECOVERY);
            self.halted = self.waits_for_restart;
        }
    }

    /// Lets idle sequences count.
    fn recover(&mut self, sequences: u64) {
        if !self.halted {
            self.recovery = self.recovery.map(|left| left.saturating_sub(sequences)).filter(|left| *left > 0);
        }
    }
}

/// What is to happen to the next frame of a sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disturbance {
    /// A bit is wrong so many bits into the frame: everybody sees an error, and the controller sends it again.
    Bit(u64),
    /// Nobody takes it, though somebody acknowledges it: the receivers have no room.
    Lost,
    /// It arrives twice: the sender missed the acknowledgement.
    Doubled,
}

/// What became of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// Somebody acknowledged it; it reaches the others so many times.
    Acknowledged {
        /// How often it arrives.
        times: u8,
    },
    /// Nobody did, or a bit was wrong.
    Failed,
}

/// A frame on the wire.
#[derive(Debug, Clone, Copy)]
struct OnWire {
    sender: usize,
    frame: Frame,
    start: Moment,
    end: Moment,
    ending: Ending,
    /// Whether the failure is one of acknowledgement alone.
    unacknowledged: bool,
}

/// A frame that has left the wire.
#[derive(Debug, Clone, Copy)]
pub struct Ended {
    /// Index of the controller that sent it.
    pub sender: usize,
    /// The frame.
    pub frame: Frame,
    /// When it started.
    pub start: Moment,
    /// What became of it.
    pub ending: Ending,
}

/// The bus and its controllers; index 0 is the bridge's.
#[derive(Debug)]
pub struct CanWire {
    /// The controllers.
    pub controllers: Vec<Controller>,
    /// What happens to the next frames: sender and disturbance, each used once.
    pub disturbances: VecDeque<(usize, Disturbance)>,
    bit: Nanos,
    on_wire: Option<OnWire>,
    /// When the next frame may start.
    free: Moment,
    /// Held dominant until then.
    stuck: Option<Moment>,
    /// Up to here the recessive bits have been counted for those that are bus-off.
    counted: Moment,
}

impl CanWire {
    /// A bus at so many kbit/s with this many controllers.
    #[must_use]
    pub fn new(kbit_per_s: u32, controllers: usize) -> Self {
        Self {
            controllers: (0..controllers)
                .map(|_| Controller { powered: true, ..Controller::default() })
                .collect(),
            disturbances: VecDeque::new(),
            bit: 1_000_000 / Nanos::from(kbit_per_s),
            on_wire: None,
            free: Moment::default(),
            stuck: None,
            counted: Moment::default(),
        }
    }

    /// The time that so many bits take.
    #[must_use]
    pub const fn bits(&self, count: u64) -> Nanos {
        self.bit * count
    }

    /// Whether this controller is sending right now.
    #[must_use]
    pub fn is_sending(&self, controller: usize) -> bool {
        self.on_wire.is_some_and(|on_wire| on_wire.sender == controller)
    }

    /// Gives up the frames of a controller; one that is on the wire has this last attempt.
    pub fn abort(&mut self, controller: usize) {
        let sending = self.is_sending(controller);
        let controller = &mut self.controllers[controller];
        controller.outbox.truncate(usize::from(sending));
        controller.given_up = sending;
    }

    /// Restarts a controller: from now on idle sequences end its bus-off.
    pub fn restart(&mut self, controller: usize, now: Moment) {
        self.count_idle(now);
        self.controllers[controller].halted = false;
    }

    /// Holds the bus dominant until `end`. A frame on the wire is destroyed; its sender, which hears dominant bits for
    /// ever, goes bus-off unless that ends soon. The answer is whose frame it was.
    pub fn hold_dominant(&mut self, now: Moment, end: Moment) -> Option<usize> {
        self.count_idle(now);
        self.stuck = Some(end);
        self.free = end.saturating_add(self.bits(IDLE));
        self.counted = end;
        let victim = self.on_wire.take()?.sender;
        // eight more for each eight dominant bits behind the error flag
        let octets = end.saturating_duration_since(now) / self.bits(8);
        for _ in 0..=octets {
            let controller = &mut self.controllers[victim];
            if !controller.is_bus_off() {
                controller.failed(true);
            }
        }
        Some(victim)
    }

    /// Starts a frame if one may start. The answer is when to call [`CanWire::end`], or to ask again.
    pub fn start(&mut self, now: Moment) -> Option<Moment> {
        if let Some(on_wire) = &self.on_wire {
            return Some(on_wire.end);
        }
        self.count_idle(now);
        if self.stuck.is_some_and(|end| now >= end) {
            self.stuck = None;
        }
        let wants = |controller: &Controller| controller.powered && !controller.outbox.is_empty();
        if now < self.free {
            return self.controllers.iter().any(wants).then_some(self.free);
        }
        let candidates = self.controllers.iter().enumerate().filter_map(|(index, controller)| {
            let frame = controller.outbox.front().filter(|_| controller.takes_part())?;
            (now >= controller.suspended).then(|| (can_bits::arbitration(frame), index, *frame))
        });
        if let Some((_, sender, frame)) = candidates.min_by_key(|(key, index, _)| (*key, *index)) {
            return Some(self.put_on_wire(sender, frame, now));
        }
        // somebody wants to send who may not yet: bus-off or error passive
        let later = self.controllers.iter().filter(|it| wants(it) && !it.halted).map(|controller| {
            match controller.recovery {
                Some(sequences) => now.saturating_add(self.bits(sequences * IDLE)),
                None => controller.suspended,
            }
        });
        later.min()
    }

    /// When those that are bus-off come back if the bus stays idle.
    #[must_use]
    pub fn recovery(&self, now: Moment) -> Option<Moment> {
        let counting = self.controllers.iter().filter(|controller| !controller.halted);
        let sequences = counting.filter_map(|controller| controller.recovery).min()?;
        Some(now.max(self.counted).saturating_add(self.bits(sequences.max(1) * IDLE)))
    }

    /// Takes a frame off the wire that ends at `now`.
    pub fn end(&mut self, now: Moment) -> Option<Ended> {
        let on_wire = self.on_wire.take_if(|on_wire| on_wire.end <= now)?;
        let OnWire { sender, frame, start, ending, unacknowledged, .. } = on_wire;
        self.counted = now;
        self.free = now.saturating_add(self.bits(INTERMISSION));
        let bit = self.bit;
        match ending {
            Ending::Acknowledged { .. } => {
                let others = self.controllers.iter_mut().enumerate().filter(|(index, _)| *index != sender);
                others.for_each(|(_, other)| {
                    other.receive_errors = other.receive_errors.saturating_sub(1);
                    // delimiter, end of frame and intermission are one idle sequence
                    other.recover(1);
                });
                let controller = &mut self.controllers[sender];
                controller.transmit_errors = controller.transmit_errors.saturating_sub(1);
                controller.outbox.pop_front();
                controller.given_up = false;
            }
            Ending::Failed => {
                let controller = &mut self.controllers[sender];
                // one that is alone on the bus stays error passive for ever
                controller.failed(!unacknowledged || controller.transmit_errors <= PASSIVE);
                if controller.transmit_errors > PASSIVE {
                    controller.suspended = now.saturating_add(bit * (INTERMISSION + SUSPEND));
                }
                if !unacknowledged {
                    let others =
                        self.controllers.iter_mut().enumerate().filter(|(index, _)| *index != sender);
                    others.for_each(|(_, other)| {
                        other.receive_errors = (other.receive_errors + 1).min(PASSIVE + 1)
                    });
                }
            }
        }
        Some(Ended { sender, frame, start, ending })
    }

    fn put_on_wire(&mut self, sender: usize, frame: Frame, now: Moment) -> Moment {
        let length = can_bits::length(&frame);
        let mine = self.disturbances.iter().position(|(whose, _)| *whose == sender);
        let disturbance = mine.and_then(|index| self.disturbances.remove(index)).map(|(_, what)| what);
        let others = self.controllers.iter().enumerate().filter(|(index, _)| *index != sender);
        let acknowledged = others.into_iter().any(|(_, other)| other.takes_part());
        let failed_after = |bits: u64| (bits + ERROR_FRAME, Ending::Failed);
        let (bits, ending) = match disturbance {
            Some(Disturbance::Bit(at)) => failed_after(at.clamp(1, length.to_acknowledgement)),
            _ if !acknowledged => failed_after(length.to_acknowledgement),
            Some(Disturbance::Lost) => (length.whole, Ending::Acknowledged { times: 0 }),
            Some(Disturbance::Doubled) => (length.whole, Ending::Acknowledged { times: 2 }),
            None => (length.whole, Ending::Acknowledged { times: 1 }),
        };
        let unacknowledged = !acknowledged && !matches!(disturbance, Some(Disturbance::Bit(_)));
        let end = now.saturating_add(self.bits(bits));
        self.on_wire = Some(OnWire { sender, frame, start: now, end, ending, unacknowledged });
        end
    }

    /// Counts the idle sequences up to `now` for those that are bus-off.
    fn count_idle(&mut self, now: Moment) {
        let sequences = now.saturating_duration_since(self.counted) / self.bits(IDLE);
        if sequences == 0 || self.on_wire.is_some() {
            return;
        }
        self.counted = self.counted.saturating_add(sequences * self.bits(IDLE));
        for controller in &mut self.controllers {
            controller.recover(sequences);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use jointbus_protocol::can::Id;

    fn frame(id: u32) -> Frame {
        Frame::data_frame(Id::Extended(id), &[0x55; 8]).unwrap()
    }

    fn at(micros: u64) -> Moment {
        Moment::from_nanos(micros * 1000)
    }

    /// Runs the bus to `until`; the endings of all frames.
    fn run(wire: &mut CanWire, until: Moment) -> Vec<Ended> {
        let (mut endings, mut now) = (Vec::new(), Moment::default());
        while let Some(next) = wire.start(now).or_else(|| wire.recovery(now)).filter(|next| *next <= until) {
            now = next.max(now.saturating_add(1));
            endings.extend(wire.end(now));
        }
        endings
    }

    #[test]
    fn the_lowest_identifier_goes_first_and_three_bits_lie_between_frames() {
        let mut wire = CanWire::new(1000, 3);
        wire.controllers[1].outbox.extend([frame(9), frame(1)]);
        wire.controllers[2].outbox.push_back(frame(5));
        let endings = run(&mut wire, at(10_000));
        let order: Vec<_> = endings.iter().map(|ended| ended.sender).collect();
        assert_eq!(order, [2, 1, 1], "a controller sends its own in order");
        let length = can_bits::length(&endings[0].frame).whole;
        assert_eq!(
            endings[1].start.saturating_duration_since(endings[0].start),
            (length + INTERMISSION) * 1000
        );
    }

    #[test]
    fn alone_on_the_bus_a_sender_stays_error_passive() {
        let mut wire = CanWire::new(1000, 2);
        wire.controllers[1].powered = false;
        wire.controllers[0].outbox.push_back(frame(1));
        let endings = run(&mut wire, at(100_000));
        assert!(endings.len() > 500 && endings.iter().all(|ended| ended.ending == Ending::Failed));
        assert_eq!(wire.controllers[0].transmit_errors, 128);
        assert!(!wire.controllers[0].is_bus_off());
    }

    #[test]
    fn bit_errors_lead_to_bus_off_and_1408_recessive_bits_out_of_it() {
        let mut wire = CanWire::new(1000, 2);
        wire.controllers[0].outbox.push_back(frame(1));
        wire.disturbances.extend([(0, Disturbance::Bit(20)); 32]);
        let endings = run(&mut wire, at(10_000));
        assert_eq!(endings.len(), 33);
        assert_eq!(endings[32].ending, Ending::Acknowledged { times: 1 });
        let off = endings[31].start.saturating_add(wire.bits(20 + ERROR_FRAME));
        let back = endings[32].start.saturating_duration_since(off);
        assert!((wire.bits(128 * IDLE)..wire.bits(130 * IDLE)).contains(&back), "{back}");
        assert_eq!(wire.controllers[0].transmit_errors, 0);
    }

    #[test]
    fn a_bus_held_dominant_lets_nobody_send_until_it_is_idle_again() {
        let mut wire = CanWire::new(1000, 2);
        wire.controllers[0].outbox.push_back(frame(1));
        assert!(wire.start(at(0)).is_some());
        assert_eq!(wire.hold_dominant(at(10), at(5000)), Some(0));
        assert!(wire.controllers[0].is_bus_off(), "its sender heard nothing but dominant bits");
        let endings = run(&mut wire, at(20_000));
        assert_eq!(endings.len(), 1);
        assert!(endings[0].start >= at(5000 + 128 * 11));
    }

    #[test]
    fn an_abort_spares_what_is_on_the_wire() {
        let mut wire = CanWire::new(1000, 2);
        wire.controllers[0].outbox.extend([frame(1), frame(2)]);
        let end = wire.start(at(0)).unwrap();
        wire.abort(0);
        assert_eq!(wire.controllers[0].outbox.len(), 1);
        assert!(wire.end(end).is_some());
        wire.controllers[0].outbox.push_back(frame(3));
        wire.abort(0);
        assert!(wire.controllers[0].outbox.is_empty());
        wire.controllers[0].outbox.push_back(frame(4));
        wire.disturbances.push_back((0, Disturbance::Bit(9)));
        let end = wire.start(end.saturating_add(wire.bits(INTERMISSION))).unwrap();
        wire.abort(0);
        assert_eq!(wire.end(end).unwrap().ending, Ending::Failed);
        assert!(wire.controllers[0].outbox.is_empty(), "it is not sent again");
    }
}
