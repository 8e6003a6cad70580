//! What a run does: all of it follows from a seed.

use super::boards::{STATION_GAP, SimBoard};
use super::delay::Delay;
use super::fault::{Fault, Place};
use super::moment::{MICROS, MILLIS};
use super::random::Random;
use super::routes;
use super::run::Run;
use super::settings::Settings;
use super::tally::Tally;
use jointbus_mcu_bridge::board::{Port, Protocol, Route, Topology};

/// Whether the host waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Manner {
    /// For each answer, for so many milliseconds at most; an answer may well come later.
    Waits(u64),
    /// For nothing: requests come one to so many microseconds apart.
    Streams(u64),
    /// For nothing: a request comes each so many microseconds.
    Paces(u64),
}

/// What a run does.
#[derive(Debug, Clone)]
pub struct Plan {
    /// What is simulated.
    pub settings: Settings,
    /// Requests to be asked.
    pub requests: u64,
    /// Whether the host waits.
    pub manner: Manner,
    /// Kinds of fault that come.
    pub faults: Vec<Fault>,
    /// Chance of a fault before each request, in a million.
    pub fault_rate: u64,
    /// So many requests in a million are broadcasts.
    pub broadcast_rate: u64,
}

impl Plan {
    /// The plan of a seed for a board: everything from calm to rough, with all kinds of fault that the board can have
    /// unless they are given.
    #[must_use]
    pub fn of_seed(board: SimBoard, seed: u64, requests: u64, kinds: Option<&[Fault]>) -> Self {
        let mut random = Random::new(seed ^ 0x5EED);
        let mut settings = Settings::new(board, seed);
        let delay = |random: &mut Random| match random.below(3) {
            0 => Delay::PROMPT,
            1 => Delay::Moody(200 * MICROS, 20_000),
            _ => Delay::Moody(random.between(100, 5000) * MICROS, 50_000),
        };
        settings.sensor_delay = delay(&mut random);
        settings.node_delay = delay(&mut random);
        if random.below(2) == 0 {
            settings.station_delay = Delay::Moody(2 * MILLIS, 20_000);
        }
        // some buses speak the other protocol
        if board.changes_protocols {
            for port in board.serial_buses().filter(|_| random.chance(400_000)) {
                change_protocol(&mut settings.network, port);
            }
        }
        // some ports hear themselves
        for port in board.serial_buses() {
            settings.network.ports[port.index()].echo = random.chance(300_000);
        }
        // and some stations speak Modbus ASCII
        for port in board.serial_buses() {
            if routes::speaks_modbus(&settings.network, port) && random.chance(250_000) {
                routes::to_bus_mut(&mut settings.network, port)
                    .for_each(|row| row.protocol = Protocol::ModbusAscii);
            }
        }
        settings.latency = Delay::Uniform(2 * MICROS, random.pick(&[10, 30, 100]) * MICROS);
        let manner = match random.below(3) {
            0 => Manner::Waits(random.pick(&[60, 200, 10_000])),
            _ => Manner::Streams(random.pick(&[500, 3000, 20_000])),
        };
        let fault_rate = random.pick(&[3000, 20_000, 100_000]);
        let mut faults = kinds.unwrap_or(Fault::ALL).to_vec();
        faults.retain(|fault| can_come(*fault, &settings));
        Self { settings, requests, manner, faults, fault_rate, broadcast_rate: 20_000 }
    }

    /// The plan of a seed in which most bursts of the host are broken frames with a valid command in their data, or
    /// broadcasts behind stray bytes.
    #[must_use]
    pub fn hiding(board: SimBoard, seed: u64, requests: u64) -> Self {
        const HIDING: [Fault; 5] = [
            Fault::HostHiddenCommand,
            Fault::HostHiddenCommand,
            Fault::HostHiddenBehind,
            Fault::HostHiddenBehind,
            Fault::HostStrayBroadcast,
        ];
        Self { fault_rate: 900_000, ..Self::of_seed(board, seed, requests, Some(&HIDING)) }
    }

    /// Carries the plan out.
    #[must_use]
    pub fn run(self) -> Tally {
        let mut queues = self.settings.board.queues();
        let mut run = Run::new(self, &mut queues);
        run.to_the_end();
        run.master.tally
    }
}

/// Whether a fault can come on a board with these routes: whether there is what it happens to.
fn can_come(fault: Fault, settings: &Settings) -> bool {
    let Settings { board, network, .. } = settings;
    match (fault, fault.place()) {
        (Fault::ReplyException, _) => board.serial_buses().any(|port| routes::speaks_modbus(network, port)),
        // function codes that NST does not have
        (Fault::HostUnknownFunction, _) => {
            board.description.ports().any(|port| routes::speaks_nst(network, port))
        }
        (_, Place::Serial) => board.serial_buses().next().is_some(),
        (_, Place::Can) => board.can_buses().next().is_some(),
        (_, Place::Host) => true,
    }
}

/// Has an RS485 bus speak Modbus RTU where it speaks NST, and the other way round, with the times that are usual there.
fn change_protocol(network: &mut Topology, port: Port) {
    let is_nst = routes::speaks_nst(network, port);
    let (protocol, gap) = if is_nst { (Protocol::ModbusRtu, STATION_GAP) } else { (Protocol::Nst, 0) };
    network.ports[port.index()].gap_100us = gap;
    for row in routes::to_bus_mut(network, port) {
        let Route { first_unit, last_unit, target, first_address, .. } = *row;
        *row = Route::remote(first_unit, last_unit, target, protocol, first_address);
    }
}
