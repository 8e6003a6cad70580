//! The host: what it has asked, what it got, and whether that belongs together.

mod wires;

use super::boards::SimBoard;
use super::moment::{MILLIS, Moment, Nanos};
use super::question::{Fit, Question};
use super::routes::{is_nst, port_of, speaks_modbus, speaks_nst, unit_at};
use super::settings::Settings;
use super::station::{SerialDevice, device_number};
use super::tally::Tally;
use super::world::World;
use jointbus::devices::Order;
use jointbus_mcu_bridge::board::{Port, Route, Topology};
use jointbus_protocol::checksum;
use jointbus_protocol::time::Instant;
use std::collections::HashMap;

/// The main loop takes notice of a time limit so much later at most: a tick and its latency.
const NOTICED: Nanos = MILLIS / 4;

/// Answers wait for the host's line so long at most: for the others that the bridge keeps room for.
const BACKLOG: Nanos = 20 * MILLIS;

/// A request without an answer so far.
#[derive(Debug, Clone)]
struct Asked {
    question: Question,
    /// Function code onward.
    body: Vec<u8>,
    /// When the bridge had it.
    at: Moment,
    /// When it is too late to send it.
    expires: Moment,
    /// When it is too late for an answer.
    over: Moment,
    /// Times that the bridge has sent it.
    sent: u8,
    /// When the bridge has sent another request to the same unit after it: then it is no longer in flight.
    superseded: Option<Moment>,
    /// A later request to the same unit has been answered.
    overtaken: bool,
}

/// A write on its way, or done.
#[derive(Debug, Clone, Copy, Default)]
struct Written {
    /// Devices that carried it out, a bit each.
    by: u128,
    broadcast: bool,
}

/// A broadcast on its way: function code onward, when it is too late to send it, and the buses that still have to.
#[derive(Debug)]
struct Broadcast {
    body: Vec<u8>,
    expires: Moment,
    to: Vec<Port>,
}

/// Requests to one unit.
#[derive(Debug, Default)]
struct Unit {
    open: Vec<Asked>,
    /// Exceptions that name nothing but the function code: how many of each that still stand for an open request.
    exceptions: HashMap<u8, usize>,
    /// Answers right by coincidence, which leave a request of Modbus without an answer.
    coincidences: usize,
    /// When the newest answer was measured.
    measured: Instant,

    /// Commands that were asked and not carried out yet, by function code.
    commands: HashMap<u8, u64>,
}

/// The host.
#[derive(Debug)]
pub struct Master {
    board: SimBoard,
    network: Topology,
    units: Vec<Unit>,
    written: HashMap<u32, Written>,
    broadcasts: Vec<Broadcast>,
    /// The first frame of the broadcast that is on its way on a CAN bus.
    broadcast_heads: HashMap<Port, Vec<u8>>,
    incoming: Vec<u8>,
    /// When something on that port was garbled last.
    garbled: HashMap<Port, Moment>,
    /// Health bits that the bridge told of itself, all together.
    pub health: u8,
    /// Polling slots read samples as well.
    pub polls: bool,
    /// What was counted.
    pub tally: Tally,
    /// Requests that may still be answered.
    pub open: usize,
}

impl Master {
    /// A host of a bridge with these routes.
    #[must_use]
    pub fn new(settings: &Settings) -> Self {
        Self {
            board: settings.board,
            network: settings.network,
            units: (0..=u8::MAX).map(|_| Unit::default()).collect(),
            written: HashMap::new(),
            broadcasts: Vec::new(),
            broadcast_heads: HashMap::new(),
            incoming: Vec::new(),
            garbled: HashMap::new(),
            health: 0,
            polls: false,
            tally: Tally::default(),
            open: 0,
        }
    }

    /// Notes a request whose last byte reaches the bridge at `at`.
    ///
    /// # Panics
    /// Where no route serves the unit.
    pub fn ask(&mut self, unit: u8, question: Question, at: Moment) {
        let Some((_, route)) = self.network.route(unit) else { panic!("no route to unit {unit}") };
        let frame = question.frame(unit);
        let expires = at.saturating_add(u64::from(route.time_to_live_ms) * MILLIS + NOTICED);
        let asked = Asked {
            question,
            body: frame[1..frame.len() - checksum::CRC_LENGTH].to_vec(),
            at,
            expires,
            over: expires.saturating_add(answer_time(&question, route)),
            sent: 0,
            superseded: None,
            overtaken: false,
        };
        if let Some(token) = question.token() {
            self.written.insert(token, Written::default());
        }
        let place = &mut self.units[usize::from(unit)];
        if matches!(question, Question::Command { .. }) {
            *place.commands.entry(frame[1]).or_default() += 1;
        }
        place.open.push(asked);
        self.open += 1;
        self.tally.asked += 1;
    }

    /// Notes a broadcast of a number that is used once, which the bridge has at `at` and sends on each bus that speaks
    /// its protocol.
    pub fn broadcast(&mut self, question: &Question, at: Moment) {
        if let Some(token) = question.token() {
            self.written.insert(token, Written { by: 0, broadcast: true });
        }
        let nst = matches!(question, Question::Write { .. });
        let speaks = if nst { speaks_nst } else { speaks_modbus };
        let to: Vec<Port> =
            self.board.description.ports().filter(|port| speaks(&self.network, *port)).collect();
        let row = self.network.routes.iter().find(|row| {
            row.is_used()
                && row.protocol.is_nst() == nst
                && row.target.port().is_some_and(|port| to.contains(&port))
        });
        let expires =
            at.saturating_add(row.map_or(0, |row| u64::from(row.time_to_live_ms)) * MILLIS + NOTICED);
        let frame = question.frame(0);
        let body = frame[1..frame.len() - checksum::CRC_LENGTH].to_vec();
        self.broadcasts.retain(|before| at.saturating_duration_since(before.expires) < 1000 * MILLIS);
        self.tally.copies[0] += to.len() as u64;
        self.broadcasts.push(Broadcast { body, expires, to });
    }

    /// Whether the same question to the same unit may still be answered: then it could not be told whose an answer is.
    #[must_use]
    pub fn is_open(&self, unit: u8, question: &Question) -> bool {
        self.units[usize::from(unit)].open.iter().any(|asked| asked.question == *question)
    }

    /// When it is too late for an answer to the newest request of a unit; `None` where there is none open.
    #[must_use]
    pub fn patience(&self, unit: u8) -> Option<Moment> {
        self.units[usize::from(unit)]
            .open
            .iter()
            .filter(|asked| !asked.overtaken)
            .map(|asked| asked.over)
            .max()
    }

    /// Takes a byte from the bridge; the unit whose answer that completes.
    pub fn hear(&mut self, byte: u8, world: &World<'_>) -> Option<u8> {
        self.incoming.push(byte);
        let unit = self.incoming[0];
        let nst = is_nst(&self.network, unit);
        let length = reply_length(&self.incoming, nst)?;
        if self.incoming.len() < length {
            return None;
        }
        let frame = std::mem::take(&mut self.incoming);
        let now = world.now();
        match checksum::strip_crc(&frame) {
            Some(content) => self.answered(unit, &content[1..], world),
            None => self.tally.violation(now, || format!("the bridge sent a broken frame {frame:02x?}")),
        }
        Some(unit)
    }

    fn answered(&mut self, unit: u8, reply: &[u8], world: &World<'_>) {
        let now = world.now();
        if let [function, code] = *reply
            && function & 0x80 != 0
            && code != 2
        {
            return self.exception(unit, function & 0x7F, code, now);
        }
        let remote = self.network.route(unit).map_or(0, |(_, route)| route.remote_of(unit));
        let port = port_of(&self.network, unit);
        let number = port.map_or(0, |port| device_number(port, remote));
        let place = &mut self.units[usize::from(unit)];
        let measured = place.measured;
        let mut found = None;
        let mut why = String::new();
        for (index, asked) in place.open.iter().enumerate() {
            let fresh = |moment: Instant| moment >= asked.at.instant() && moment > measured;
            let done = |token| self.written.get(&token).is_some_and(|written| written.by != 0);
            match asked.question.fit(number, reply) {
                _ if asked.overtaken || now > asked.over => {}
                // a bus has one request in flight: the one that was sent last
                _ if asked.superseded.is_some_and(|at| now.saturating_duration_since(at) > BACKLOG) => {}
                Fit::Right if !asked.question.token().is_none_or(done) => {
                    why = ", which nobody carried out".to_owned();
                }
                Fit::Right => found = Some((index, None)),
                Fit::At(moment) if fresh(moment) => found = Some((index, Some(moment))),
                Fit::At(moment) => why = format!(", measured at {} us", moment.as_micros()),
                Fit::Inputs => {
                    let since = asked.at.instant();
                    let device = (port, remote);
                    let moment = told_inputs(world, device, &asked.question, reply, since, measured);
                    found = moment.map(|moment| (index, Some(moment)));
                }
                Fit::Wrong => {}
            }
            if found.is_some() {
                break;
            }
        }
        let Some((index, moment)) = found else {
            let garbled = port.and_then(|port| self.garbled.get(&port));
            let garbled = garbled.is_some_and(|at| now.saturating_duration_since(*at) < 1000 * MILLIS);
            // a device never says such a thing by itself
            if garbled && !is_genuine(world, (port, remote), reply) {
                self.tally.coincidences += 1;
                place.coincidences += 1;
            } else {
                let open: Vec<_> = place.open.iter().map(|asked| asked.question).collect();
                self.tally.violation(now, || {
                    format!("wrong answer from unit {unit}: {reply:02x?}{why}; open: {open:?}")
                });
            }
            return;
        };
        place.measured = moment.unwrap_or(measured);
        if let (Question::Health, [_, _, _, bits]) = (place.open.remove(index).question, reply) {
            self.health |= bits;
        }
        self.open -= 1;
        // requests of one unit keep their order: those before it got no answer
        place.open.iter_mut().take(index).for_each(|earlier| earlier.overtaken = true);
        settle(place, &mut self.open);
        self.tally.answered += 1;
    }

    fn exception(&mut self, unit: u8, function: u8, code: u8, now: Moment) {
        let place = &mut self.units[usize::from(unit)];
        let open = place.open.iter().filter(|asked| asked.body.first() == Some(&function)).count();
        let count = place.exceptions.entry(function).or_default();
        *count += 1;
        if *count > open {
            *count -= 1;
            self.tally.violation(now, || {
                format!("unit {unit}: exception {code:02x} to function {function:02x} that nobody asked")
            });
            return;
        }
        match code {
            0x06 | 0x0B => self.tally.refused += 1,
            _ => self.tally.answered += 1,
        }
        settle(place, &mut self.open);
    }

    /// Forgets what can no longer be answered.
    pub fn forget(&mut self, now: Moment) {
        for (unit, place) in (0..=u8::MAX).zip(&mut self.units) {
            if place.open.iter().all(|asked| now <= asked.over) {
                continue;
            }
            let nst = is_nst(&self.network, unit);
            let before = place.open.len();
            if nst {
                place.open.retain(|asked| now <= asked.over);
                self.tally.silent += (before - place.open.len()) as u64;
            } else {
                // Modbus is always answered
                let (tally, exceptions, coincidences) =
                    (&mut self.tally, &mut place.exceptions, &mut place.coincidences);
                place.open.retain(|asked| {
                    let keep = now <= asked.over;
                    let excused = exceptions.get_mut(&asked.body[0]).filter(|count| **count > 0);
                    if let Some(count) = excused.filter(|_| !keep) {
                        *count -= 1;
                    } else if !keep && *coincidences > 0 {
                        *coincidences -= 1;
                        tally.silent += 1;
                    } else if !keep {
                        tally.violation(now, || {
                            format!("unit {unit} left {:?} without an answer", asked.question)
                        });
                    }
                    keep
                });
            }
            self.open -= before - place.open.len();
        }
    }

    /// A device has carried out a write or a command.
    pub fn ordered(&mut self, port: Port, address: u8, order: &Order, now: Moment) {
        self.tally.executed += 1;
        if order.value == 0 {
            let unit = unit_at(&self.network, port, address).unwrap_or(0);
            let left = self.units[usize::from(unit)].commands.entry(order.function).or_default();
            if *left == 0 {
                self.tally.violation(now, || {
                    format!("unit {unit} carried out {order:x?}, which nobody asked, or twice")
                });
            }
            *left = left.saturating_sub(1);
            return;
        }
        let bit = 1u128 << (port.index() * 16 + usize::from(address % 16));
        match self.written.get_mut(&order.value) {
            None => self
                .tally
                .violation(now, || format!("{port:?}, device {address}: nobody asked for {order:x?}")),
            Some(written) => {
                let again = written.by & bit != 0 || (written.by != 0 && !written.broadcast);
                written.by |= bit;
                if again {
                    self.tally
                        .violation(now, || format!("{port:?}, device {address}: {order:x?} a second time"));
                }
            }
        }
    }

    /// Something on a line was not heard as it was sent.
    pub fn garbled(&mut self, port: Port, now: Moment) {
        self.garbled.insert(port, now);
    }
}

/// Open requests that exceptions account for are done, once there are as many.
fn settle(place: &mut Unit, open: &mut usize) {
    let before = place.open.len();
    for (function, count) in &mut place.exceptions {
        let of_it = |asked: &Asked| asked.body.first() == Some(function);
        if *count > 0 && place.open.iter().filter(|asked| of_it(asked)).count() <= *count {
            place.open.retain(|asked| !of_it(asked));
            *count = 0;
        }
    }
    *open -= before - place.open.len();
}

/// When a module told these inputs, if it did since the question and after the last answer.
fn told_inputs(
    world: &World<'_>,
    device: (Option<Port>, u8),
    question: &Question,
    reply: &[u8],
    since: Instant,
    measured: Instant,
) -> Option<Instant> {
    let (Some(port), remote) = device else { return None };
    let SerialDevice::Station(station) = &world.bus(port)?.devices.first()?.device else { return None };
    let values = reply.get(2..)?;
    let told = station.told().between(since, world.now().instant());
    let mut fitting = told.filter(|(at, inputs)| {
        let channels = inputs.analog.get(question.channels()).unwrap_or(&[]);
        let bytes = channels.iter().flat_map(|value| value.to_be_bytes());
        *at > measured && inputs.unit == remote && bytes.eq(values.iter().copied())
    });
    fitting.next().map(|(at, _)| *at)
}

/// Whether a reply is one that this device gives to some question of ours.
fn is_genuine(world: &World<'_>, (port, remote): (Option<Port>, u8), reply: &[u8]) -> bool {
    match reply {
        [0x04, _, data @ ..] => {
            let device = port.and_then(|port| world.bus(port)).and_then(|bus| bus.devices.first());
            let Some(SerialDevice::Station(station)) = device.map(|it| &it.device) else {
                return true;
            };
            let mut told = station.told().between(Instant::from_micros(0), world.now().instant());
            told.any(|(_, inputs)| {
                let values: Vec<u8> = inputs.analog.iter().flat_map(|value| value.to_be_bytes()).collect();
                inputs.unit == remote && values.windows(data.len().max(1)).any(|part| part == data)
            })
        }
        [0x03, count, data @ ..] => {
            let number = port.map_or(0, |port| device_number(port, remote));
            let sample = matches!(Question::Sample { length: *count }.fit(number, reply), Fit::At(_));
            let pattern = super::station::PATTERN.clone().any(|register| {
                let question = Question::Pattern { register, length: *count };
                question.fit(number, reply) == Fit::Right
            });
            sample || (pattern && data.len() >= 3)
        }
        // acknowledgements look all alike
        _ => true,
    }
}

/// The longest that an answer can take behind the time to live: attempts, time on the wire, replies before it.
fn answer_time(question: &Question, route: &Route) -> Nanos {
    const WIRE: Nanos = 300 * MILLIS;
    let (timeout, attempts) = match question.is_read() {
        true => (route.read_timeout_ms, u64::from(route.read_retries) + 1),
        false => (route.write_timeout_ms, 1),
    };
    let transfers = question.transfers(route);
    transfers * attempts * (u64::from(timeout) * MILLIS) + attempts * WIRE
}

/// Length of the bridge's frame that starts with `prefix`; `None` while it can't be told.
fn reply_length(prefix: &[u8], nst: bool) -> Option<usize> {
    let function = *prefix.get(1)?;
    Some(match (nst, function) {
        (true, 0x03 | 0x15) => 5 + usize::from(*prefix.get(2)?),
        (true, _) | (false, 0x80..) => 5,
        (false, 1..=4) => 5 + usize::from(*prefix.get(2)?),
        (false, _) => 8,
    })
}
