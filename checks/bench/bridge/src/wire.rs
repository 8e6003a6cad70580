//! What the bridge adds to the times on the wire, in virtual time with exact wire timing.
//!
//! Its arguments are the times from an interrupt until the main loop has done what it brought, in ns: what the image takes
//! from a request's last byte to its frame, and from a reply's last frame to its first byte. It prints a line for each figure: subject, what, number, with tabs.

use std::env;

use anyhow::{Context, Result, ensure};
use jointbus_host_tests::sim::can_bits::{INTERMISSION, length};
use jointbus_host_tests::sim::{
    Delay, MICROS, MILLIS, Moment, Nanos, Notice, SECONDS, Settings, SimBoard, World,
};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::CAN;
use jointbus_protocol::can::Frame;
use jointbus_protocol::checksum::crc16;
use jointbus_protocol::modbus::{self, AddressRange, rtu};

/// What the figures are of.
const SUBJECT: &str = "bridge";

/// Delays of the sensor, from the end of a request to the first bit of the reply, in us: one that fits the main loop's
/// tick well tells little.
const DEVICES: [Nanos; 8] = [0, 50, 75, 100, 110, 125, 150, 190];

/// A read of the six axes of unit 1, on CAN, without its CRC.
const READ: [u8; 5] = [1, 0x03, 0x02, 0x00, 0x12];
const REPLY_LENGTH: usize = 1 + 2 + 18 + 2;

/// Reads that are measured.
const READS: usize = 1000;

/// The bridge's own unit and its register of the first polling slot.
const BRIDGE: u8 = 247;
const FIRST_SLOT: u16 = 0x50;

fn main() -> Result<()> {
    let argument =
        |index| env::args().nth(index).context("arguments: latency of a request and of a reply in ns");
    let (request, reply): (Nanos, Nanos) = (argument(1)?.parse()?, argument(2)?.parse()?);
    let latency = request.max(reply);
    // the first one is ready at once, which leaves the most to the bridge
    let (_, rate) = transparent(latency, 0)?;
    let mut added = 0;
    let mut shares = Vec::new();
    for device in DEVICES.map(|micros| micros * MICROS) {
        // the world has one latency: each way has a world in which it is right
        let (asking, _) = transparent(request, device)?;
        let (answering, _) = transparent(reply, device)?;
        added = added.max(asking.to_bus + answering.to_host);
        let (reads, limit) = slots(latency, device)?;
        shares.push((100.0 * reads / limit, reads, limit, device));
    }
    shares.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (share, reads, limit, device) = shares[0];
    show("delay added to a read, us", added as f64 / 1000.0);
    show("transparent reads a second", rate);
    show("slot reads a second", reads);
    show("slot reads a second, limit of the bus", limit);
    show("slot reads, sensor's delay, us", device as f64 / 1000.0);
    show("slot reads, share of the limit, %", share);
    Ok(())
}

fn show(what: &str, figure: f64) {
    println!("{SUBJECT}\t{what}\t{figure:.1}");
}

fn settings(latency: Nanos, device: Nanos) -> Settings {
    let mut settings = Settings::new(SimBoard::STM32F405, 1);
    settings.latency = Delay::Fixed(latency);
    settings.node_delay = Delay::Fixed(device);
    settings
}

/// Times that the bridge adds to a read.
#[derive(Debug, Clone, Copy, Default)]
struct Added {
    /// From the host's last byte to the request's first bit on CAN.
    to_bus: Nanos,
    /// From the reply's last frame to its first byte to the host.
    to_host: Nanos,
}

/// Reads one behind the other: the times that the bridge adds at most, and reads a second.
fn transparent(latency: Nanos, device: Nanos) -> Result<(Added, f64)> {
    let settings = settings(latency, device);
    let baud = u64::from(settings.network.ports[Port::HOST.index()].baud());
    let byte = 10 * SECONDS / baud;
    let mut queues = settings.board.queues();
    let mut world = World::new(settings, &mut queues);
    let (start, mut worst) = (world.now(), Added::default());
    for _ in 0..READS {
        let Added { to_bus, to_host } = read(&mut world, byte)?;
        worst = Added { to_bus: worst.to_bus.max(to_bus), to_host: worst.to_host.max(to_host) };
    }
    let span = world.now().saturating_duration_since(start) as f64 / SECONDS as f64;
    Ok((worst, READS as f64 / span))
}

/// One read.
fn read(world: &mut World<'_>, byte: Nanos) -> Result<Added> {
    let asked = world.host_sends(&[&READ[..], &crc16(&READ).to_le_bytes()].concat());
    let end = world.now().saturating_add(20 * MILLIS);
    let (mut sent, mut heard, mut first, mut bytes) = (None, None, None::<Moment>, 0);
    while bytes < REPLY_LENGTH {
        match world.next(end).context("no reply")? {
            Notice::CanFrame { start, .. } => sent = Some(start),
            Notice::BridgeHears { .. } => heard = Some(world.now()),
            Notice::HostHears(_) => {
                first.get_or_insert(world.now());
                bytes += 1;
            }
            _ => {}
        }
    }
    let (sent, heard, first) = (sent.context("no request")?, heard.context("no frame")?, first.context("?")?);
    Ok(Added {
        to_bus: sent.saturating_duration_since(asked),
        to_host: first.saturating_duration_since(heard) - byte,
    })
}

/// All slots as often as they can: reads a second, and what the bus could carry of them.
fn slots(latency: Nanos, device: Nanos) -> Result<(f64, f64)> {
    const SLOTS: u8 = 8;
    let settings = settings(latency, device);
    let rate = u64::from(settings.network.ports[CAN.index()].rate) * 1000;
    let nodes = settings.nodes;
    let mut queues = settings.board.queues();
    let mut world = World::new(settings, &mut queues);
    // unit and period in 100 us of each
    let data: Vec<u8> = (0..SLOTS).flat_map(|slot| [0, 1 + slot % nodes, 0, 1]).collect();
    let range = AddressRange::new(FIRST_SLOT, 2 * u16::from(SLOTS));
    let request = modbus::Request::WriteMultipleRegisters { range, data: &data };
    let mut buffer = [0; rtu::FRAME_MAX];
    let frame = rtu::encode_request(BRIDGE, &request, &mut buffer).ok().context("a request that fits")?;
    let settled = world.host_sends(frame).saturating_add(10 * MILLIS);
    while world.next(settled).is_some() {}
    let sequence = |world: &World<'_>| -> u64 {
        (0..SLOTS)
            .filter_map(|slot| world.engine().slot(slot.into()))
            .map(|slot| u64::from(slot.sequence))
            .sum()
    };
    let (before, end) = (sequence(&world), settled.saturating_add(SECONDS));
    let (mut bits, mut requests) = (0, 0);
    let mut carry = |frame: &Frame| bits += length(frame).whole + INTERMISSION;
    while let Some(notice) = world.next(end) {
        match notice {
            Notice::CanFrame { frame, .. } => {
                carry(&frame);
                requests += 1;
            }
            Notice::BridgeHears { frame, .. } => carry(&frame),
            _ => {}
        }
    }
    let reads = sequence(&world) - before;
    ensure!(reads > 0 && requests > 0, "the slots were not read");
    let one = bits * SECONDS / rate / requests + device;
    Ok((reads as f64, SECONDS as f64 / one as f64))
}
