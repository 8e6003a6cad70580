//! A USART (RM0090, chapter 30) whose bytes take their time: a byte is on the wire from its start bit to the end of its
//! last stop bit, as baud rate register, format and clock say, and only then is the transmission complete.
//!
//! Received bytes come one after the other, each not before its time has passed and not before the one before it has
//! been read: the model never loses a byte because the emulator was busy elsewhere. A character can be given an error of
//! reception, which the firmware clears as it reads it. Not modelled: parity as such, oversampling by 8, DMA, flow control, the synchronous and the other special modes.

use std::collections::VecDeque;

/// Bytes that the registers occupy.
pub const SIZE: u32 = 0x400;

/// Bytes that wait on their way in.
const ROOM: usize = 4096;

/// Transmissions that are remembered; older ones are forgotten.
const KEPT: usize = 4096;

mod offset {
    pub(super) const SR: u32 = 0x00;
    pub(super) const DR: u32 = 0x04;
    pub(super) const BRR: u32 = 0x08;
    pub(super) const CR1: u32 = 0x0c;
    pub(super) const CR2: u32 = 0x10;
    pub(super) const END: u32 = 0x1c;
}

mod sr {
    pub(super) const PE: u32 = 1;
    pub(super) const FE: u32 = 1 << 1;
    pub(super) const NF: u32 = 1 << 2;
    pub(super) const ORE: u32 = 1 << 3;
    pub(super) const RXNE: u32 = 1 << 5;
    pub(super) const TC: u32 = 1 << 6;
    pub(super) const TXE: u32 = 1 << 7;
}

mod cr1 {
    pub(super) const RE: u32 = 1 << 2;
    pub(super) const TE: u32 = 1 << 3;
    pub(super) const RXNEIE: u32 = 1 << 5;
    pub(super) const TCIE: u32 = 1 << 6;
    pub(super) const TXEIE: u32 = 1 << 7;
    pub(super) const M: u32 = 1 << 12;
    pub(super) const UE: u32 = 1 << 13;
}

/// What can be wrong with a received character.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flaw {
    /// Its parity.
    Parity,
    /// Its stop bit.
    Framing,
    /// Its samples differed, though the majority was right.
    Noise,
    /// Nothing, but the one behind it is lost.
    Overrun,
}

impl Flaw {
    /// A flaw by its name.
    #[must_use]
    pub fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "parity" => Self::Parity,
            "framing" => Self::Framing,
            "noise" => Self::Noise,
            "overrun" => Self::Overrun,
            _ => return None,
        })
    }

    const fn flag(self) -> u32 {
        match self {
            Self::Parity => sr::PE,
            Self::Framing => sr::FE,
            Self::Noise => sr::NF,
            Self::Overrun => sr::ORE,
        }
    }
}

/// When something was on the wire, in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// The first start bit began.
    pub start: u64,
    /// The last stop bit ended.
    pub end: u64,
}

/// One USART.
#[derive(Debug, Clone)]
pub struct Usart {
    registers: [u32; (offset::END / 4) as usize],
    /// What waits for the byte on the wire.
    next: Option<u8>,
    /// The byte on the wire, and when its last stop bit ends.
    shifting: Option<(u8, u64)>,
    received: u8,
    incoming: VecDeque<u8>,
    /// What is wrong with the next character.
    flaw: Option<Flaw>,
    /// When the first incoming byte has ended.
    arrives: u64,
    outgoing: Vec<u8>,
    sent: VecDeque<Sent>,
}

impl Default for Usart {
    fn default() -> Self {
        let mut usart = Self {
            registers: Default::default(),
            next: None,
            shifting: None,
            received: 0,
            incoming: VecDeque::new(),
            flaw: None,
            arrives: 0,
            outgoing: Vec::new(),
            sent: VecDeque::new(),
        };
        usart.reset();
        usart
    }
}

impl Usart {
    /// A USART after a reset.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A reset: what was on its way is gone, what was sent stays known.
    pub fn reset(&mut self) {
        self.registers.fill(0);
        self.set(offset::SR, sr::TXE | sr::TC);
        (self.next, self.shifting) = (None, None);
        self.incoming.clear();
    }

    /// Reads a register.
    pub fn read(&mut self, offset: u32) -> u32 {
        match offset & !3 {
            offset::DR => {
                self.clear(sr::RXNE | sr::PE | sr::FE | sr::NF | sr::ORE);
                self.received.into()
            }
            offset if offset < offset::END => self.get(offset),
            _ => 0,
        }
    }

    /// Writes a register at a moment in nanoseconds; `hz` is the clock of the bus that the USART is on.
    pub fn write(&mut self, offset: u32, value: u32, now: u64, hz: u32) {
        match offset & !3 {
            // these two flags are cleared by a written 0
            offset::SR => self.clear(!value & (sr::TC | sr::RXNE)),
            offset::DR => self.transmit(value as u8, now, hz),
            offset if offset < offset::END => self.set(offset, value),
            _ => {}
        }
    }

    /// The level of the interrupt line.
    #[must_use]
    pub fn interrupt(&self) -> bool {
        let (status, control) = (self.get(offset::SR), self.get(offset::CR1));
        [(sr::RXNE, cr1::RXNEIE), (sr::TC, cr1::TCIE), (sr::TXE, cr1::TXEIE)]
            .iter()
            .any(|(flag, enable)| status & flag != 0 && control & enable != 0)
    }

    /// Takes bytes from the wire.
    pub fn receive(&mut self, bytes: &[u8], now: u64, hz: u32) {
        if !self.is_on(cr1::RE) {
            return;
        }
        if self.incoming.is_empty() {
            self.arrives = self.arrives.max(now).max(now + self.character_ns(hz));
        }
        self.incoming.extend(bytes);
    }

    /// Makes something wrong with the next character that comes.
    pub const fn spoil(&mut self, flaw: Flaw) {
        self.flaw = Some(flaw);
    }

    /// Bytes that may be handed over now.
    #[must_use]
    pub fn room(&self) -> usize {
        ROOM.saturating_sub(self.incoming.len())
    }

    /// When [`Self::step`] is due.
    #[must_use]
    pub fn deadline(&self) -> Option<u64> {
        let comes = !self.incoming.is_empty() && self.may_come();
        let ends = self.shifting.map(|(_, end)| end);
        ends.into_iter().chain(comes.then_some(self.arrives)).min()
    }

    /// Whether the processor is ready for a character: it has read the one before, and seen to the end of its own
    /// transmission. It may only be late because the host has no time for it; then the world waits.
    const fn may_come(&self) -> bool {
        let status = self.get(offset::SR);
        let ended = status & sr::TC != 0 && self.get(offset::CR1) & cr1::TCIE != 0;
        status & sr::RXNE == 0 && !ended
    }

    /// Does what is due.
    pub fn step(&mut self, now: u64, hz: u32) {
        if let Some((byte, end)) = self.shifting.filter(|(_, end)| *end <= now) {
            self.outgoing.push(byte);
            self.shifting = None;
            match self.next.take() {
                // the next start bit follows on the last stop bit
                Some(next) => {
                    self.raise(sr::TXE);
                    self.shift(next, end, hz);
                }
                None => self.raise(sr::TC),
            }
        }
        if self.arrives <= now
            && self.may_come()
            && let Some(byte) = self.incoming.pop_front()
        {
            self.received = byte;
            let flaw = self.flaw.take();
            self.raise(sr::RXNE | flaw.map_or(0, Flaw::flag));
            if flaw == Some(Flaw::Overrun) {
                self.incoming.pop_front();
            }
            self.arrives = now + self.character_ns(hz);
        }
    }

    /// Bytes that have left since this was asked last.
    pub fn outgoing(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.outgoing)
    }

    /// What was on the wire since it was forgotten; bytes without a pause between them are one.
    pub fn sent(&self) -> impl Iterator<Item = &Sent> {
        self.sent.iter()
    }

    /// Forgets what was on the wire.
    pub fn forget(&mut self) {
        self.sent.clear();
    }

    /// How long a character takes: start bit, data and parity, stop bits.
    #[must_use]
    pub fn character_ns(&self, hz: u32) -> u64 {
        let data = if self.get(offset::CR1) & cr1::M == 0 { 8u64 } else { 9 };
        let stop = if self.get(offset::CR2) >> 12 & 0b10 == 0 { 1 } else { 2 };
        let clocks = (1 + data + stop) * u64::from(self.get(offset::BRR).max(1));
        clocks * 1_000_000_000 / u64::from(hz.max(1))
    }

    fn transmit(&mut self, byte: u8, now: u64, hz: u32) {
        if !self.is_on(cr1::TE) {
            return;
        }
        self.clear(sr::TC);
        if self.shifting.is_none() {
            self.shift(byte, now, hz);
        } else {
            self.next = Some(byte);
            self.clear(sr::TXE);
        }
    }

    fn shift(&mut self, byte: u8, start: u64, hz: u32) {
        let end = start + self.character_ns(hz);
        self.shifting = Some((byte, end));
        match self.sent.back_mut() {
            Some(last) if last.end == start => last.end = end,
            _ => {
                if self.sent.len() == KEPT {
                    self.sent.pop_front();
                }
                self.sent.push_back(Sent { start, end });
            }
        }
    }

    const fn is_on(&self, direction: u32) -> bool {
        let both = cr1::UE | direction;
        self.get(offset::CR1) & both == both
    }

    const fn get(&self, offset: u32) -> u32 {
        self.registers[(offset / 4) as usize]
    }

    const fn set(&mut self, offset: u32, value: u32) {
        self.registers[(offset / 4) as usize] = value;
    }

    const fn raise(&mut self, flags: u32) {
        self.set(offset::SR, self.get(offset::SR) | flags);
    }

    const fn clear(&mut self, flags: u32) {
        self.set(offset::SR, self.get(offset::SR) & !flags);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HZ: u32 = 42_000_000;

    /// 115200 baud, 8N1: a character takes 86 904 ns.
    fn usart() -> Usart {
        let mut usart = Usart::new();
        usart.write(offset::BRR, 365, 0, HZ);
        usart.write(offset::CR1, cr1::UE | cr1::TE | cr1::RE | cr1::RXNEIE, 0, HZ);
        assert_eq!(usart.character_ns(HZ), 86_904);
        usart
    }

    #[test]
    fn a_transmission_is_complete_after_the_last_stop_bit() {
        let mut usart = usart();
        usart.write(offset::DR, 0x11, 1000, HZ);
        assert_eq!(usart.read(offset::SR), sr::TXE, "the next may be written at once");
        usart.write(offset::DR, 0x22, 1000, HZ);
        assert_eq!(usart.read(offset::SR), 0);
        assert_eq!(usart.deadline(), Some(87_904));
        usart.step(87_903, HZ);
        assert_eq!(usart.outgoing(), []);
        usart.step(88_000, HZ);
        assert_eq!((usart.outgoing(), usart.read(offset::SR)), (vec![0x11], sr::TXE));
        usart.step(174_808, HZ);
        assert_eq!((usart.outgoing(), usart.read(offset::SR)), (vec![0x22], sr::TXE | sr::TC));
        assert_eq!(usart.deadline(), None);
        assert_eq!(usart.sent().collect::<Vec<_>>(), [&Sent { start: 1000, end: 174_808 }]);
    }

    #[test]
    fn received_bytes_take_their_time_and_none_is_lost() {
        let mut usart = usart();
        usart.receive(&[1, 2], 1000, HZ);
        usart.step(80_000, HZ);
        assert!(!usart.interrupt());
        usart.step(87_904, HZ);
        assert!(usart.interrupt());
        assert_eq!(usart.deadline(), None, "it waits to be read");
        usart.step(500_000, HZ);
        assert_eq!(usart.read(offset::DR), 1);
        assert!(!usart.interrupt());
        assert_eq!(usart.deadline(), Some(174_808));
        usart.step(600_000, HZ);
        assert_eq!(usart.read(offset::DR), 2);
    }

    #[test]
    fn a_reply_waits_until_the_end_of_the_request_was_seen_to() {
        let mut usart = usart();
        let on = cr1::UE | cr1::TE | cr1::RE | cr1::RXNEIE;
        usart.write(offset::CR1, on | cr1::TCIE, 0, HZ);
        usart.write(offset::DR, 0x11, 1000, HZ);
        usart.step(87_904, HZ);
        assert!(usart.interrupt());
        usart.receive(&[1], 90_000, HZ);
        assert_eq!(usart.deadline(), None);
        usart.step(500_000, HZ);
        assert_eq!(usart.read(offset::SR), sr::TXE | sr::TC);
        usart.write(offset::CR1, on, 500_000, HZ);
        assert_eq!(usart.deadline(), Some(176_904));
        usart.step(500_000, HZ);
        assert_eq!(usart.read(offset::DR), 1);
    }

    #[test]
    fn a_flaw_comes_with_one_character_and_goes_when_that_is_read() {
        for (flaw, flag, second) in [
            (Flaw::Parity, sr::PE, 2),
            (Flaw::Framing, sr::FE, 2),
            (Flaw::Noise, sr::NF, 2),
            (Flaw::Overrun, sr::ORE, 3),
        ] {
            let mut usart = usart();
            usart.spoil(flaw);
            usart.receive(&[1, 2, 3], 0, HZ);
            let errors = |status: u32| status & (sr::PE | sr::FE | sr::NF | sr::ORE | sr::RXNE);
            usart.step(100_000, HZ);
            assert_eq!(errors(usart.read(offset::SR)), flag | sr::RXNE);
            assert_eq!(usart.read(offset::DR), 1);
            assert_eq!(errors(usart.read(offset::SR)), 0);
            usart.step(300_000, HZ);
            assert_eq!(errors(usart.read(offset::SR)), sr::RXNE);
            assert_eq!(usart.read(offset::DR), second);
        }
    }

    #[test]
    fn the_format_counts() {
        let mut usart = usart();
        usart.write(offset::CR1, cr1::UE | cr1::TE | cr1::M, 0, HZ);
        usart.write(offset::CR2, 0b10 << 12, 0, HZ);
        assert_eq!(usart.character_ns(HZ), 12 * 365 * 1000 / 42);
    }

    #[test]
    fn a_usart_that_is_off_neither_sends_nor_receives() {
        let mut usart = Usart::new();
        usart.write(offset::DR, 1, 0, HZ);
        usart.receive(&[1], 0, HZ);
        assert_eq!(usart.deadline(), None);
    }
}
