//! The newest values on the screen: redrawn in place on a terminal, else as lines.

use crate::poll::Readings;
use jointbus::bench::{CAN_UNIT, OUTPUTS_UNIT, RS485_A_UNIT, RS485_B_UNIT};
use jointbus::bridge;
use std::io::{IsTerminal, Write};
use std::time::Duration;

/// Time between two pictures on a terminal.
const REDRAW: Duration = Duration::from_millis(100);
/// Time between two pictures elsewhere.
const REPRINT: Duration = Duration::from_millis(1000);

/// Where the values are shown.
pub(crate) struct Screen {
    is_terminal: bool,
    /// Lines of the picture that stands there.
    lines: usize,
    next: Duration,
}

impl Screen {
    pub(crate) fn new() -> Self {
        Self { is_terminal: std::io::stdout().is_terminal(), lines: 0, next: Duration::ZERO }
    }

    /// Shows the values if it is time to.
    pub(crate) fn update(&mut self, now: Duration, readings: &Readings) {
        if now >= self.next {
            self.next = now + if self.is_terminal { REDRAW } else { REPRINT };
            self.draw(now, readings);
        }
    }

    /// Shows the values in any case.
    pub(crate) fn last(&mut self, now: Duration, readings: &Readings) {
        self.draw(now, readings);
    }

    fn draw(&mut self, now: Duration, readings: &Readings) {
        let picture = picture(now, readings);
        let mut out = std::io::stdout().lock();
        // a screen that is gone does not end the demonstration
        if self.is_terminal && self.lines > 0 {
            let _ = write!(out, "\x1b[{}A", self.lines);
        }
        for line in &picture {
            let end = if self.is_terminal { "\x1b[K" } else { "" };
            let _ = writeln!(out, "{line}{end}");
        }
        let _ = out.flush();
        self.lines = picture.len();
    }
}

fn picture(now: Duration, readings: &Readings) -> Vec<String> {
    let mut lines = vec![format!("t = {:.2} s", now.as_secs_f64())];
    for (unit, place) in [(CAN_UNIT, "CAN"), (RS485_A_UNIT, "RS485 a")] {
        if let Some([fx, fy, fz, tx, ty, tz]) = readings.sensors.get(&unit) {
            lines.push(format!(
                "  unit {unit:>3}  six axes, {place:<7} F {fx:9.3} {fy:9.3} {fz:9.3} N   T {tx:7.3} {ty:7.3} {tz:7.3} N.m"
            ));
        }
    }
    if let Some((volts, on)) = readings.output {
        let switch = if on { "on" } else { "off" };
        lines.push(format!("  unit {OUTPUTS_UNIT:>3}  own outputs        channel 1 {volts:.3} V, {switch}"));
    }
    lines.push(format!(
        "  unit {RS485_B_UNIT:>3}  station, RS485 b   DI {} DO {} AI {} AO {}",
        bits(&readings.digital_inputs),
        bits(&readings.digital_outputs),
        words(&readings.analog_inputs),
        words(&readings.analog_outputs),
    ));
    if let Some(about) = readings.about {
        let sum = |of: fn(&bridge::Counters) -> u32| {
            readings.counters.iter().map(|counters| u64::from(of(counters))).sum::<u64>()
        };
        let [major, minor, patch] = about.version;
        lines.push(format!(
            "  unit {:>3}  the bridge         {major}.{minor}.{patch}, up {:.1} s, health {:#06x}, requests {}, timeouts {}, retries {}, foreign {}",
            bridge::UNIT,
            about.uptime_us as f64 / 1e6,
            about.health,
            readings.counters[usize::from(bridge::port::HOST)].received,
            sum(|counters| counters.timeouts),
            sum(|counters| counters.retries),
            sum(|counters| counters.foreign_or_late),
        ));
    }
    lines
}

/// The first channel is on the left.
fn bits(bits: &[bool]) -> String {
    bits.iter().map(|on| if *on { '1' } else { '0' }).collect()
}

fn words(words: &[u16]) -> String {
    words.iter().map(|word| format!("{word:04X}")).collect::<Vec<_>>().join(" ")
}
