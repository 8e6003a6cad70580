//! What nothing may be larger, slower or less than.

use std::fmt;

use anyhow::Result;

use super::figures::Figures;
use super::{bridge, host};

/// A limit: of what, as [`Figures`] has it, and the number.
struct Limit {
    place: &'static str,
    subject: &'static str,
    what: &'static str,
    bound: Bound,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Bound {
    AtMost(f64),
    AtLeast(f64),
    /// The figure of the second subject is at most so much more than that of the first, which is in the limit.
    Over(&'static str, f64),
    /// The figure of this, for each of 64 KiB, is at most so many times that for each of 1 KiB.
    Grows(f64),
    /// One more of these costs, from the second number of them to the third, at most so much more than from the first to
    /// the second.
    Linear([u8; 3], f64),
}

const SIZE: &str = "m4 size";
const SPEED: &str = "m4 speed";

/// All of them.
static LIMITS: &[Limit] = &[
    at_most(SIZE, "server_small", "flash", 2000.0),
    at_most(SIZE, "server_small", "static RAM", 0.0),
    at_most(SIZE, "server_small", "stack", 128.0),
    at_most(SIZE, "server_small", "03 x 10 registers", 1000.0),
    at_most(SIZE, "server_small", "10 x 10 registers", 1000.0),
    at_most(SIZE, "server_small", "01 x 16 coils", 600.0),
    at_most(SIZE, "server_small", "wrong CRC", 200.0),
    at_most(SPEED, "server", "03 x 10 registers", 420.0),
    at_most(SPEED, "server", "10 x 10 registers", 450.0),
    at_most(SPEED, "server", "01 x 16 coils", 330.0),
    at_most(SPEED, "server", "wrong CRC", 80.0),
    at_most(host::PLACE, "server_sliced", "03 x 10 registers", 350.0),
    at_most(host::PLACE, "server_sliced", "10 x 10 registers", 350.0),
    at_most(host::PLACE, "server_sliced", "01 x 16 coils", 250.0),
    at_most(host::PLACE, "server_sliced", "wrong CRC", 60.0),
    at_most(SPEED, "nst", "read of six axes", 400.0),
    at_most(SPEED, "nxi", "write of one value", 400.0),
    at_most(SPEED, "ndam", "read of 8 AI", 400.0),
    at_most(SPEED, "can_join", "20 bytes in 3 frames", 250.0),
    at_most(SPEED, "can_cut", "20 bytes in 3 frames", 250.0),
    of_bridge(bridge::IMAGE, "flash", Bound::AtMost(64.0 * 1024.0)),
    of_bridge(bridge::IMAGE, "static RAM", Bound::AtMost(16.0 * 1024.0)),
    of_bridge(bridge::IMAGE, "worst stack", Bound::AtMost(3.0 * 1024.0)),
    of_bridge(bridge::IMAGE, "received byte, USART1", Bound::AtMost(40.0)),
    of_bridge(bridge::IMAGE, "received byte, USART2", Bound::AtMost(40.0)),
    of_bridge(bridge::IMAGE, "reply from CAN to host, worst", Bound::AtMost(2200.0)),
    of_bridge(bridge::IMAGE, "reply from RS485 to host, worst", Bound::AtMost(2200.0)),
    of_bridge(bridge::IMAGE, "request from host to CAN, worst", Bound::AtMost(2800.0)),
    of_bridge(bridge::IMAGE, "idle turn", Bound::AtMost(450.0)),
    of_bridge(bridge::IMAGE, "saturated, share of the processor, %", Bound::AtMost(70.0)),
    of_bridge(bridge::WIRE, "delay added to a read, us", Bound::AtMost(45.0)),
    of_bridge(bridge::WIRE, "transparent reads a second", Bound::AtLeast(1000.0)),
    of_bridge(bridge::WIRE, "slot reads, share of the limit, %", Bound::AtLeast(95.0)),
    grows("decode request, random bytes"),
    grows("decode request, beginnings of replies"),
    grows("decode reply, random bytes"),
    grows("decode reply, beginnings of replies"),
    over(SIZE),
    over(SPEED),
    linear(MORE[0]),
    linear(MORE[1]),
    linear(MORE[2]),
    linear(MORE[3]),
];

/// What there may be more or less of, and three numbers of it that are measured.
pub(crate) const MORE: [(&str, [u8; 3]); 4] = [
    ("one more route", [1, 8, 16]),
    ("one more slot", [1, 4, 8]),
    ("one more unit", [1, 2, 4]),
    ("one more port", [1, 3, 5]),
];

/// Instructions that one more takes, from one number to the next.
pub(crate) fn steps(figures: &Figures, subject: &str, numbers: [u8; 3]) -> Result<[f64; 2]> {
    let [few, some, all] = numbers.map(|number| figures.get(host::PLACE, subject, &number.to_string()));
    let [first, second, third] = numbers.map(f64::from);
    let (few, some, all) = (few?, some?, all?);
    Ok([(some - few) / (second - first), (all - some) / (third - second)])
}

const fn at_most(place: &'static str, subject: &'static str, what: &'static str, most: f64) -> Limit {
    Limit { place, subject, what, bound: Bound::AtMost(most) }
}

const fn of_bridge(place: &'static str, what: &'static str, bound: Bound) -> Limit {
    Limit { place, subject: bridge::SUBJECT, what, bound }
}

const fn grows(subject: &'static str) -> Limit {
    Limit { place: host::PLACE, subject, what: "bytes of 64 KiB to bytes of 1 KiB", bound: Bound::Grows(1.1) }
}

const fn linear((subject, numbers): (&'static str, [u8; 3])) -> Limit {
    let bound = Bound::Linear(numbers, 10.0);
    Limit { place: host::PLACE, subject, what: "instructions of the last over those of the first", bound }
}

const fn over(place: &'static str) -> Limit {
    let bound = Bound::Over("routes_one", 60.0);
    Limit { place, subject: "routes_all", what: "the last of the units", bound }
}

/// A figure beside its limit.
pub(crate) struct Verdict {
    limit: &'static Limit,
    figure: f64,
}

impl Verdict {
    /// Whether the limit is held.
    pub(crate) fn holds(&self) -> bool {
        match self.limit.bound {
            Bound::AtLeast(least) => self.figure >= least,
            Bound::AtMost(most) | Bound::Over(_, most) | Bound::Grows(most) | Bound::Linear(_, most) => {
                self.figure <= most
            }
        }
    }

    fn columns(&self) -> [String; 5] {
        let Limit { place, subject, what, bound } = self.limit;
        let (what, bound) = match bound {
            Bound::AtMost(most) => ((*what).to_owned(), format!("at most {most}")),
            Bound::AtLeast(least) => ((*what).to_owned(), format!("at least {least}")),
            Bound::Over(other, most) => (format!("{what}, over {other}"), format!("at most {most}")),
            Bound::Grows(most) | Bound::Linear(_, most) => ((*what).to_owned(), format!("at most {most}")),
        };
        let figure = (self.figure * 1000.0).round() / 1000.0;
        let verdict = if self.holds() { "holds" } else { "**not held**" };
        [format!("{place}: {subject}"), what, figure.to_string(), bound, verdict.to_owned()]
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [subject, what, figure, bound, _] = self.columns();
        write!(formatter, "{subject}, {what}: {figure}, {bound}")
    }
}

/// Every limit with its figure; one that was not measured is an error.
pub(crate) fn verdicts(figures: &Figures) -> Result<Vec<Verdict>> {
    let verdict = |limit: &'static Limit| {
        let get = |subject, what| figures.get(limit.place, subject, what);
        let figure = match limit.bound {
            Bound::AtMost(_) | Bound::AtLeast(_) => get(limit.subject, limit.what)?,
            Bound::Over(other, _) => get(limit.subject, limit.what)? - get(other, limit.what)?,
            Bound::Grows(_) => get(limit.subject, "65536")? / 64.0 / get(limit.subject, "1024")?,
            Bound::Linear(numbers, _) => {
                let [first, last] = steps(figures, limit.subject, numbers)?;
                last - first
            }
        };
        Ok(Verdict { limit, figure })
    };
    LIMITS.iter().map(verdict).collect()
}

/// A table of them, in Markdown.
pub(crate) fn table(verdicts: &[Verdict]) -> String {
    let mut text = String::from("| measured | what | figure | limit | |\n|---|---|---|---|---|\n");
    for verdict in verdicts {
        text.push_str(&format!("| {} |\n", verdict.columns().join(" | ")));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_is_on_one_side_of_its_limit() {
        let of = |bound, figure| Verdict {
            limit: Box::leak(Box::new(Limit { place: "", subject: "", what: "", bound })),
            figure,
        };
        assert!(of(Bound::AtMost(40.0), 40.0).holds() && !of(Bound::AtMost(40.0), 41.0).holds());
        assert!(of(Bound::AtLeast(95.0), 95.0).holds() && !of(Bound::AtLeast(95.0), 94.9).holds());
    }

    #[test]
    fn what_was_not_measured_has_no_verdict() {
        assert!(verdicts(&Figures::default()).is_err());
    }

    #[test]
    fn growth_is_for_each_byte() {
        let mut figures = Figures::default();
        for Limit { place, subject, what, .. } in LIMITS {
            figures.set(place, subject, what, 1.0);
            figures.set(place, "routes_one", what, 1.0);
            figures.set(place, subject, "1024", 1000.0);
            figures.set(place, subject, "65536", 64_000.0);
        }
        for (subject, numbers) in MORE {
            numbers.iter().for_each(|number| {
                figures.set(host::PLACE, subject, &number.to_string(), f64::from(*number) * 7.0);
            });
        }
        let all = verdicts(&figures).unwrap();
        let growth = all.iter().find(|one| matches!(one.limit.bound, Bound::Grows(_))).unwrap();
        assert_eq!(growth.figure, 1.0);
        let linear = all.iter().filter(|one| matches!(one.limit.bound, Bound::Linear(..)));
        assert!(linear.clone().all(|one| one.figure == 0.0 && one.holds()));
        assert_eq!(linear.count(), MORE.len());
        assert_eq!(steps(&figures, MORE[0].0, MORE[0].1).unwrap(), [7.0, 7.0]);
    }
}
