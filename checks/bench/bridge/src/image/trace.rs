//! What the processor did, from the addresses of its instructions.

use std::collections::BTreeMap;
use std::io::{self, BufReader, Read};

use crate::code::{Code, Kind};

/// The interrupt that only counts time: it may come at any moment, and what it takes is not counted.
const TICK: &str = "SysTick";

/// How the names of the serial ports' interrupts begin.
const SERIAL: &str = "USART";

/// The interrupt of a received frame.
pub(crate) const CAN_RECEIVED: &str = "CAN1_RX0";

/// The interrupts that a reply of a device may end with.
const REPLIES: [&str; 2] = [CAN_RECEIVED, "USART2"];

/// Instructions of the main loop behind its sleep at most, until it lets interrupts in.
const WAKING: u64 = 8;

/// `USART_DR` of the host's port, with the marks of the recorder.
const HOST_DATA_WRITTEN: u32 = 0x4001_1004 | 0b11;

/// The interrupt of the host's port.
const HOST: &str = "USART1";

/// `CAN_TIxR` of the three mailboxes, with the marks of the recorder.
const MAILBOX_WRITTEN: [u32; 3] = [0x4000_6580 | 0b11, 0x4000_6590 | 0b11, 0x4000_65A0 | 0b11];

/// An interrupt that is being served.
struct Activation {
    interrupt: String,
    /// Calls that have not returned yet.
    calls: u32,
    instructions: u64,
    /// How often it read, and wrote, the data register of a serial port.
    reads: u32,
    writes: u32,
}

/// Which way bytes or frames go.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Way {
    In,
    Out,
}

/// Instructions of the interrupts of one way of a port, and of the turns of the main loop that they woke.
#[derive(Debug, Default)]
pub(crate) struct Load {
    pub(crate) interrupts: u64,
    /// Bytes or frames that they moved.
    pub(crate) moved: u64,
    /// Of the interrupts alone.
    pub(crate) instructions: u64,
    /// Of each turn.
    pub(crate) turns: Vec<u64>,
}

/// Instructions, each list in the order in which it happened.
#[derive(Debug, Default)]
pub(crate) struct Counts {
    /// Of an interrupt of a serial port that took a byte and sent none.
    pub(crate) received_byte: BTreeMap<String, Vec<u64>>,
    /// From an interrupt of a reply that found the processor asleep, and was the last of it, to the first byte for the
    /// host.
    pub(crate) reply: BTreeMap<String, Vec<u64>>,
    /// From the interrupt of the host's last byte, which found the processor asleep, to the request's first frame for the
    /// CAN controller.
    pub(crate) request: Vec<u64>,
    /// Of the tick's interrupt.
    pub(crate) tick: Vec<u64>,
    /// All of the ports, by interrupt.
    pub(crate) loads: BTreeMap<(String, Way), Load>,
    /// Of the main loop from sleep to sleep with nothing but a tick between.
    pub(crate) idle_turn: Vec<u64>,
    /// Of the same.
    pub(crate) profiles: Profiles,
}

/// Where the instructions are.
#[derive(Debug, Default)]
pub(crate) struct Profiles {
    pub(crate) received_byte: Profile,
    pub(crate) request: Profile,
    pub(crate) reply: Profile,
    pub(crate) idle_turn: Profile,
}

/// How often each instruction was executed in something that happened many times.
#[derive(Debug, Default)]
pub(crate) struct Profile {
    under_way: Vec<u32>,
    sum: BTreeMap<u32, u64>,
    times: u64,
}

impl Profile {
    /// Each address, and how often it was executed at a time.
    pub(crate) fn shares(&self) -> impl Iterator<Item = (u32, f64)> + '_ {
        self.sum.iter().map(|(address, count)| (*address, *count as f64 / self.times as f64))
    }

    /// What was under way is none of it.
    fn start(&mut self) {
        self.under_way.clear();
    }

    /// What was under way is done.
    fn end(&mut self) {
        self.times += 1;
        for address in self.under_way.drain(..) {
            *self.sum.entry(address).or_default() += 1;
        }
    }
}

/// Follows the processor.
pub(crate) struct Trace {
    code: Code,
    /// The last instruction, and whether it has reached a data register: told of once more, it is another.
    last: u32,
    accessed: bool,
    /// Those that are being served, the latest last.
    activations: Vec<Activation>,
    /// All but ticks.
    total: u64,
    /// Of the main loop since it slept; whether another interrupt than the tick came.
    turn: (u64, bool),
    /// The first of those, once it has been served.
    woken_by: Option<(String, Way)>,
    /// The interrupt that may be the last of a reply, and the total when it came.
    reply: Option<(String, u64)>,
    /// The total when an interrupt came that may be the last of a request.
    request: Option<u64>,
    pub(crate) counts: Counts,
}

impl Trace {
    pub(crate) fn new(code: Code) -> Self {
        Self {
            code,
            last: 0,
            accessed: false,
            activations: Vec::new(),
            total: 0,
            turn: (0, true),
            woken_by: None,
            reply: None,
            request: None,
            counts: Counts::default(),
        }
    }

    /// Takes all that the recorder tells, until it ends.
    pub(crate) fn read(&mut self, stream: impl Read) -> io::Result<()> {
        let mut stream = BufReader::with_capacity(1 << 16, stream);
        let mut word = [0; 4];
        loop {
            match stream.read_exact(&mut word) {
                Ok(()) => self.take(u32::from_le_bytes(word)),
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(()),
                Err(error) => return Err(error),
            }
        }
    }

    fn take(&mut self, word: u32) {
        if word & 1 == 1 {
            self.access(word);
            self.accessed = true;
        } else if word != self.last || self.accessed {
            self.execute(word);
            (self.last, self.accessed) = (word, false);
        }
    }

    /// An access to a data register.
    fn access(&mut self, word: u32) {
        if MAILBOX_WRITTEN.contains(&word)
            && let Some(start) = self.request.take()
        {
            self.counts.request.push(self.total - start);
            self.counts.profiles.request.end();
        }
        if let Some(activation) = self.activations.last_mut() {
            *(if word & 0b10 == 0 { &mut activation.reads } else { &mut activation.writes }) += 1;
        }
        if word == HOST_DATA_WRITTEN
            && let Some((interrupt, start)) = self.reply.take()
        {
            self.counts.reply.entry(interrupt).or_default().push(self.total - start);
            self.counts.profiles.reply.end();
        }
    }

    fn execute(&mut self, address: u32) {
        self.go_on(address);
        if let Some(interrupt) = self.code.handler(address).map(str::to_owned) {
            self.enter(interrupt);
        }
        let Profiles { received_byte, request, reply, idle_turn } = &mut self.counts.profiles;
        let tick = self.activations.last().is_some_and(|activation| activation.interrupt == TICK);
        request.under_way.extend((self.request.is_some() && !tick).then_some(address));
        match self.activations.last_mut() {
            Some(activation) => {
                activation.instructions += 1;
                if activation.interrupt.starts_with(SERIAL) {
                    received_byte.under_way.push(address);
                }
                if activation.interrupt != TICK {
                    self.total += 1;
                    reply.under_way.extend(self.reply.is_some().then_some(address));
                }
            }
            None => {
                self.total += 1;
                self.turn.0 += 1;
                idle_turn.under_way.push(address);
                reply.under_way.extend(self.reply.is_some().then_some(address));
                if self.code.is_sleep(address) {
                    let (instructions, disturbed) = std::mem::take(&mut self.turn);
                    if let Some(woken_by) = self.woken_by.take() {
                        self.counts.loads.entry(woken_by).or_default().turns.push(instructions);
                    }
                    // what has to wait is no matter of instructions
                    self.request = None;
                    if disturbed {
                        idle_turn.start();
                    } else {
                        idle_turn.end();
                        self.counts.idle_turn.push(instructions);
                    }
                }
            }
        }
    }

    fn enter(&mut self, interrupt: String) {
        self.turn.1 |= interrupt != TICK;
        if interrupt.starts_with(SERIAL) {
            self.counts.profiles.received_byte.start();
        }
        let found_asleep = self.activations.is_empty() && self.turn.0 <= WAKING;
        let start = self.total - self.turn.0;
        if REPLIES.contains(&interrupt.as_str()) {
            self.counts.profiles.reply.start();
            self.reply = found_asleep.then(|| (interrupt.clone(), start));
        }
        if interrupt == HOST {
            self.counts.profiles.request.start();
            self.request = found_asleep.then_some(start);
        }
        self.activations.push(Activation { interrupt, calls: 0, instructions: 0, reads: 0, writes: 0 });
    }

    /// Notes what the last instruction was, now that it is known where it led.
    fn go_on(&mut self, address: u32) {
        let (kind, length) = self.code.kind(self.last);
        let Some(activation) = self.activations.last_mut() else { return };
        // a condition may have kept it from being done; one handler may follow another in time and in place
        let is_next = address == self.last.wrapping_add(length) && self.code.handler(address).is_none();
        if is_next && self.code.is_conditional(self.last) {
            return;
        }
        match kind {
            Kind::Call => activation.calls += 1,
            Kind::Return if activation.calls > 0 => activation.calls -= 1,
            Kind::Return => self.end(),
            Kind::Other => {}
        }
    }

    /// The interrupt has been served.
    fn end(&mut self) {
        let Some(done) = self.activations.pop() else { return };
        let Activation { interrupt, instructions, reads, writes, .. } = done;
        if interrupt == TICK {
            return self.counts.tick.push(instructions);
        }
        let is_serial = interrupt.starts_with(SERIAL);
        let (way, moved) = match interrupt.as_str() {
            _ if is_serial && reads > 0 => (Way::In, reads),
            _ if is_serial => (Way::Out, writes),
            CAN_RECEIVED => (Way::In, 1),
            _ => (Way::Out, 1),
        };
        let load = self.counts.loads.entry((interrupt.clone(), way)).or_default();
        load.interrupts += 1;
        load.moved += u64::from(moved);
        load.instructions += instructions;
        self.woken_by.get_or_insert_with(|| (interrupt.clone(), way));
        if is_serial && (reads, writes) == (1, 0) {
            self.counts.profiles.received_byte.end();
            self.counts.received_byte.entry(interrupt).or_default().push(instructions);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SLEEP: u32 = 0x1000;
    const AWAKE: [u32; 2] = [0x1002, 0x1004];
    const HOST: [u32; 2] = [0x1010, 0x1014];
    const TICK_HANDLER: u32 = 0x1016;
    const CALLED: [u32; 2] = [0x1018, 0x101A];
    const CAN: u32 = 0x101C;
    const BYTE_READ: u32 = 0x4001_1005;

    /// A main loop that sleeps, a handler that calls a function and lies before the tick's, and one for CAN.
    fn trace() -> Trace {
        const NOP: u16 = 0xBF00;
        let mut halves = [NOP; 16];
        halves[0] = 0xBF30; // wfi
        halves[2] = 0xE7FC; // b to it
        halves[8..11].copy_from_slice(&[0xF000, 0xF800, 0xBD80]); // bl; pop {r7, pc}
        halves[11] = 0x4770; // bx lr
        halves[13] = 0x4770;
        halves[14] = 0x4770;
        let handlers = [(HOST[0], "USART1"), (TICK_HANDLER, "SysTick"), (CAN, "CAN1_RX0")];
        let mut trace = Trace::new(Code::made_of(SLEEP, &halves, &handlers));
        follow(&mut trace, &[SLEEP]);
        trace
    }

    fn follow(trace: &mut Trace, words: &[u32]) {
        words.iter().for_each(|word| trace.take(*word));
    }

    #[test]
    fn an_interrupt_ends_with_its_own_return() {
        let mut trace = trace();
        let [enter, leave] = HOST;
        let [callee, back] = CALLED;
        // the tick comes behind it without a step of the main loop between, and in the middle of the next
        follow(&mut trace, &[enter, callee, BYTE_READ, back, leave, TICK_HANDLER]);
        follow(&mut trace, &AWAKE);
        follow(&mut trace, &[SLEEP, enter, TICK_HANDLER, callee, BYTE_READ, back, leave, AWAKE[0]]);
        assert_eq!(trace.counts.received_byte["USART1"], [4, 4]);
        assert!(trace.activations.is_empty());
    }

    #[test]
    fn a_port_pays_for_its_interrupts_and_the_turns_that_they_wake() {
        let mut trace = trace();
        let [enter, leave] = HOST;
        let [callee, back] = CALLED;
        // the tick is nobody's, and what comes during a turn wakes none
        follow(
            &mut trace,
            &[TICK_HANDLER, enter, callee, BYTE_READ, back, leave, AWAKE[0], CAN, AWAKE[1], SLEEP],
        );
        let Load { interrupts, moved, instructions, turns } =
            &trace.counts.loads[&("USART1".to_owned(), Way::In)];
        assert_eq!((*interrupts, *moved, *instructions, &turns[..]), (1, 1, 4, &[3][..]));
        let Load { interrupts, moved, instructions, turns } =
            &trace.counts.loads[&("CAN1_RX0".to_owned(), Way::In)];
        assert_eq!((*interrupts, *moved, *instructions, turns.len()), (1, 1, 1, 0));
        assert_eq!(trace.counts.tick, [1]);
    }

    #[test]
    fn a_request_counts_from_its_last_byte_to_its_first_frame() {
        let mut trace = trace();
        let [enter, leave] = HOST;
        let [callee, back] = CALLED;
        let byte = [enter, callee, BYTE_READ, back, leave, AWAKE[0], AWAKE[1]];
        // nothing is counted of a byte that leads to no frame before the processor sleeps again
        follow(&mut trace, &byte);
        follow(&mut trace, &[SLEEP, MAILBOX_WRITTEN[0]]);
        follow(&mut trace, &byte);
        follow(&mut trace, &[MAILBOX_WRITTEN[0], MAILBOX_WRITTEN[1]]);
        assert_eq!(trace.counts.request, [6]);
    }

    #[test]
    fn a_turn_is_idle_when_only_the_tick_came() {
        let mut trace = trace();
        follow(&mut trace, &[TICK_HANDLER, AWAKE[0], AWAKE[1], SLEEP]);
        follow(&mut trace, &[CAN, AWAKE[0], AWAKE[1], SLEEP]);
        follow(&mut trace, &[TICK_HANDLER, AWAKE[0], AWAKE[1], SLEEP]);
        assert_eq!(trace.counts.idle_turn, [3, 3]);
    }

    #[test]
    fn a_reply_counts_from_its_last_interrupt_to_the_first_byte() {
        let mut trace = trace();
        follow(&mut trace, &[CAN, AWAKE[0], AWAKE[1], SLEEP]);
        // the tick does not count; an instruction that is told of twice counts once
        follow(&mut trace, &[CAN, AWAKE[0], TICK_HANDLER, AWAKE[1], HOST[0], CALLED[0], CALLED[0]]);
        follow(&mut trace, &[HOST_DATA_WRITTEN, CALLED[1], HOST_DATA_WRITTEN, HOST[1]]);
        assert_eq!(trace.counts.reply["CAN1_RX0"], [5]);
    }
}
