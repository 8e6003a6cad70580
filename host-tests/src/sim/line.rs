//! An RS485 line: two wires, on which one may send at a time.

use super::moment::{Moment, Nanos};
use super::random::Random;
use std::collections::VecDeque;

/// Who sends on a line.
pub type Sender = usize;

/// What is to happen to one byte of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tamper {
    /// These bits are wrong.
    Flip(u8),
    /// It is not heard.
    Lose,
    /// It is heard twice.
    Double,
    /// Its stop bit is missing, and the UART says so.
    Framing,
}

/// A random byte lacks its stop bit so often in a million.
const NO_STOP_BIT: u64 = 300_000;

/// One transceiver.
#[derive(Debug, Default)]
struct Transceiver {
    bytes: VecDeque<u8>,
    /// The byte on the wire.
    current: Option<u8>,
    /// Somebody else drives the line as well.
    garbled: bool,
    /// Drives the line although it does not send, until then.
    held: Moment,
    /// Not heard until then: its driver is not on yet.
    mute: Moment,
    /// Sends nothing but noise: a UART finds stop bits missing.
    noisy: bool,
    /// Bytes of the present frame before the one on the wire.
    index: usize,
    /// What happens to which byte of the next frames.
    tampers: VecDeque<(usize, Tamper)>,
}

/// What was heard when a byte ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Heard {
    /// The byte as the others hear it.
    pub byte: Option<u8>,
    /// It is heard twice.
    pub twice: bool,
    /// Whether it is the one that was sent.
    pub genuine: bool,
    /// Whether its stop bit is missing.
    pub framing: bool,
}

/// An RS485 line.
#[derive(Debug)]
pub struct Line {
    transceivers: Vec<Transceiver>,
    byte: Nanos,
    /// One wire is broken from then to then: nobody hears anything.
    cut: (Moment, Moment),
}

impl Line {
    /// A line with so many transceivers on which a character takes `byte`.
    #[must_use]
    pub fn new(transceivers: usize, byte: Nanos) -> Self {
        let transceivers = (0..transceivers).map(|_| Transceiver::default()).collect();
        Self { transceivers, byte, cut: (Moment::default(), Moment::default()) }
    }

    /// The time that a character takes.
    #[must_use]
    pub const fn byte_time(&self) -> Nanos {
        self.byte
    }

    /// Changes the time that a character takes.
    pub const fn set_byte_time(&mut self, byte: Nanos) {
        self.byte = byte;
    }

    /// Whether this one has a byte on the wire.
    #[must_use]
    pub fn is_sending(&self, sender: Sender) -> bool {
        self.transceivers[sender].current.is_some()
    }

    /// Has what a transceiver sends be noise.
    pub fn set_noisy(&mut self, sender: Sender) {
        self.transceivers[sender].noisy = true;
    }

    /// Lets nobody hear anything that starts from `start` to `end`.
    pub const fn cut(&mut self, start: Moment, end: Moment) {
        self.cut = (start, end);
    }

    /// Has a transceiver drive the line until `end` although it does not send.
    pub fn hold(&mut self, sender: Sender, end: Moment) {
        self.transceivers[sender].held = end;
        let others = self.transceivers.iter_mut().enumerate().filter(|(index, _)| *index != sender);
        others.for_each(|(_, other)| other.garbled |= other.current.is_some());
    }

    /// Has a transceiver's driver rise only at `end`: what starts before is not heard.
    pub fn mute(&mut self, sender: Sender, end: Moment) {
        self.transceivers[sender].mute = end;
    }

    /// Changes the byte of that index in the next frame of a sender.
    pub fn tamper(&mut self, sender: Sender, index: usize, tamper: Tamper) {
        self.transceivers[sender].tampers.push_back((index, tamper));
    }

    /// Whether a byte of some next frame is to be changed.
    #[must_use]
    pub fn is_tampered(&self) -> bool {
        self.transceivers.iter().any(|transceiver| !transceiver.tampers.is_empty())
    }

    /// Adds bytes to what a sender has to send. The answer is when the first one ends, if it starts now.
    pub fn send(&mut self, sender: Sender, bytes: &[u8], now: Moment) -> Option<Moment> {
        let transceiver = &mut self.transceivers[sender];
        transceiver.bytes.extend(bytes);
        if transceiver.current.is_some() {
            return None;
        }
        transceiver.index = 0;
        self.start(sender, now)
    }

    /// Ends the byte of a sender at `now`; the answer is what was heard, and when the next byte ends.
    pub fn end(&mut self, sender: Sender, now: Moment, random: &mut Random) -> (Heard, Option<Moment>) {
        let started = Moment::from_nanos(now.as_nanos().saturating_sub(self.byte));
        let cut = self.cut.0 <= started && started < self.cut.1;
        let transceiver = &mut self.transceivers[sender];
        let Some(sent) = transceiver.current.take() else { return (Heard::default(), None) };
        let framing = transceiver.noisy && random.chance(NO_STOP_BIT);
        let mut heard = Heard { byte: Some(sent), twice: false, genuine: true, framing };
        let tamper = transceiver
            .tampers
            .front()
            .filter(|(index, _)| *index <= transceiver.index)
            .map(|(_, what)| *what);
        if let Some(tamper) = tamper {
            transceiver.tampers.pop_front();
            heard.genuine = false;
            match tamper {
                Tamper::Flip(bits) => heard.byte = Some(sent ^ bits),
                Tamper::Lose => heard.byte = None,
                Tamper::Double => heard.twice = true,
                Tamper::Framing => heard.framing = true,
            }
        }
        if transceiver.garbled {
            // two drivers against each other: anybody's guess
            let framing = random.chance(NO_STOP_BIT);
            heard = Heard { byte: Some(random.byte()), twice: false, genuine: false, framing };
        }
        if started < transceiver.mute || cut {
            heard = Heard::default();
        }
        transceiver.index += 1;
        (heard, self.start(sender, now))
    }

    /// Puts the next byte of a sender onto the wire; the answer is when it ends.
    fn start(&mut self, sender: Sender, now: Moment) -> Option<Moment> {
        let mut garbled = false;
        for (_, other) in self.transceivers.iter_mut().enumerate().filter(|(index, _)| *index != sender) {
            if other.current.is_some() {
                (other.garbled, garbled) = (true, true);
            }
            garbled |= now < other.held;
        }
        let transceiver = &mut self.transceivers[sender];
        transceiver.current = transceiver.bytes.pop_front();
        transceiver.garbled = garbled;
        transceiver.current.map(|_| now.saturating_add(self.byte))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BYTE: Nanos = 100;

    fn at(nanos: u64) -> Moment {
        Moment::from_nanos(nanos)
    }

    /// What is heard of a sender that has started, and when each byte ended.
    fn listen(line: &mut Line, sender: Sender, first: Moment) -> Vec<(u64, Heard)> {
        let (mut heard, mut next, mut random) = (Vec::new(), Some(first), Random::new(1));
        while let Some(now) = next {
            let (one, following) = line.end(sender, now, &mut random);
            heard.push((now.as_nanos(), one));
            next = following;
        }
        heard
    }

    fn bytes(heard: &[(u64, Heard)]) -> Vec<u8> {
        heard.iter().filter_map(|(_, heard)| heard.byte).collect()
    }

    #[test]
    fn bytes_end_one_character_apart() {
        let mut line = Line::new(2, BYTE);
        let first = line.send(0, &[1, 2, 3], at(50)).unwrap();
        let heard = listen(&mut line, 0, first);
        assert_eq!(bytes(&heard), [1, 2, 3]);
        assert_eq!(heard.iter().map(|(at, _)| *at).collect::<Vec<_>>(), [150, 250, 350]);
    }

    #[test]
    fn two_at_once_destroy_each_other() {
        let mut line = Line::new(2, BYTE);
        let first = line.send(0, &[1, 2], at(0)).unwrap();
        let other = line.send(1, &[9], at(40)).unwrap();
        let mut random = Random::new(1);
        assert!(!line.end(0, first, &mut random).0.genuine);
        assert!(!line.end(1, other, &mut random).0.genuine);
        assert!(!line.end(0, first.saturating_add(BYTE), &mut random).0.genuine, "it began beside the other");
    }

    #[test]
    fn a_driver_held_too_long_destroys_the_answer_and_a_late_one_loses_bytes() {
        let mut line = Line::new(2, BYTE);
        line.hold(0, at(150));
        let first = line.send(1, &[1, 2, 3], at(0)).unwrap();
        let genuine: Vec<_> = listen(&mut line, 1, first).iter().map(|(_, heard)| heard.genuine).collect();
        assert_eq!(genuine, [false, false, true]);
        line.mute(1, at(1150));
        let first = line.send(1, &[1, 2, 3], at(1000)).unwrap();
        assert_eq!(bytes(&listen(&mut line, 1, first)), [3]);
    }

    #[test]
    fn a_byte_is_changed_once_and_a_cut_line_is_silent() {
        let mut line = Line::new(2, BYTE);
        line.tamper(0, 1, Tamper::Flip(0x80));
        line.tamper(0, 2, Tamper::Lose);
        let first = line.send(0, &[1, 2, 3, 4], at(0)).unwrap();
        assert_eq!(bytes(&listen(&mut line, 0, first)), [1, 0x82, 4]);
        line.cut(at(1000), at(1250));
        let first = line.send(0, &[1, 2, 3, 4], at(1000)).unwrap();
        assert_eq!(bytes(&listen(&mut line, 0, first)), [4]);
    }
}
