//! What each kind of fault may do to the bridge's counters and to its service.

use super::fault::Fault;
use super::world::TO_BUS_OFF;
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::engine::Counters;
use std::fmt::Write as _;

/// A counter that tells of something wrong; the others tell of traffic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Counter {
    /// Checksum, parity and framing errors.
    Checksum,
    /// Dropped bursts and transfers.
    Dropped,
    /// Attempts without an answer.
    Timeouts,
    /// Reads sent again.
    Retries,
    /// Frames that belong to nothing.
    Foreign,
    /// Bytes or frames without room.
    Overruns,
    /// Requests not sent in time.
    Expired,
    /// Requests refused.
    Refused,
    /// Times that the controller went bus-off.
    BusOff,
    /// Transmit errors and collisions.
    Transmit,
}

impl Counter {
    /// All of them.
    pub const ALL: [Self; 10] = [
        Self::Checksum,
        Self::Dropped,
        Self::Timeouts,
        Self::Retries,
        Self::Foreign,
        Self::Overruns,
        Self::Expired,
        Self::Refused,
        Self::BusOff,
        Self::Transmit,
    ];

    /// Its name in the bridge's register map.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Checksum => "checksum errors",
            Self::Dropped => "dropped bursts",
            Self::Timeouts => "timeouts",
            Self::Retries => "retries",
            Self::Foreign => "foreign or late",
            Self::Overruns => "overruns",
            Self::Expired => "expired",
            Self::Refused => "refused",
            Self::BusOff => "bus-off",
            Self::Transmit => "transmit errors or collisions",
        }
    }

    /// Its value.
    #[must_use]
    pub const fn of(self, counters: &Counters) -> u32 {
        match self {
            Self::Checksum => counters.checksum_errors,
            Self::Dropped => counters.dropped_bursts,
            Self::Timeouts => counters.timeouts,
            Self::Retries => counters.retries,
            Self::Foreign => counters.foreign_or_late,
            Self::Overruns => counters.overruns,
            Self::Expired => counters.expired,
            Self::Refused => counters.refused,
            Self::BusOff => counters.bus_off,
            Self::Transmit => counters.transmit_errors,
        }
    }
}

/// Whose counter: that of the bus where the fault is, or the host port's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum At {
    /// The port of the bus.
    Bus,
    /// The host port.
    Host,
}

/// How far a fault raises a counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Times {
    /// By so many.
    Exactly(u32),
    /// By one at least.
    Some,
    /// Not always.
    Maybe,
    /// Perhaps, where the port hears itself.
    Echo,
}

/// A counter that a fault raises, or several that it raises together.
#[derive(Debug, Clone, Copy)]
pub struct Raise(pub At, pub &'static [Counter], pub Times);

/// How much service a fault may cost. Whatever it is, the other buses and the bridge's own units go on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Service {
    /// None: every request is answered.
    Kept,
    /// One transaction fails at most. As its reply may still come, requests that it would fit too wait for the hold-off.
    One,
    /// The device that is late fails until its reply has come, and one transaction more; at most for the hold-off.
    Late,
    /// Transactions fail while it lasts, and one more; what is owed then waits for the hold-off, and a device in
    /// quarantine for its probe.
    Span,
}

impl Service {
    /// What it costs, in a few words.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Kept => "nothing",
            Self::One => "one transaction",
            Self::Late => "the late device, up to the hold-off",
            Self::Span => {
                "its span and one transaction; what is owed up to the hold-off, quarantine up to the probe"
            }
        }
    }
}

use At::{Bus, Host};
use Counter::{BusOff, Checksum, Dropped, Expired, Foreign, Overruns, Refused, Retries, Timeouts, Transmit};
use Times::{Echo, Exactly, Maybe};

/// An attempt has no answer, is repeated if it is a read, and requests wait in vain for what is owed.
const TIMED_OUT: Raise = Raise(Bus, &[Timeouts], Exactly(1));
const REPEATED: Raise = Raise(Bus, &[Retries], Maybe);
const WAITED: Raise = Raise(Bus, &[Expired], Maybe);

/// Attempts may have no answer.
const MAY_TIME_OUT: Raise = Raise(Bus, &[Timeouts], Maybe);

/// So many of them that a device comes to be quarantined.
const QUARANTINED: Raise = Raise(Host, &[Refused], Maybe);

/// What the port hears of its own frame is not what it sent.
const COLLIDED: Raise = Raise(Bus, &[Transmit], Echo);

/// Stop bits are missing, perhaps.
const UNFRAMED: Raise = Raise(Bus, &[Checksum], Maybe);

/// Bytes or a transfer that belong to nothing.
const FOREIGN: Raise = Raise(Bus, &[Foreign], Exactly(1));
const MAY_BE_FOREIGN: Raise = Raise(Bus, &[Foreign], Maybe);

/// A burst of the host's, dropped; one whose first byte is no known unit counts as refused.
const BURST: Raise = Raise(Host, &[Dropped, Refused], Exactly(1));
const BURST_KNOWN: Raise = Raise(Host, &[Dropped], Exactly(1));
const CRC: Raise = Raise(Host, &[Checksum], Exactly(1));
const MAYBE_CRC: Raise = Raise(Host, &[Checksum], Maybe);

impl Fault {
    /// The counters that this fault raises: its cause first, then the consequences. It raises no others.
    #[must_use]
    pub const fn raises(self) -> &'static [Raise] {
        match self {
            Self::RequestBits | Self::RequestByteLost | Self::DriverLate => {
                &[TIMED_OUT, REPEATED, WAITED, COLLIDED]
            }
            Self::RequestByteDoubled => &[MAY_TIME_OUT, REPEATED, WAITED, COLLIDED],
            Self::DriverHeld => &[UNFRAMED, MAY_BE_FOREIGN, MAY_TIME_OUT, REPEATED, WAITED],
            Self::ReplyBits
            | Self::ReplyByteLost
            | Self::ReplyCut
            | Self::ReplyOtherUnit
            | Self::ReplyOtherFunction => &[FOREIGN, TIMED_OUT, REPEATED, WAITED],
            // the byte that stands twice may be the last one, or the first
            Self::ReplyByteDoubled | Self::ReplyOtherLength => {
                &[MAY_BE_FOREIGN, MAY_TIME_OUT, REPEATED, WAITED]
            }
            Self::NoiseAfter | Self::ReplyTwice | Self::CanReplyTwice | Self::CanForeignTransfer => {
                &[FOREIGN]
            }
            // it may come into another frame, and destroy both
            Self::ReplyLate => {
                &[MAY_TIME_OUT, MAY_BE_FOREIGN, REPEATED, WAITED, QUARANTINED, COLLIDED, UNFRAMED]
            }
            Self::CanReplyLate => {
                &[MAY_TIME_OUT, Raise(Bus, &[Foreign], Times::Some), REPEATED, WAITED, QUARANTINED]
            }
            Self::WrongBaud => &[Raise(Bus, &[Checksum], Exactly(1)), FOREIGN, TIMED_OUT, REPEATED, WAITED],
            Self::Noise | Self::DeviceBabbles => &[
                Raise(Bus, &[Foreign], Times::Some),
                UNFRAMED,
                MAY_TIME_OUT,
                REPEATED,
                WAITED,
                QUARANTINED,
                COLLIDED,
            ],
            Self::LineCut => &[MAY_TIME_OUT, REPEATED, WAITED, QUARANTINED, COLLIDED, MAY_BE_FOREIGN],
            Self::LineBreak => {
                &[UNFRAMED, MAY_BE_FOREIGN, MAY_TIME_OUT, REPEATED, WAITED, QUARANTINED, COLLIDED]
            }
            Self::DeviceDead => &[MAY_TIME_OUT, REPEATED, WAITED, QUARANTINED],
            Self::CanBit => &[Raise(Bus, &[Checksum, Transmit], Exactly(1))],
            Self::CanBusOff => {
                &[Raise(Bus, &[Transmit], Exactly(TO_BUS_OFF as u32)), Raise(Bus, &[BusOff], Exactly(1))]
            }
            Self::CanNoAcknowledgement => {
                &[Raise(Bus, &[Transmit], Maybe), WAITED, MAY_TIME_OUT, REPEATED, QUARANTINED]
            }
            Self::CanDominant => &[
                Raise(Bus, &[Transmit], Maybe),
                Raise(Bus, &[BusOff], Maybe),
                WAITED,
                MAY_TIME_OUT,
                REPEATED,
                QUARANTINED,
            ],
            Self::CanFrameLost | Self::CanWrongDestination => {
                &[TIMED_OUT, Raise(Bus, &[Dropped], Maybe), REPEATED, WAITED]
            }
            Self::CanFrameDoubled => &[Raise(Bus, &[Dropped, Foreign], Exactly(1))],
            Self::CanFramesSwapped | Self::CanWrongCounter | Self::CanWrongType => {
                &[Raise(Bus, &[Dropped], Times::Some), TIMED_OUT, REPEATED, WAITED]
            }
            Self::CanForeignFrames => &[Raise(Bus, &[Dropped, Foreign, Overruns], Times::Some)],
            Self::CanLongCode => &[MAY_BE_FOREIGN, MAY_TIME_OUT, REPEATED, WAITED],
            Self::CanDeviceDead => {
                &[MAY_TIME_OUT, Raise(Bus, &[Dropped], Maybe), REPEATED, WAITED, QUARANTINED]
            }
            Self::NoiseBefore
            | Self::ReplyException
            | Self::CanForeignTraffic
            | Self::CanStandardFrames
            | Self::CanRemoteFrames
            | Self::CanQuirk
            | Self::HostShortPause
            | Self::HostGlued
            | Self::HostStrayBytes => &[],
            Self::HostGarbage | Self::HostBits | Self::HostStrayBroadcast => &[BURST, MAYBE_CRC],
            Self::HostCut | Self::HostUnknownFunction => &[BURST_KNOWN],
            // both ends of the request are a burst
            Self::HostLongPause => &[Raise(Host, &[Dropped, Refused], Exactly(2)), MAYBE_CRC],
            Self::HostOverlong => &[BURST_KNOWN, MAYBE_CRC],
            Self::HostWrongCrc | Self::HostHiddenCommand | Self::HostHiddenBehind => &[CRC, BURST_KNOWN],
            Self::HostFraming => &[Raise(Host, &[Checksum], Times::Some), BURST_KNOWN],
            Self::HostUnknownUnit => &[Raise(Host, &[Refused], Exactly(1))],
        }
    }

    /// The service that it costs.
    #[must_use]
    pub const fn service(self) -> Service {
        match self {
            Self::RequestBits
            | Self::RequestByteLost
            | Self::RequestByteDoubled
            | Self::DriverLate
            | Self::DriverHeld
            | Self::ReplyBits
            | Self::ReplyByteLost
            | Self::ReplyByteDoubled
            | Self::ReplyCut
            | Self::ReplyOtherUnit
            | Self::ReplyOtherFunction
            | Self::ReplyOtherLength
            | Self::WrongBaud
            | Self::CanFrameLost
            | Self::CanFramesSwapped
            | Self::CanWrongCounter
            | Self::CanWrongType
            | Self::CanWrongDestination
            | Self::CanLongCode => Service::One,
            Self::ReplyLate | Self::CanReplyLate => Service::Late,
            Self::Noise
            | Self::LineCut
            | Self::LineBreak
            | Self::DeviceDead
            | Self::DeviceBabbles
            | Self::CanNoAcknowledgement
            | Self::CanDominant
            | Self::CanDeviceDead => Service::Span,
            _ => Service::Kept,
        }
    }

    /// Health bits of the bridge that are set meanwhile: those that must be, and those that may.
    #[must_use]
    pub const fn health(self) -> [u8; 2] {
        const BUS_OFF: u8 = 1 << 2;
        match self {
            Self::CanBusOff => [BUS_OFF, BUS_OFF],
            Self::CanDominant => [0, BUS_OFF],
            _ => [0, 0],
        }
    }

    /// What is wrong with the counters of a bridge after this fault alone, on that bus or on the host's line.
    #[must_use]
    pub fn misjudged(self, bus: Port, echo: bool, counters: &[Counters]) -> Vec<String> {
        let port_of = |at: At| if at == Host { Port::HOST } else { bus };
        let value = |port: Port, counter: Counter| counter.of(&counters[port.index()]);
        let ports = (0..counters.len() as u8).map(Port::new);
        let mut wrong = Vec::new();
        for Raise(at, together, times) in self.raises() {
            let sum: u32 = together.iter().map(|counter| value(port_of(*at), *counter)).sum();
            let right = match times {
                Exactly(count) => sum == *count,
                Times::Some => sum > 0,
                Maybe => true,
                Echo => echo || sum == 0,
            };
            if !right {
                let names: Vec<_> = together.iter().map(|counter| counter.name()).collect();
                wrong.push(format!(
                    "{} {}: {sum}, not {}",
                    port_name(*at),
                    names.join(" and "),
                    told(*times)
                ));
            }
        }
        for (port, counter) in ports.flat_map(|port| Counter::ALL.map(|it| (port, it))) {
            let named = |Raise(at, together, _): &Raise| port_of(*at) == port && together.contains(&counter);
            if value(port, counter) > 0 && !self.raises().iter().any(named) {
                wrong.push(format!("{port:?} {}: {}, not 0", counter.name(), value(port, counter)));
            }
        }
        wrong
    }

    /// All kinds with what they raise and cost, as a table in Markdown.
    #[must_use]
    pub fn table() -> String {
        let mut table = String::from(TABLE_HEAD);
        for fault in Self::ALL {
            let raises: Vec<_> = fault
                .raises()
                .iter()
                .map(|Raise(at, together, times)| {
                    let names: Vec<_> = together.iter().map(|counter| counter.name()).collect();
                    format!("{} {}: {}", port_name(*at), names.join(" and "), told(*times))
                })
                .collect();
            let raises = if raises.is_empty() { "nothing".to_owned() } else { raises.join("; ") };
            // writing to a string does not fail
            let _ = writeln!(
                table,
                "| `{}` | {} | {raises} | {} |",
                fault.name(),
                fault.about(),
                fault.service().name()
            );
        }
        table
    }
}

const TABLE_HEAD: &str = "\
# Faults of the simulation

Each kind of fault, what it raises of the bridge's counters when it comes alone into clean traffic, and what service it
costs. It raises no other counter, on no other port: `cargo xtask soak` shows that and the service for thousands of seeds,
`cargo xtask sim --seed N --alone KIND` repeats one. Frames sent and received are compared one by one.
`can-bus-off` sets the health bit of that name while it lasts, `can-dominant` may, and no other does.
This page is printed by `cargo xtask sim --table`.

| fault | what happens | counters | service that it costs |
|---|---|---|---|
";

const fn port_name(at: At) -> &'static str {
    match at {
        Bus => "bus",
        Host => "host",
    }
}

fn told(times: Times) -> String {
    match times {
        Exactly(count) => count.to_string(),
        Times::Some => "1 or more".to_owned(),
        Maybe => "perhaps".to_owned(),
        Echo => "perhaps, if the port hears itself".to_owned(),
    }
}
