//! Which questions the host asks.

use super::boards::{INPUTS, SimBoard};
use super::question::{Question, UNSUPPORTED};
use super::random::Random;
use super::settings::Settings;
use super::station::{MODULES, PATTERN, SCRATCH};
use jointbus_mcu_bridge::board::{LocalKind, Protocol, Target, Topology};
use jointbus_protocol::nst::SAMPLE_LENGTH;

/// Length of a long write.
const LONG_WRITE: u8 = 64;

/// Makes up questions; no two that are open at once are alike.
#[derive(Debug)]
pub struct Questions {
    board: SimBoard,
    network: Topology,
    random: Random,
    token: u32,
    register: u16,
    units: Vec<u8>,
    /// So many questions in a million are writes or commands.
    pub writes: u64,
    /// So many writes to modules in a million have a function code that they do not know.
    pub unsupported: u64,
    /// Length of the shortest reading of the axes.
    pub shortest_sample: u8,
    /// Longest reading of a pattern, and longest write.
    pub longest: u8,
}

impl Questions {
    /// Questions to the sensors and modules that a bridge reaches, to the board's own units, and to the bridge itself.
    #[must_use]
    pub fn new(settings: &Settings, mut random: Random) -> Self {
        let Settings { board, network, sensors, nodes, .. } = *settings;
        let mut units = Vec::new();
        for row in network.routes.iter().filter(|row| row.is_used()) {
            let last = match (row.target, row.protocol) {
                (Target::Bus(_), Protocol::NstOverCan) => nodes,
                (Target::Bus(_), Protocol::Nst) => sensors,
                (Target::Bus(_), Protocol::ModbusRtu | Protocol::ModbusAscii) => MODULES as u8,
                (Target::Bridge | Target::Local(_), _) => u8::MAX,
            };
            units.extend((row.first_unit..=row.last_unit).filter(|unit| row.remote_of(*unit) <= last));
        }
        let token = 0x0100_0000 + (random.next() as u32 & 0x00FF_FFFF);
        Self {
            board,
            network,
            random,
            token,
            register: PATTERN.start,
            units,
            writes: 300_000,
            unsupported: 100_000,
            shortest_sample: SAMPLE_LENGTH as u8,
            longest: 200,
        }
    }

    /// The units that are asked.
    pub(super) fn units(&self) -> &[u8] {
        &self.units
    }

    /// Asks only these units.
    pub fn only(&mut self, units: &[u8]) {
        self.units = units.to_vec();
    }

    /// A unit and a question to it.
    pub fn pick(&mut self) -> (u8, Question) {
        let unit = self.random.pick(&self.units);
        (unit, self.for_unit(unit))
    }

    /// A number of which no half is 0, which an order without a number has.
    const fn next_token(&mut self) -> u32 {
        self.token = self.token.wrapping_add(0x1_0001);
        if self.token as u16 == 0 || self.token >> 16 == 0 {
            self.token = self.token.wrapping_add(0x1_0001);
        }
        self.token
    }

    /// A write to all modules, as unit 0, or to all sensors, as unit 255.
    pub(super) fn broadcast(&mut self) -> (u8, Question) {
        let token = self.next_token();
        match self.random.below(3) {
            0 => (0, Question::SetOne { channel: self.random.below(16) as u8, token: token as u16 }),
            1 => (0, Question::SetTwo { channel: self.random.below(15) as u8, token }),
            _ => {
                let length = self.random.pick(&[4, 8, 18]);
                (u8::MAX, Question::Write { register: SCRATCH.start, length, token })
            }
        }
    }

    /// A question to this unit.
    pub fn for_unit(&mut self, unit: u8) -> Question {
        let token = self.next_token();
        let short = token as u16;
        let bus = self.network.route(unit).map(|(_, route)| (route.target, route.protocol.is_nst()));
        let write = self.random.chance(self.writes);
        match bus {
            Some((_, true)) if write => match self.random.below(8) {
                0 => Question::Command { set: self.random.chance(500_000) },
                1 if self.longest >= LONG_WRITE => {
                    Question::Write { register: SCRATCH.start, length: LONG_WRITE, token }
                }
                _ => {
                    let length = self.random.pick(&[4, 4, 8, 18]);
                    let register =
                        self.random.between(SCRATCH.start.into(), (SCRATCH.end - 18).into()) as u16;
                    Question::Write { register, length, token }
                }
            },
            Some((_, true)) => match self.random.below(3) {
                0 => Question::Sample { length: self.shortest_sample + self.random.below(16) as u8 },
                _ => {
                    let length = match self.random.below(16) {
                        0 => self.random.between(19, self.longest.max(19).into()) as u8,
                        1..4 => 18,
                        _ => self.random.pick(&[4, 5, 8]),
                    };
                    self.register += 1;
                    if self.register + u16::from(length) > PATTERN.end {
                        self.register = PATTERN.start;
                    }
                    Question::Pattern { register: self.register, length }
                }
            },
            Some((Target::Bridge, false)) => match self.random.below(4) {
                0 => Question::Slot,
                _ => Question::Loopback { token: short },
            },
            Some((Target::Local(index), false)) => self.for_local(index, write, short),
            _ if write && self.random.chance(self.unsupported) => {
                Question::Unsupported { function: self.random.pick(&UNSUPPORTED), token: short }
            }
            _ if write => {
                let channel = self.random.below(15) as u8;
                match self.random.below(2) {
                    0 => Question::SetOne { channel, token: short },
                    _ => Question::SetTwo { channel, token },
                }
            }
            _ if self.random.below(10) == 0 => Question::Nowhere,
            _ => {
                let count = self.random.pick(&[2, 2, 3, 8]);
                Question::Inputs { first: self.random.below(16 - u64::from(count)) as u8, count }
            }
        }
    }

    /// A question to one of the board's own units.
    fn for_local(&mut self, index: u8, write: bool, token: u16) -> Question {
        match (self.board.local(index), write) {
            (Some(LocalKind::Ndam), true) => {
                let on = self.random.chance(500_000);
                Question::BoardOutput { channel: self.random.below(8) as u8, on }
            }
            (Some(LocalKind::Ndam), false) => {
                let first = self.random.below(INPUTS.len() as u64) as u8;
                let most = INPUTS.len() as u64 - u64::from(first);
                Question::BoardInputs { first, count: self.random.between(1, most) as u8 }
            }
            (_, true) => Question::CardValue { channel: self.random.below(4) as u8, token },
            (_, false) => Question::CardRate,
        }
    }
}
