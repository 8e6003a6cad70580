//! The boards that are simulated: the reference board, a small one and a large one.

use jointbus_mcu_bridge::board::{
    Analog, Board, Description, Identification, Limits, LocalKind, LocalUnits, Outputs, Port, PortConfig,
    PortDescription, PortKind, Protocol, Route, Target, UartClock,
};
use jointbus_mcu_bridge::boards::stm32f405::{self, Stm32f405};
use jointbus_mcu_bridge::engine::{AnyEngine, Engine, Identity, ResetCause};
use jointbus_mcu_bridge::io::serial::UartBuffers;
use jointbus_protocol::time::Instant;
use std::iter;

/// What is at the analog inputs of a board that has such.
pub(super) const INPUTS: Analog<4> = [0x1357, 0x2468, 0x0F1E, 0x7A8B];

const fn serial(name: &'static str, default: PortConfig) -> PortDescription {
    PortDescription { name, kind: PortKind::Serial { clock: UartClock::ANY }, default }
}

const fn can(name: &'static str, default: PortConfig) -> PortDescription {
    PortDescription { name, kind: PortKind::Can, default }
}

/// The least that makes a bridge: a host port and one RS485 bus, no units of its own and no CAN.
#[derive(Debug)]
pub struct Small;

impl Board for Small {
    const DESCRIPTION: &'static Description = &Description {
        number: 0x8001,
        name: "small",
        identification: Identification::JOINTBUS,
        ports: &[
            serial("host", PortConfig::serial(921_600, 0)),
            serial("rs485", PortConfig::serial(115_200, 0)),
        ],
        local: <Self as Board>::Units::KINDS,
        routes: &[
            Route::remote(1, 8, Target::Bus(Port::new(1)), Protocol::Nst, 1),
            Route::local(247, Target::Bridge),
        ],
        limits: Limits::DEFAULT,
    };
    type Units = ();
}

/// As many ports as there can be: three RS485 and two CAN buses at different rates, and eight outputs as two cards of four.
#[derive(Debug)]
pub struct Large;

impl Board for Large {
    const DESCRIPTION: &'static Description = &Description {
        number: 0x8002,
        name: "large",
        identification: Identification::JOINTBUS,
        ports: &[
            serial("host", PortConfig::serial(921_600, 0)),
            serial("rs485-a", PortConfig::serial(115_200, 0)),
            serial("rs485-b", PortConfig::serial(19_200, STATION_GAP)),
            serial("rs485-c", PortConfig::serial(460_800, 0)),
            can("can-a", PortConfig::can(1000, 127)),
            can("can-b", PortConfig::can(250, 100)),
        ],
        local: <Self as Board>::Units::KINDS,
        routes: &[
            Route::remote(1, 8, Target::Bus(Port::new(4)), Protocol::NstOverCan, 1),
            // not from the first node on
            Route::remote(9, 13, Target::Bus(Port::new(5)), Protocol::NstOverCan, 3),
            Route::remote(16, 30, Target::Bus(Port::new(1)), Protocol::Nst, 1),
            Route::local(31, Target::Local(0)),
            Route::remote(32, 39, Target::Bus(Port::new(2)), Protocol::ModbusRtu, 1),
            Route::local(40, Target::Local(1)),
            Route::remote(41, 44, Target::Bus(Port::new(3)), Protocol::Nst, 2),
            Route::local(247, Target::Bridge),
        ],
        limits: Limits::DEFAULT,
    };
    type Units = (Outputs, Outputs);
}

/// Silence before a frame in 100 us where an NDAM station listens, which delimits frames by 10 ms.
pub(super) const STATION_GAP: u16 = 110;

/// A board to simulate.
#[derive(Debug, Clone, Copy)]
pub struct SimBoard {
    /// What it says of itself.
    pub description: &'static Description,
    /// Makes its engine, and tells it what is at the board's inputs.
    start: fn(Identity, Instant) -> Box<dyn AnyEngine>,
    /// Whether a plan may change what its RS485 buses speak.
    pub(super) changes_protocols: bool,
}

/// An engine of a board whose units have no inputs.
fn engine<B: Board, const SERIAL: usize, const CAN: usize>(
    identity: Identity,
    now: Instant,
) -> Box<dyn AnyEngine> {
    Box::new(Engine::<B, SERIAL, CAN>::new(identity, now))
}

fn stm32f405(identity: Identity, now: Instant) -> Box<dyn AnyEngine> {
    let mut engine = Box::new(stm32f405::Engine::new(identity, now));
    engine.units_mut().1.set_inputs(0, INPUTS);
    engine
}

impl SimBoard {
    /// The reference board.
    pub const STM32F405: Self =
        Self { description: Stm32f405::DESCRIPTION, start: stm32f405, changes_protocols: false };

    /// The [small](Small) board.
    pub const SMALL: Self = Self {
        description: Small::DESCRIPTION,
        start: engine::<Small, { Small::DESCRIPTION.serial_buses() }, { Small::DESCRIPTION.can_buses() }>,
        changes_protocols: true,
    };

    /// The [large](Large) board.
    pub const LARGE: Self = Self {
        description: Large::DESCRIPTION,
        start: engine::<Large, { Large::DESCRIPTION.serial_buses() }, { Large::DESCRIPTION.can_buses() }>,
        changes_protocols: true,
    };

    /// All of them.
    pub const ALL: [Self; 3] = [Self::STM32F405, Self::SMALL, Self::LARGE];

    /// The board whose turn it is with a seed.
    #[must_use]
    pub const fn of_seed(seed: u64) -> Self {
        Self::ALL[(seed % Self::ALL.len() as u64) as usize]
    }

    /// The board of that name.
    #[must_use]
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|board| board.name() == name)
    }

    /// Its name on the command line.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        self.description.name
    }

    /// Its serial buses.
    pub fn serial_buses(&self) -> impl Iterator<Item = Port> + Clone + use<> {
        let count = self.description.serial_buses();
        self.description.ports().skip(1).take(count)
    }

    /// Its CAN buses.
    pub fn can_buses(&self) -> impl Iterator<Item = Port> + Clone + use<> {
        self.description.ports().skip(1 + self.description.serial_buses())
    }

    /// What its own unit at that place is to the host.
    #[must_use]
    pub fn local(&self, index: u8) -> Option<LocalKind> {
        self.description.local.get(usize::from(index)).copied()
    }

    /// The queues between the interrupts of its serial ports and its main loop.
    #[must_use]
    pub fn queues(&self) -> Vec<UartBuffers> {
        iter::repeat_with(UartBuffers::new).take(1 + self.description.serial_buses()).collect()
    }

    /// Its engine, as it is after power on.
    pub(super) fn start(&self, now: Instant) -> Box<dyn AnyEngine> {
        (self.start)(Identity { version: jointbus::version(), reset_cause: ResetCause::PowerOn }, now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_board_has_a_name_and_queues_of_its_own() {
        for board in SimBoard::ALL {
            assert!(board.description.is_sound());
            assert_eq!(SimBoard::of_name(board.name()).map(|it| it.description), Some(board.description));
            assert_eq!(board.start(Instant::from_micros(0)).board(), board.description);
            assert_eq!(board.queues().len() + board.can_buses().count(), board.description.ports.len());
        }
        assert!((0..3).map(SimBoard::of_seed).map(|board| board.name()).eq(["stm32f405", "small", "large"]));
    }
}
