//! The whole bridge: any bytes and frames on all its ports, at any pace, with ports that take their time. It never
//! holds more than it has room for, never asks to be woken for nothing, and when everything is quiet again its own
//! unit answers.
#![no_main]

use jointbus_fuzz::{Script, sealed};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, Engine, RS485_A, RS485_B};
use jointbus_mcu_bridge::engine::{Action, Identity, ResetCause, STORED_LENGTH, Settings};
use jointbus_mcu_bridge::registers;
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::time::{Duration, Instant};
use libfuzzer_sys::fuzz_target;

/// Longer than any time limit that can be configured.
const QUIET: Duration = Duration::from_millis(600_000);

/// More than the engine has to do in that time, and less than forever.
const WAKES: usize = 100_000;

fuzz_target!(|data: &[u8]| {
    let identity = Identity { version: [1, 2, 3], reset_cause: ResetCause::PowerOn };
    let mut now = Instant::from_micros(1_000_000);
    let mut board = Board { engine: Engine::new(identity, now), aborting: false, storing: false };
    let mut script = Script(data);
    while !script.is_empty() {
        step(&mut board, &mut script, &mut now);
        check(&board.engine);
    }
    settle(&mut board, &mut now);
    let (start, end) = (now, now.saturating_add(QUIET));
    let mut wakes = 0;
    while let Some(deadline) = board.engine.poll_at().filter(|deadline| *deadline <= end) {
        wakes += 1;
        if wakes >= WAKES {
            assert!(
                periods(&board.engine, now.saturating_duration_since(start)) >= WAKES / 8,
                "it is woken for nothing"
            );
            break;
        }
        now = now.max(deadline);
        settle(&mut board, &mut now);
    }
    now = now.max(end);
    settle(&mut board, &mut now);
    // the configuration may have given the bridge another unit
    let answers = [247].into_iter().chain(1..=254).any(|unit| asks(&mut board, unit, &mut now));
    assert!(answers, "the bridge is lost to its host");
});

/// A firmware's memory between two turns of its main loop.
struct Board {
    engine: Engine,
    /// The CAN port is to give up its frames.
    aborting: bool,
    /// The settings are to be stored.
    storing: bool,
}

impl Board {
    fn poll(&mut self, now: Instant) {
        while let Some(action) = self.engine.poll(now) {
            match action {
                Action::AbortCan(CAN) => self.aborting = true,
                Action::Store => self.storing = true,
                Action::Configure(port) => assert!(self.engine.port(port).is_some(), "{port:?}"),
                Action::RestartCan(port) | Action::AbortCan(port) => assert_eq!(port, CAN),
                Action::Outputs | Action::Reboot => {}
            }
        }
    }
}

/// Periods of all polling slots in a span: each is a reason to be woken, and so is what its read waits for.
fn periods(engine: &Engine, span: Duration) -> usize {
    let slots =
        (0..registers::SLOTS).filter_map(|index| engine.slot(index)).filter(|slot| slot.period_100us > 0);
    slots.map(|slot| (span.as_micros() / (u64::from(slot.period_100us) * 100)) as usize).sum()
}

/// One thing that a board may tell its engine.
fn step(board: &mut Board, script: &mut Script<'_>, now: &mut Instant) {
    let [op, argument] = script.array();
    let port = Port::new(op >> 4 & 3);
    let engine = &mut board.engine;
    match op & 0x0F {
        0 => engine.receive(port, script.slice(argument.into()), *now),
        // a frame with a right checksum
        1 | 2 => {
            let frame = sealed(script.slice(argument.into()));
            engine.receive(if op & 0x0F == 1 { Port::HOST } else { port }, &frame, *now);
        }
        3 => {
            let id = u32::from_be_bytes(script.array());
            let data = script.array();
            let id = match op & 0x40 {
                0 => Id::Extended(id & 0x1FFF_FFFF),
                _ => Id::Standard((id & 0x7FF) as u16),
            };
            if let Ok(frame) = Frame::from_parts(id, op & 0x80 != 0, argument & 0x0F, data) {
                engine.receive_frame(CAN, &frame, *now);
            }
        }
        4 => engine.advance(port, argument.into()),
        5 => engine.transmit_complete(port, *now),
        6 => {
            if engine.next_frame(CAN).is_some() && argument & 1 == 0 {
                engine.frame_sent(CAN, *now);
            }
        }
        7 => engine.frames_aborted(CAN, *now),
        8 => *now = now.saturating_add(Duration::from_micros(argument.into())),
        9 => {
            *now = now.saturating_add(Duration::from_millis(argument.into()));
            board.poll(*now);
        }
        10 => {
            // as a board does: it sleeps until the deadline
            *now = engine.poll_at().unwrap_or(*now).max(*now);
            board.poll(*now);
        }
        11 => drop(settle(board, now)),
        12 => engine.set_bus_off(CAN, argument & 1 != 0, *now),
        13 => match argument & 3 {
            0 => engine.overrun(port),
            1 => engine.receive_error(port),
            2 => engine.transmit_error(CAN),
            _ => engine.frame_sent(CAN, *now),
        },
        14 => {
            let value = u16::from(argument) << 4;
            engine.units_mut().1.set_inputs(script.word(), [value; 4]);
        }
        _ => {
            if std::mem::take(&mut board.storing) {
                let mut stored = [0; STORED_LENGTH];
                engine.encode_settings(&mut stored);
                assert!(Settings::decode(&stored, BOARD).is_some(), "what is stored can be restored");
                engine.saved(argument & 1 != 0);
            }
            let _ = engine.counters(port);
            let _ = (engine.slot(argument.into()), engine.port(port), engine.legacy_codes(), engine.health());
        }
    }
}

/// What holds after every step.
fn check(engine: &Engine) {
    assert!(engine.output(Port::HOST).len() <= 7 * 256);
    for port in [RS485_A, RS485_B] {
        assert!(engine.output(port).len() <= 256);
    }
    assert!(engine.output(CAN).is_empty());
    assert!(engine.units().1.digital_outputs() <= 0xFF);
    for channel in &engine.units().0.settings().channels {
        assert!(channel.range.contains(channel.set_value));
    }
}

/// The ports take everything, and nobody answers. What went to the host.
fn settle(board: &mut Board, now: &mut Instant) -> Vec<u8> {
    let mut host = Vec::new();
    loop {
        board.poll(*now);
        let engine = &mut board.engine;
        let mut moved = false;
        for port in [Port::HOST, RS485_A, RS485_B] {
            let pending = engine.output(port).to_vec();
            if pending.is_empty() {
                continue;
            }
            moved = true;
            engine.advance(port, pending.len());
            *now = now.saturating_add(Duration::from_micros(50 * pending.len() as u64));
            match port {
                Port::HOST => host.extend_from_slice(&pending),
                _ => engine.transmit_complete(port, *now),
            }
        }
        if std::mem::take(&mut board.aborting) {
            engine.frames_aborted(CAN, *now);
            moved = true;
        }
        while engine.next_frame(CAN).is_some() {
            *now = now.saturating_add(Duration::from_micros(130));
            engine.frame_sent(CAN, *now);
            moved = true;
        }
        check(engine);
        if !moved {
            return host;
        }
    }
}

/// Whether `unit` answers as the bridge itself.
fn asks(board: &mut Board, unit: u8, now: &mut Instant) -> bool {
    board.engine.receive(Port::HOST, &sealed(&[unit, 4, 0, 0, 0, 1]), *now);
    let answer = settle(board, now);
    *now = now.saturating_add(QUIET);
    settle(board, now);
    let [high, low] = registers::MAP.to_be_bytes();
    answer == sealed(&[unit, 4, 2, high, low])
}
