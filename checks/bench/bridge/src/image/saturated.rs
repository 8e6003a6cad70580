//! The work of the processor in a second in which no port rests.
//!
//! Reads fill each bus, by the host, one behind the other and answered at once. Bytes of longer frames fill the rest of the
//! host's line, both ways. Each byte and each frame is counted as if it came alone, but for the part of a turn of the main
//! loop that is the same when nothing has come: that is counted once a tick, because what comes during a turn shares
//! the next one.

use anyhow::{Context, Result};
use jointbus_host_tests::sim::can_bits::{INTERMISSION, length};
use jointbus_mcu_bridge::board::{Port, PortConfig};
use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, RS485_A, RS485_B};
use jointbus_protocol::nst::can;

use crate::SUBJECT;
use crate::trace::{CAN_RECEIVED, Counts, Load, Way};

/// Ticks in a second.
const TICKS: f64 = 10_000.0;

/// Bytes of a read of the six axes, and of its reply.
const REQUEST: f64 = 7.0;
const REPLY: f64 = 23.0;

/// Instructions and interrupts.
#[derive(Debug, Clone, Copy, Default)]
struct Cost {
    instructions: f64,
    interrupts: f64,
}

impl Cost {
    fn times(self, count: f64) -> Self {
        Self { instructions: self.instructions * count, interrupts: self.interrupts * count }
    }

    fn plus(self, other: Self) -> Self {
        Self {
            instructions: self.instructions + other.instructions,
            interrupts: self.interrupts + other.interrupts,
        }
    }
}

/// Prints what a read and a byte cost, and a second of all ports at once.
pub(crate) fn show(counts: &Counts) -> Result<()> {
    let quiet = counts.loads.values().flat_map(|load| &load.turns).min().copied();
    let costs = Costs { counts, quiet: quiet.context("no interrupt woke the main loop")? };
    // of a read's request, and of any other byte
    let (asked, byte_in) = (costs.mean("USART1", Way::In)?, costs.inside("USART1", Way::In)?);
    // the emulator's host port takes a whole reply at once; an RS485 port has the same code and takes its time
    let byte_out = costs.inside("USART2", Way::Out)?;
    let host = asked.times(REQUEST).plus(byte_out.times(REPLY));
    let frames = costs.mean("CAN1_TX", Way::Out)?.plus(costs.mean(CAN_RECEIVED, Way::In)?.times(3.0));
    let bytes = costs.mean("USART2", Way::Out)?.times(REQUEST);
    let bytes = bytes.plus(costs.mean("USART2", Way::In)?.times(REPLY));
    let (by_can, by_rs485) = (host.plus(frames), host.plus(bytes));
    let tick = Cost { instructions: average(&counts.tick)? + average(&counts.idle_turn)?, interrupts: 1.0 };

    let on_can = reads_on_can()?;
    let on_rs485 = (bytes_a_second(RS485_A)? + bytes_a_second(RS485_B)?) / (REQUEST + REPLY);
    let line = bytes_a_second(Port::HOST)?;
    let all = [
        by_can.times(on_can),
        by_rs485.times(on_rs485),
        byte_in.times(line - REQUEST * (on_can + on_rs485)),
        byte_out.times(line - REPLY * (on_can + on_rs485)),
        tick.times(TICKS),
    ];
    let all = all.into_iter().fold(Cost::default(), Cost::plus);
    for (what, figure) in [
        ("turn with nothing to do", costs.quiet as f64),
        ("a byte from the host", byte_in.instructions),
        ("a byte to the host", byte_out.instructions),
        ("a read by CAN", by_can.instructions),
        ("a read by RS485", by_rs485.instructions),
        ("saturated, instructions a second", all.instructions),
        ("saturated, interrupts a second", all.interrupts),
    ] {
        println!("{SUBJECT}\t{what}\t{figure:.1}");
    }
    Ok(())
}

struct Costs<'a> {
    counts: &'a Counts,
    /// Instructions of a turn with nothing to do.
    quiet: u64,
}

impl Costs<'_> {
    fn load(&self, interrupt: &str, way: Way) -> Result<(&Load, Cost)> {
        let load = self.counts.loads.get(&(interrupt.to_owned(), way));
        let load =
            load.filter(|load| load.moved > 0).with_context(|| format!("{interrupt} moved nothing"))?;
        let moved = load.moved as f64;
        let cost = Cost {
            instructions: load.instructions as f64 / moved,
            interrupts: load.interrupts as f64 / moved,
        };
        Ok((load, cost))
    }

    /// Of a byte or frame, with its share of what a whole request or reply takes.
    fn mean(&self, interrupt: &str, way: Way) -> Result<Cost> {
        let (load, cost) = self.load(interrupt, way)?;
        let turns = load.turns.iter().map(|turn| turn - self.quiet).sum::<u64>();
        Ok(cost.plus(Cost { instructions: turns as f64 / load.moved as f64, interrupts: 0.0 }))
    }

    /// Of a byte inside a frame, with which nothing begins and nothing ends: the cheapest.
    fn inside(&self, interrupt: &str, way: Way) -> Result<Cost> {
        let (load, cost) = self.load(interrupt, way)?;
        let turn = load.turns.iter().min().with_context(|| format!("{interrupt} woke nobody"))?;
        Ok(cost.plus(Cost { instructions: (turn - self.quiet) as f64, interrupts: 0.0 }))
    }
}

fn average(counts: &[u64]) -> Result<f64> {
    let sum = counts.iter().sum::<u64>();
    (!counts.is_empty()).then(|| sum as f64 / counts.len() as f64).context("no tick was counted")
}

fn config(port: Port) -> Result<&'static PortConfig> {
    BOARD.port(port).map(|port| &port.default).context("the board has another port")
}

/// Bytes in a second at the rate that the board starts with.
fn bytes_a_second(port: Port) -> Result<f64> {
    /// Start bit, eight bits, stop bit.
    const BITS: f64 = 10.0;
    Ok(f64::from(config(port)?.baud()) / BITS)
}

/// Reads in a second: a frame there, three back.
fn reads_on_can() -> Result<f64> {
    let bits = |body: &[u8]| -> Result<u64> {
        let frames = can::segment(1, 127, body).ok().context("a transfer")?;
        Ok(frames.map(|frame| length(&frame).whole + INTERMISSION).sum())
    };
    let bits = bits(&[0x55; REQUEST as usize - 3])? + bits(&[0x55; REPLY as usize - 3])?;
    Ok(f64::from(config(CAN)?.rate) * 1000.0 / bits as f64)
}
