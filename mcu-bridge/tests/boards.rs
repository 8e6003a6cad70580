//! Other boards than the reference board: what this one file says of them is all that there is to say.

use jointbus_mcu_bridge::board::{
    Board, Description, Identification, InputsOutputs, Limits, LocalUnits, Outputs, Port, PortConfig,
    PortDescription, PortKind, Protocol, Route, Target, Topology, UartClock,
};
use jointbus_mcu_bridge::engine::{Action, AnyEngine, Engine, Identity, ResetCause, STORED_LENGTH, Settings};
use jointbus_mcu_bridge::registers::{self, command};
use jointbus_protocol::modbus::{self, AddressRange, Request, rtu};
use jointbus_protocol::nst::{self, can};
use jointbus_protocol::time::{Duration, Instant};

const fn serial(name: &'static str, clock: UartClock) -> PortDescription {
    let default = PortConfig::serial(115_200, 0);
    PortDescription { name, kind: PortKind::Serial { clock }, default }
}

const fn can_port(name: &'static str) -> PortDescription {
    PortDescription { name, kind: PortKind::Can, default: PortConfig::can(500, 100) }
}

const BRIDGE: u8 = 200;

/// A host port and one RS485 bus, no units of its own, no CAN.
#[derive(Debug)]
struct Small;

impl Board for Small {
    const DESCRIPTION: &'static Description = &Description {
        number: 0x8001,
        name: "small",
        identification: Identification { vendor: "Somebody", ..Identification::JOINTBUS },
        ports: &[serial("host", UartClock::ANY), serial("rs485", UartClock::ANY)],
        local: <() as LocalUnits>::KINDS,
        routes: &[
            Route::remote(1, 8, Target::Bus(Port::new(1)), Protocol::ModbusRtu, 11),
            Route::local(BRIDGE, Target::Bridge),
        ],
        limits: Limits { quarantine_after: 5, ..Limits::DEFAULT },
    };
    type Units = ();
}

/// The same and four ports more: as many as there can be, with eight outputs and an input.
#[derive(Debug)]
struct Large;

impl Board for Large {
    const DESCRIPTION: &'static Description = &Description {
        number: 0x8002,
        name: "large",
        identification: Identification::JOINTBUS,
        ports: &[
            serial("host", UartClock::ANY),
            serial("rs485-a", UartClock { hz: 16_000_000, divisor_min: 16, divisor_max: 0xFFFF }),
            serial("rs485-b", UartClock::ANY),
            serial("rs485-c", UartClock::ANY),
            can_port("can-a"),
            can_port("can-b"),
        ],
        local: <Self as Board>::Units::KINDS,
        routes: &[
            Route::remote(1, 2, Target::Bus(Port::new(1)), Protocol::Nst, 1),
            Route::remote(3, 4, Target::Bus(Port::new(2)), Protocol::Nst, 1),
            Route::remote(5, 6, Target::Bus(Port::new(3)), Protocol::Nst, 1),
            Route::remote(7, 8, Target::Bus(Port::new(4)), Protocol::NstOverCan, 1),
            Route::remote(9, 10, Target::Bus(Port::new(5)), Protocol::NstOverCan, 1),
            Route::local(11, Target::Local(0)),
            Route::local(12, Target::Local(1)),
            Route::local(13, Target::Local(2)),
            Route::local(BRIDGE, Target::Bridge),
        ],
        limits: Limits::DEFAULT,
    };
    type Units = (Outputs, Outputs, InputsOutputs<1, 0, 0>);
}

const START: Instant = Instant::from_micros(1_000_000);
const IDENTITY: Identity = Identity { version: [1, 2, 3], reset_cause: ResetCause::PowerOn };

fn small() -> Box<dyn AnyEngine> {
    type SmallEngine =
        Engine<Small, { Small::DESCRIPTION.serial_buses() }, { Small::DESCRIPTION.can_buses() }>;
    Box::new(SmallEngine::new(IDENTITY, START))
}

fn large() -> Engine<Large, 3, 2> {
    Engine::new(IDENTITY, START)
}

/// The answer of the host's port to a request.
fn ask(engine: &mut dyn AnyEngine, unit: u8, request: &Request<'_>, now: Instant) -> Vec<u8> {
    let mut buffer = [0; 256];
    engine.receive(Port::HOST, rtu::encode_request(unit, request, &mut buffer).unwrap(), now);
    take(engine)
}

fn take(engine: &mut dyn AnyEngine) -> Vec<u8> {
    let answer = engine.output(Port::HOST).to_vec();
    engine.advance(Port::HOST, answer.len());
    answer
}

fn inputs(engine: &mut dyn AnyEngine, first: u16, count: u16) -> Vec<u16> {
    let request = Request::ReadInputRegisters(AddressRange::new(first, count));
    let answer = ask(engine, BRIDGE, &request, START);
    answer[3..answer.len() - 2].as_chunks().0.iter().map(|pair| u16::from_be_bytes(*pair)).collect()
}

fn write(engine: &mut dyn AnyEngine, address: u16, value: u16) -> bool {
    let answer = ask(engine, BRIDGE, &Request::WriteSingleRegister { address, value }, START);
    answer[1] == 6
}

#[test]
fn the_register_map_follows_the_board() {
    let first = registers::PORT_COUNT.address;
    assert_eq!(inputs(&mut *small(), first, 5), [2, 2, 16, 8, 0x8001]);
    assert_eq!(inputs(&mut *small(), registers::TARGET.address, 16), {
        let mut kinds = [0; 16];
        kinds[..2].copy_from_slice(&[0x0101, 0x0006]);
        kinds
    });
    assert_eq!(inputs(&mut large(), first, 5), [6, 9, 16, 8, 0x8002]);
    let kinds = [0x0101, 0x0201, 0x0301, 0x0402, 0x0502, 4, 4, 5, 6];
    assert_eq!(inputs(&mut large(), registers::TARGET.address, 9), kinds);

    let mut small = small();
    assert!(!write(&mut *small, registers::PORT_RATE.at(2), 1152), "there is no such port");
    assert!(write(&mut *small, registers::PORT_RATE.at(1), 96));
    assert!(!write(&mut *small, registers::ROUTE_TARGET.at(0), 3), "there is no such target");
    assert!(write(&mut *small, registers::ROUTE_TARGET.at(3), 2));
    let mut large = large();
    assert!(write(&mut large, registers::PORT_RATE.at(5), 1000));
    assert!(write(&mut large, registers::ROUTE_TARGET.at(0), 9));
    assert!(!write(&mut large, registers::ROUTE_TARGET.at(0), 10));
}

#[test]
fn defaults_are_those_of_the_board() {
    let mut engine = small();
    assert!(write(&mut *engine, registers::QUARANTINE_AFTER.address, 9));
    assert!(write(&mut *engine, registers::ROUTE_FIRST_ADDRESS.at(0), 20));
    assert!(write(&mut *engine, registers::COMMAND.address, command::DEFAULTS));
    let mut stored = [0; STORED_LENGTH];
    engine.encode_settings(&mut stored);
    let settings = Settings::decode(&stored, Small::DESCRIPTION).unwrap();
    assert_eq!(settings, Settings::of(Small::DESCRIPTION));
    assert_eq!((settings.limits.quarantine_after, settings.topology.routes[0].first_address), (5, 11));
    assert_eq!(settings.topology, Topology::of(Small::DESCRIPTION));
    assert_eq!(Settings::decode(&stored, Large::DESCRIPTION), None, "another board's");
}

#[test]
fn a_board_has_its_own_name_for_the_host() {
    let mut engine = small();
    let vendor =
        Request::Other { function: modbus::FunctionCode::EncapsulatedInterface, data: &[0x0E, 4, 0] };
    let answer = ask(&mut *engine, BRIDGE, &vendor, START);
    assert_eq!(answer[answer.len() - 12..answer.len() - 2], *b"\x00\x08Somebody");
}

#[test]
fn a_rate_that_the_clock_cannot_make_does_not_fit() {
    let mut engine = large();
    assert!(write(&mut engine, registers::PORT_RATE.at(1), 9216));
    assert!(!write(&mut engine, registers::COMMAND.address, command::APPLY), "2.1 % off at 16 MHz");
    assert!(write(&mut engine, registers::PORT_RATE.at(1), 1152));
    assert!(write(&mut engine, registers::PORT_RATE.at(2), 9216));
    assert!(write(&mut engine, registers::COMMAND.address, command::APPLY));
    assert_eq!(actions(&mut engine, START), [Action::Outputs, Action::Configure(Port::new(2))]);
}

fn actions(engine: &mut dyn AnyEngine, now: Instant) -> Vec<Action> {
    std::iter::from_fn(|| engine.poll(now)).collect()
}

/// A frame of NST, or of Modbus: unit, body, CRC.
fn frame(unit: u8, body: &[u8]) -> Vec<u8> {
    let request = Request::Other { function: modbus::FunctionCode::from_code(body[0]), data: &body[1..] };
    rtu::encode_request(unit, &request, &mut [0; 256]).unwrap().to_vec()
}

#[test]
fn every_bus_of_a_large_board_carries_requests_beside_the_others() {
    let mut engine = large();
    let read = [0x03, 0x02, 0x00, 0x03];
    let reply = |bus: u8| [0x03, 3, 1, 2, bus];
    let units = [1, 3, 5, 7, 9];
    units.iter().for_each(|unit| engine.receive(Port::HOST, &frame(*unit, &read), START));
    let later = START.saturating_add(Duration::from_millis(10));
    let _ = actions(&mut engine, later);
    let mut answers = Vec::new();
    for bus in 1..=5u8 {
        let port = Port::new(bus);
        if bus <= 3 {
            assert_eq!(engine.output(port), frame(1, &read));
            engine.advance(port, 8);
            engine.transmit_complete(port, later);
            let end = later.saturating_add(Duration::from_millis(5));
            engine.receive(port, &frame(1, &reply(bus)), end);
        } else {
            let sent = engine.next_frame(port).unwrap();
            let asked: Vec<_> = can::segment(100, 1, &read).unwrap().collect();
            assert_eq!([sent], asked[..]);
            engine.frame_sent(port, later);
            for sent in can::segment(1, 100, &reply(bus)).unwrap() {
                engine.receive_frame(port, &sent, later.saturating_add(Duration::from_millis(1)));
            }
        }
        answers.extend(frame(units[usize::from(bus) - 1], &reply(bus)));
        assert_eq!(engine.counters(port).received, 1);
    }
    assert_eq!(take(&mut engine), answers);
}

#[test]
fn a_broadcast_reaches_every_bus_and_every_unit_of_its_own() {
    let mut engine = large();
    engine.receive(Port::HOST, &frame(nst::BROADCAST, &[0x12, 0x01, 0xA7, 24]), START);
    let later = START.saturating_add(Duration::from_millis(30));
    assert_eq!(actions(&mut engine, later), [Action::Outputs]);
    for bus in 1..=3 {
        assert_eq!(engine.output(Port::new(bus)), frame(nst::BROADCAST, &[0x12, 0x01, 0xA7, 24]));
    }
    assert!((4..=5).all(|bus| engine.next_frame(Port::new(bus)).is_some()));

    // the outputs of an NXI-6201 listen to 255: output on, channel 1
    let on = Request::WriteMultipleRegisters { range: AddressRange::new(6, 2), data: &[0, 1, 0, 0] };
    engine.receive(Port::HOST, rtu::encode_request(255, &on, &mut [0; 256]).unwrap(), later);
    let end = later.saturating_add(Duration::from_millis(30));
    assert_eq!(actions(&mut engine, end), [Action::Outputs]);
    let units = engine.units();
    assert!(units.0.settings().channels[0].output && units.1.settings().channels[0].output);
    assert_eq!(take(&mut engine), []);
}

#[test]
fn a_board_without_units_of_its_own_and_without_can_has_none() {
    let mut engine = small();
    assert_eq!(actions(&mut *engine, START), []);
    engine.receive_frame(Port::new(2), &can::segment(1, 2, &[3]).unwrap().next().unwrap(), START);
    assert!(engine.next_frame(Port::new(1)).is_none() && engine.output(Port::new(2)).is_empty());
    assert!(engine.port(Port::new(2)).is_none());
    assert_eq!(engine.counters(Port::new(1)).received, 0);
}
