//! The cost of one more route, slot, unit and port: the same work over few, some and all of them.

use std::hint::black_box;

use jointbus_mcu_bridge::board::{
    Board, Description, Identification, Limits, LocalUnits, Outputs, Port, PortConfig, PortDescription,
    PortKind, Protocol, ROUTES, Route, Target, Topology, UartClock,
};
use jointbus_mcu_bridge::engine::{AnyEngine, Engine, Identity, ResetCause, Settings};
use jointbus_mcu_bridge::registers::SLOTS;
use jointbus_protocol::modbus::{AddressRange, Request, rtu};
use jointbus_protocol::time::{Duration, Instant};

use crate::count;

const START: Instant = Instant::from_micros(1_000_000);

/// The bridge's own unit.
const BRIDGE: u8 = 247;

/// Counts all of it.
pub(crate) fn all() {
    for routes in [1, ROUTES / 2, ROUTES] {
        let mut engine = boxed::<Ports<1>, 1, 0>();
        engine.restore(&with_routes(routes), START);
        request(&mut *engine, "one more route", routes, routes as u8);
    }
    for slots in [1, SLOTS / 2, SLOTS] {
        let mut engine = boxed::<Ports<1>, 1, 0>();
        engine.restore(&with_slots(slots), START);
        turn(&mut *engine, "one more slot", slots);
    }
    request(&mut *boxed::<Units1, 1, 0>(), "one more unit", 1, 1);
    request(&mut *boxed::<Units2, 1, 0>(), "one more unit", 2, 2);
    request(&mut *boxed::<Units4, 1, 0>(), "one more unit", 4, 4);
    turn(&mut *boxed::<Ports<1>, 1, 0>(), "one more port", 1);
    turn(&mut *boxed::<Ports<3>, 3, 0>(), "one more port", 3);
    turn(&mut *boxed::<Ports<5>, 5, 0>(), "one more port", 5);
}

/// A request for a unit, from its first byte to what it sets going.
fn request(engine: &mut dyn AnyEngine, subject: &str, number: usize, unit: u8) {
    settle(engine, START);
    let mut buffer = [0; rtu::FRAME_MAX];
    let asked = Request::ReadHoldingRegisters(AddressRange::new(0, 1));
    let frame = rtu::encode_request(unit, &asked, &mut buffer).unwrap_or(&[]);
    count(subject, &number.to_string(), || engine.receive(Port::HOST, black_box(frame), START));
}

/// A turn of the main loop in which all slots and ports are looked at.
fn turn(engine: &mut dyn AnyEngine, subject: &str, number: usize) {
    settle(engine, START);
    let mut now = START;
    count(subject, &number.to_string(), || {
        now = now.saturating_add(PERIOD);
        settle(engine, black_box(now));
    });
}

/// The period of a slot, which is the time from turn to turn.
const PERIOD: Duration = Duration::from_micros(100);

fn settle(engine: &mut dyn AnyEngine, now: Instant) {
    // nothing came, and all is due
    engine.transmit_complete(Port::new(1), now);
    while let Some(action) = engine.poll(now) {
        let _ = black_box(action);
    }
}

/// The last of so many routes leads to the bus.
fn with_routes(count: usize) -> Settings {
    let mut topology = Topology { routes: [Route::UNUSED; ROUTES], ..Topology::of(Ports::<1>::DESCRIPTION) };
    for (row, unit) in topology.routes.iter_mut().zip(1..=count as u8) {
        *row = Route::remote(unit, unit, Target::Bus(Port::new(1)), Protocol::ModbusRtu, unit);
    }
    Settings { topology, ..Settings::of(Ports::<1>::DESCRIPTION) }
}

/// Slots that read as often as they can.
fn with_slots(count: usize) -> Settings {
    let mut settings = Settings::of(Ports::<1>::DESCRIPTION);
    for (slot, unit) in settings.slots.iter_mut().zip(1..).take(count) {
        *slot = (unit, 1);
    }
    settings
}

fn boxed<B: Board, const SERIAL: usize, const CAN: usize>() -> Box<dyn AnyEngine>
where
    Engine<B, SERIAL, CAN>: AnyEngine,
{
    let identity = Identity { version: [0; 3], reset_cause: ResetCause::PowerOn };
    Box::new(Engine::<B, SERIAL, CAN>::new(identity, START))
}

const fn serial(name: &'static str) -> PortDescription {
    let kind = PortKind::Serial { clock: UartClock::ANY };
    PortDescription { name, kind, default: PortConfig::serial(115_200, 0) }
}

/// The host's port, and five buses.
const PORTS: &[PortDescription] =
    &[serial("host"), serial("a"), serial("b"), serial("c"), serial("d"), serial("e")];

/// A board with so many buses.
#[derive(Debug)]
struct Ports<const BUSES: usize>;

impl<const BUSES: usize> Board for Ports<BUSES> {
    const DESCRIPTION: &'static Description = &Description {
        number: 0x8000,
        name: "ports",
        identification: Identification::JOINTBUS,
        ports: PORTS.split_at(BUSES + 1).0,
        local: <() as LocalUnits>::KINDS,
        routes: &[
            Route::remote(1, 8, Target::Bus(Port::new(1)), Protocol::Nst, 1),
            Route::local(BRIDGE, Target::Bridge),
        ],
        limits: Limits::DEFAULT,
    };
    type Units = ();
}

/// Boards with units of their own.
macro_rules! units {
    ($($board:ident: $units:ty, $count:expr;)*) => {$(
        #[derive(Debug)]
        struct $board;

        impl Board for $board {
            const DESCRIPTION: &'static Description = &Description {
                number: 0x8001,
                name: "units",
                identification: Identification::JOINTBUS,
                ports: PORTS.split_at(2).0,
                local: <$units as LocalUnits>::KINDS,
                routes: UNITS.split_at(4 - $count).1,
                limits: Limits::DEFAULT,
            };
            type Units = $units;
        }
    )*};
}

units! {
    Units1: (Outputs,), 1;
    Units2: (Outputs, Outputs), 2;
    Units4: (Outputs, Outputs, Outputs, Outputs), 4;
}

/// The routes of four units, the bridge behind them.
const UNITS: &[Route] = &[
    Route::local(4, Target::Local(3)),
    Route::local(3, Target::Local(2)),
    Route::local(2, Target::Local(1)),
    Route::local(1, Target::Local(0)),
    Route::local(BRIDGE, Target::Bridge),
];
