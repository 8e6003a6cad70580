//! The whole bridge: any bytes and frames on all its ports, at any pace, with ports that take their time. It never
//! holds more than it has room for, never asks to be woken for nothing, and when everything is quiet again its own
//! unit answers.
#![no_main]

use jointbus_fuzz::{Script, sealed};
use jointbus_mcu_bridge::engine::config::Port;
use jointbus_mcu_bridge::engine::{
    Engine, Identity, MAP_VERSION, ResetCause, SLOTS, STORED_LENGTH, Settings,
};
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
    let mut engine = Engine::new(identity, now);
    let mut script = Script(data);
    while !script.is_empty() {
        step(&mut engine, &mut script, &mut now);
        check(&engine);
    }
    settle(&mut engine, &mut now);
    let (start, end) = (now, now.saturating_add(QUIET));
    let mut wakes = 0;
    while let Some(deadline) = engine.poll_at().filter(|deadline| *deadline <= end) {
        wakes += 1;
        if wakes >= WAKES {
            assert!(
                periods(&engine, now.saturating_duration_since(start)) >= WAKES / 8,
                "it is woken for nothing"
            );
            break;
        }
        now = now.max(deadline);
        engine.poll(now);
        settle(&mut engine, &mut now);
    }
    now = now.max(end);
    engine.poll(now);
    settle(&mut engine, &mut now);
    // the configuration may have given the bridge another unit
    let answers = [247].into_iter().chain(1..=254).any(|unit| asks(&mut engine, unit, &mut now));
    assert!(answers, "the bridge is lost to its host");
});

/// Periods of all polling slots in a span: each is a reason to be woken, and so is what its read waits for.
fn periods(engine: &Engine, span: Duration) -> usize {
    let slots = (0..SLOTS).filter_map(|index| engine.slot(index)).filter(|slot| slot.period_100us > 0);
    slots.map(|slot| (span.as_micros() / (u64::from(slot.period_100us) * 100)) as usize).sum()
}

/// One thing that a board may tell its engine.
fn step(engine: &mut Engine, script: &mut Script<'_>, now: &mut Instant) {
    let [op, argument] = script.array();
    let port = Port::ALL[usize::from(op >> 4 & 3)];
    match op & 0x0F {
        0 => engine.receive(port, script.slice(argument.into()), *now),
        // a frame with a right checksum
        1 | 2 => {
            let frame = sealed(script.slice(argument.into()));
            engine.receive(if op & 0x0F == 1 { Port::Host } else { port }, &frame, *now);
        }
        3 => {
            let id = u32::from_be_bytes(script.array());
            let data = script.array();
            let id = match op & 0x40 {
                0 => Id::Extended(id & 0x1FFF_FFFF),
                _ => Id::Standard((id & 0x7FF) as u16),
            };
            if let Ok(frame) = Frame::from_parts(id, op & 0x80 != 0, argument & 0x0F, data) {
                engine.receive_frame(&frame, *now);
            }
        }
        4 => engine.advance(port, argument.into()),
        5 => engine.transmit_complete(port, *now),
        6 => {
            if engine.next_frame().is_some() && argument & 1 == 0 {
                engine.frame_sent(*now);
            }
        }
        7 => engine.frames_aborted(*now),
        8 => *now = now.saturating_add(Duration::from_micros(argument.into())),
        9 => {
            *now = now.saturating_add(Duration::from_millis(argument.into()));
            engine.poll(*now);
        }
        10 => {
            // as a board does: it sleeps until the deadline
            *now = engine.poll_at().unwrap_or(*now).max(*now);
            engine.poll(*now);
        }
        11 => drop(settle(engine, now)),
        12 => engine.set_bus_off(argument & 1 != 0, *now),
        13 => match argument & 3 {
            0 => engine.overrun(port),
            1 => engine.receive_error(port),
            2 => engine.transmit_error(),
            _ => engine.frame_sent(*now),
        },
        14 => {
            let value = u16::from(argument) << 4;
            engine.set_inputs(script.word(), [value; 4]);
        }
        _ => {
            let (wants_save, mut settings) = (engine.wants_save(), [0; STORED_LENGTH]);
            let taken = engine.take_save(&mut settings);
            assert_eq!(wants_save, taken);
            if taken {
                assert!(Settings::decode(&settings).is_some(), "what is stored can be restored");
                engine.saved(argument & 1 != 0);
            }
            let has_port_change = engine.has_port_change();
            let changes = Port::ALL.map(|port| engine.take_port_change(port).is_some());
            assert_eq!(has_port_change, changes.contains(&true));
            let _ = (engine.take_command(), engine.counters(port));
            let _ = (engine.slot(argument.into()), engine.port(port), engine.legacy_codes(), engine.health());
        }
    }
}

/// What holds after every step.
fn check(engine: &Engine) {
    assert!(engine.output(Port::Host).len() <= 5 * 256);
    for port in [Port::Rs485A, Port::Rs485B] {
        assert!(engine.output(port).len() <= 256);
    }
    assert!(engine.output(Port::Can).is_empty());
    assert!(engine.digital_outputs() <= 0xFF);
    for channel in &engine.analog_outputs().channels {
        assert!(channel.range.contains(channel.set_value));
    }
}

/// The ports take everything, and nobody answers. What went to the host.
fn settle(engine: &mut Engine, now: &mut Instant) -> Vec<u8> {
    let mut host = Vec::new();
    loop {
        let mut moved = false;
        for port in [Port::Host, Port::Rs485A, Port::Rs485B] {
            let pending = engine.output(port).to_vec();
            if pending.is_empty() {
                continue;
            }
            moved = true;
            engine.advance(port, pending.len());
            *now = now.saturating_add(Duration::from_micros(50 * pending.len() as u64));
            match port {
                Port::Host => host.extend_from_slice(&pending),
                _ => engine.transmit_complete(port, *now),
            }
        }
        moved |= engine.take_can_restart(*now);
        if engine.wants_abort() {
            engine.frames_aborted(*now);
            moved = true;
        }
        while engine.next_frame().is_some() {
            *now = now.saturating_add(Duration::from_micros(130));
            engine.frame_sent(*now);
            moved = true;
        }
        check(engine);
        if !moved {
            return host;
        }
    }
}

/// Whether `unit` answers as the bridge itself.
fn asks(engine: &mut Engine, unit: u8, now: &mut Instant) -> bool {
    engine.receive(Port::Host, &sealed(&[unit, 4, 0, 0, 0, 1]), *now);
    let answer = settle(engine, now);
    *now = now.saturating_add(QUIET);
    engine.poll(*now);
    settle(engine, now);
    let [high, low] = MAP_VERSION.to_be_bytes();
    answer == sealed(&[unit, 4, 2, high, low])
}
