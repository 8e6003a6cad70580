//! What a run does: all of it follows from a seed.

use super::delay::Delay;
use super::fault::Fault;
use super::moment::{MICROS, MILLIS};
use super::random::Random;
use super::run::Run;
use super::settings::Settings;
use super::tally::Tally;
use jointbus_mcu_bridge::board::{Protocol, Target};
use jointbus_mcu_bridge::boards::stm32f405::{RS485_A, RS485_B};
use jointbus_mcu_bridge::io::serial::UartBuffers;

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
    /// The plan of a seed: everything from calm to rough, with all kinds of fault unless they are given.
    #[must_use]
    pub fn of_seed(seed: u64, requests: u64, kinds: Option<&[Fault]>) -> Self {
        let mut random = Random::new(seed ^ 0x5EED);
        let mut settings = Settings::new(seed);
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
        // some ports hear themselves
        for port in [RS485_A, RS485_B] {
            settings.network.ports[port.index()].echo = random.chance(300_000);
        }
        // and some stations speak Modbus ASCII
        if random.chance(250_000) {
            let rows = settings.network.routes.iter_mut();
            rows.filter(|row| row.target == Target::Bus(RS485_B))
                .for_each(|row| row.protocol = Protocol::ModbusAscii);
        }
        settings.latency = Delay::Uniform(2 * MICROS, random.pick(&[10, 30, 100]) * MICROS);
        let manner = match random.below(3) {
            0 => Manner::Waits(random.pick(&[60, 200, 10_000])),
            _ => Manner::Streams(random.pick(&[500, 3000, 20_000])),
        };
        let fault_rate = random.pick(&[3000, 20_000, 100_000]);
        let faults = kinds.unwrap_or(Fault::ALL).to_vec();
        Self { settings, requests, manner, faults, fault_rate, broadcast_rate: 20_000 }
    }

    /// The plan of a seed in which most bursts of the host are broken frames with a valid command in their data, or
    /// broadcasts behind stray bytes.
    #[must_use]
    pub fn hiding(seed: u64, requests: u64) -> Self {
        const HIDING: [Fault; 5] = [
            Fault::HostHiddenCommand,
            Fault::HostHiddenCommand,
            Fault::HostHiddenBehind,
            Fault::HostHiddenBehind,
            Fault::HostStrayBroadcast,
        ];
        Self { fault_rate: 900_000, ..Self::of_seed(seed, requests, Some(&HIDING)) }
    }

    /// Carries the plan out.
    #[must_use]
    pub fn run(self) -> Tally {
        let mut queues = [UartBuffers::new(), UartBuffers::new(), UartBuffers::new()];
        let mut run = Run::new(self, &mut queues);
        run.to_the_end();
        run.master.tally
    }
}
