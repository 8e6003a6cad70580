//! The CAN bus between the controller and the rest of the world: who sends next, for how long, and what goes wrong.
//!
//! Everything but the controller is one node, whose frames are [offered](Bus::offer). Time is counted in bits and
//! belongs to the caller: [`Bus::step`] ends what is on the wire and says how long the next thing takes.

use crate::bxcan::{Arbitration, BxCan, Reception, Transmission};
use jointbus_protocol::can::{Frame, Id};
use std::collections::VecDeque;

/// Frames of the rest of the world that can wait.
pub const CAPACITY: usize = 64;

/// Bits after which a node may send on a silent bus, and after which one has joined it.
pub const IDLE_BITS: u32 = 11;

/// What is wrong with the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Faults {
    /// Nobody acknowledges the controller's frames.
    pub no_acknowledgement: bool,
    /// The bus is stuck at the dominant level: nothing passes and nobody can join.
    pub stuck: bool,
    /// Frames of the controller, from the next one, that meet a bit error.
    pub bit_errors: u32,
    /// Frames of the controller, from the next one, that lose arbitration to an unseen node.
    pub arbitration_losses: u32,
    /// Nodes don't agree on the bit rate: every frame fails.
    pub bit_rates_differ: bool,
    /// Offered frames come also where the controller has no room for them. Otherwise they wait: the processor may stand
    /// still because the host has no time for it, and then so does the world.
    pub hasty: bool,
}

impl Faults {
    /// A bus as it should be.
    pub const NONE: Self = Self {
        no_acknowledgement: false,
        stuck: false,
        bit_errors: 0,
        arbitration_losses: 0,
        bit_rates_differ: false,
        hasty: false,
    };
}

/// What the rest of the world sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The controller has sent this.
    Received(Frame),
    /// An offered frame has been on the bus, and the controller has acknowledged it.
    Sent(Frame),
    /// An offered frame has been on the bus, and nobody has acknowledged it. It is not repeated.
    Unacknowledged(Frame),
}

#[derive(Debug, Clone, Copy)]
enum OnWire {
    Controller(Frame),
    World(Frame),
}

/// One bus.
#[derive(Debug, Clone)]
pub struct Bus {
    /// What is wrong; may be changed at any time.
    pub faults: Faults,
    waiting: VecDeque<Frame>,
    on_wire: Option<OnWire>,
}

impl Default for Bus {
    fn default() -> Self {
        Self { faults: Faults::NONE, waiting: VecDeque::new(), on_wire: None }
    }
}

/// Bits of a frame on the wire, the gap behind it included, stuffing not.
#[must_use]
pub fn frame_bits(frame: &Frame) -> u32 {
    let header = match frame.id() {
        Id::Standard(_) => 47,
        Id::Extended(_) => 67,
    };
    header + 8 * frame.data().len() as u32
}

impl Bus {
    /// Frames that can still be offered.
    #[must_use]
    pub fn room(&self) -> usize {
        CAPACITY - self.waiting.len()
    }

    /// Queues a frame of the rest of the world; whether there was room for it.
    pub fn offer(&mut self, frame: Frame) -> bool {
        let fits = self.room() > 0;
        if fits {
            self.waiting.push_back(frame);
        }
        fits
    }

    /// Whether time has to pass for something: then [`Self::step`] is due after [`IDLE_BITS`], or as it says.
    #[must_use]
    pub fn is_busy(&self, can: &BxCan) -> bool {
        let could_start = self.bid(can).is_some() || can.contender().is_some() || can.awaits_recessive_bits();
        self.on_wire.is_some() || !self.faults.stuck && could_start
    }

    /// The controller was reset: its frame on the wire, if any, ends here.
    pub fn controller_reset(&mut self) {
        if matches!(self.on_wire, Some(OnWire::Controller(_))) {
            self.on_wire = None;
        }
    }

    /// The announced number of bits has passed: ends what was on the wire and starts what comes next. Returns the
    /// bits until the next step, or nothing when the bus falls silent.
    pub fn step(&mut self, can: &mut BxCan, mut event: impl FnMut(Event)) -> Option<u32> {
        match self.on_wire.take() {
            Some(OnWire::Controller(frame)) => self.end_controllers(frame, can, &mut event),
            Some(OnWire::World(frame)) => event(self.end_worlds(frame, can)),
            None => {}
        }
        if self.faults.stuck {
            return None;
        }
        can.recessive_sequence();
        self.on_wire = self.arbitrate(can);
        match self.on_wire {
            Some(OnWire::Controller(frame) | OnWire::World(frame)) => Some(frame_bits(&frame)),
            None => can.awaits_recessive_bits().then_some(IDLE_BITS),
        }
    }

    fn end_controllers(&mut self, frame: Frame, can: &mut BxCan, event: &mut impl FnMut(Event)) {
        if !can.is_on_wire() {
            return;
        }
        let transmission = self.transmission(can);
        can.finish(transmission);
        let visible = can.drives_bus()
            && matches!(transmission, Transmission::Acknowledged | Transmission::NotAcknowledged);
        // A frame that nobody acknowledges is repeated; nobody is there to see it.
        if visible && !self.faults.no_acknowledgement {
            event(Event::Received(frame));
        }
    }

    fn transmission(&mut self, can: &BxCan) -> Transmission {
        if !can.drives_bus() {
            // Silent and looped back: the bus does not take part.
            Transmission::Acknowledged
        } else if self.faults.stuck || self.faults.bit_rates_differ || take_one(&mut self.faults.bit_errors) {
            Transmission::BitError
        } else if take_one(&mut self.faults.arbitration_losses) {
            Transmission::ArbitrationLost
        } else if self.faults.no_acknowledgement {
            Transmission::NotAcknowledged
        } else {
            Transmission::Acknowledged
        }
    }

    fn end_worlds(&self, frame: Frame, can: &mut BxCan) -> Event {
        let passes = !self.faults.stuck && !self.faults.bit_rates_differ;
        if passes && can.receive(&frame) != Reception::Deaf && can.drives_bus() {
            Event::Sent(frame)
        } else {
            Event::Unacknowledged(frame)
        }
    }

    /// What the world bids with, if it wants to send.
    fn bid(&self, can: &BxCan) -> Option<Arbitration> {
        self.waiting.front().filter(|_| self.faults.hasty || can.has_room()).map(Arbitration::of)
    }

    /// The smallest arbitration field goes next; a controller that bid for the bus too has lost it.
    fn arbitrate(&mut self, can: &mut BxCan) -> Option<OnWire> {
        let worlds = match (self.bid(can), can.contender()) {
            (Some(bid), Some(contender)) => bid < contender,
            (Some(_), None) => true,
            (None, _) => false,
        };
        if !worlds {
            return can.begin().map(OnWire::Controller);
        }
        if can.begin().is_some() {
            can.finish(Transmission::ArbitrationLost);
        }
        self.waiting.pop_front().map(OnWire::World)
    }
}

/// Counts down; whether there was one left.
fn take_one(count: &mut u32) -> bool {
    let some = *count > 0;
    *count = count.saturating_sub(1);
    some
}

#[cfg(test)]
mod tests {
    use super::*;

    const MCR: u32 = 0x00;
    const TSR: u32 = 0x08;
    const ESR: u32 = 0x18;

    fn frame(id: u16) -> Frame {
        Frame::data_frame(Id::Standard(id), &[]).unwrap()
    }

    /// A controller on its bus.
    fn joined() -> (Bus, BxCan) {
        let (mut bus, mut can) = (Bus::default(), BxCan::new());
        can.write(MCR, 0);
        assert_eq!(run(&mut bus, &mut can), []);
        (bus, can)
    }

    fn request(can: &mut BxCan, mailbox: u32, id: u32) {
        can.write(0x180 + 16 * mailbox, id << 21 | 1);
    }

    /// Lets the bus fall silent.
    fn run(bus: &mut Bus, can: &mut BxCan) -> Vec<Event> {
        let mut events = Vec::new();
        while bus.step(can, |event| events.push(event)).is_some() {}
        assert!(!bus.is_busy(can));
        events
    }

    #[test]
    fn the_smaller_identifier_goes_first_whosever_it_is() {
        let (mut bus, mut can) = joined();
        for id in [3, 1] {
            assert!(bus.offer(frame(id)));
        }
        request(&mut can, 0, 2);
        request(&mut can, 1, 4);
        // The world is one node: its first frame is the one that bids.
        let order = [
            Event::Received(frame(2)),
            Event::Sent(frame(3)),
            Event::Sent(frame(1)),
            Event::Received(frame(4)),
        ];
        assert_eq!(run(&mut bus, &mut can), order);
    }

    #[test]
    fn a_controller_that_loses_is_told() {
        const NART: u32 = 1 << 4;
        const RQCP_AND_ALST: u32 = 0b101;
        let (mut bus, mut can) = joined();
        can.write(MCR, NART);
        bus.offer(frame(1));
        request(&mut can, 0, 2);
        assert_eq!(run(&mut bus, &mut can), [Event::Sent(frame(1))]);
        assert_eq!(can.read(TSR) & 0xff, RQCP_AND_ALST);
    }

    #[test]
    fn injected_faults_are_used_up() {
        let (mut bus, mut can) = joined();
        bus.faults.bit_errors = 2;
        bus.faults.arbitration_losses = 3;
        request(&mut can, 0, 1);
        assert_eq!(run(&mut bus, &mut can), [Event::Received(frame(1))]);
        assert_eq!(can.read(ESR) >> 16, 2 * 8 - 1);
        assert_eq!(bus.faults, Faults::NONE);
    }

    #[test]
    fn without_acknowledgement_a_frame_is_repeated_for_ever() {
        let (mut bus, mut can) = joined();
        bus.faults.no_acknowledgement = true;
        request(&mut can, 0, 1);
        for _ in 0..50 {
            assert_eq!(bus.step(&mut can, |event| panic!("{event:?}")), Some(47));
        }
        bus.faults.no_acknowledgement = false;
        assert_eq!(run(&mut bus, &mut can), [Event::Received(frame(1))]);
    }

    #[test]
    fn what_is_on_the_wire_when_the_bus_sticks_fails() {
        let (mut bus, mut can) = joined();
        bus.offer(frame(1));
        assert!(bus.step(&mut can, |_| ()).is_some());
        bus.faults.stuck = true;
        assert_eq!(run(&mut bus, &mut can), [Event::Unacknowledged(frame(1))]);
        bus.offer(frame(2));
        assert!(!bus.is_busy(&can));
        bus.faults.stuck = false;
        assert_eq!(run(&mut bus, &mut can), [Event::Sent(frame(2))]);
    }

    #[test]
    fn frames_wait_for_room_unless_they_are_hasty() {
        const RF0R: u32 = 0x0C;
        const FMP: u32 = 0b11;
        const FOVR: u32 = 1 << 4;
        const RFOM: u32 = 1 << 5;
        let (mut bus, mut can) = joined();
        // filter bank 0, of 32 bits and one of CAN1's, lets everything pass
        for (register, value) in [(0x20C, 1), (0x21C, 1), (0x200, 0x0E00)] {
            can.write(register, value);
        }
        (0..5).for_each(|id| assert!(bus.offer(frame(id))));
        assert_eq!(run(&mut bus, &mut can), [0, 1, 2].map(|id| Event::Sent(frame(id))));
        can.write(RF0R, RFOM);
        assert!(bus.is_busy(&can));
        assert_eq!(run(&mut bus, &mut can), [Event::Sent(frame(3))]);
        assert_eq!(can.read(RF0R) & (FMP | FOVR), 3);
        bus.faults.hasty = true;
        assert_eq!(run(&mut bus, &mut can), [Event::Sent(frame(4))]);
        assert_eq!(can.read(RF0R) & (FMP | FOVR), 3 | FOVR);
    }

    #[test]
    fn bits_are_counted_by_format_and_length() {
        assert_eq!(frame_bits(&frame(1)), 47);
        let long = Frame::from_parts(Id::Extended(1), false, 15, [0; 8]).unwrap();
        assert_eq!(frame_bits(&long), 67 + 64);
        let remote = Frame::from_parts(Id::Extended(1), true, 8, [0; 8]).unwrap();
        assert_eq!(frame_bits(&remote), 67);
    }
}
