//! The tables and plots.

use anyhow::{Context, Result};

use super::figures::Figures;
use super::plot::{self, Series};
use super::{bridge, host, limits};

/// The four requests of the servers.
const REQUESTS: [&str; 4] = ["03 x 10 registers", "10 x 10 registers", "01 x 16 coils", "wrong CRC"];

/// Servers: what they are called in the figures, and for people.
const SERVERS: [(&str, &str); 8] = [
    ("server", "ours, CRC table of 512 B"),
    ("server_sliced", "ours, CRC tables of 2 KiB"),
    ("server_small", "ours, CRC table of 32 B"),
    ("server_bitwise", "ours, no CRC table"),
    ("rmodbus", "rmodbus 0.13"),
    ("modbus_core", "modbus-core 0.2 and glue"),
    ("mbus", "mbus-server 0.16"),
    ("libmodbus", "libmodbus 3.1 (C)"),
];

/// Our servers by the function that computes the CRC, and the bytes of its tables.
const CRCS: [(&str, &str, u32); 4] = [
    ("server", "crc16", 512),
    ("server_sliced", "crc16_sliced", 2048),
    ("server_small", "crc16_small", 32),
    ("server_bitwise", "crc16_bitwise", 0),
];

/// The rest of what runs on a bare Cortex-M4, with what it is asked.
const PARTS: [(&str, &str, &str); 7] = [
    ("nst", "NST dispatcher", "read of six axes"),
    ("nxi", "NXI-6201 dispatcher", "write of one value"),
    ("ndam", "NDAM-9010 dispatcher", "read of 8 AI"),
    ("can_join", "NST over CAN, joined", "20 bytes in 3 frames"),
    ("can_cut", "NST over CAN, cut", "20 bytes in 3 frames"),
    ("routes_one", "routing, 1 route", "the last of the units"),
    ("routes_all", "routing, 16 routes", "the last of the units"),
];

/// Where servers are compared: the figures' place, the headline, and which of ours the ratios are to.
const COMPARISONS: [(&str, &str, &str); 3] = [
    ("m4 size", "Cortex-M4, optimised for size", "server_small"),
    ("m4 speed", "Cortex-M4, optimised for speed", "server"),
    (host::PLACE, "Host (callgrind), optimised for speed", "server_sliced"),
];

/// What the bridge's figures are called.
const BRIDGE: [(&str, &str, &str); 24] = [
    (bridge::IMAGE, "flash", "flash, B"),
    (bridge::IMAGE, "static RAM", "static RAM, B"),
    (bridge::IMAGE, "worst stack", "worst-case stack, B"),
    (bridge::IMAGE, "received byte, USART1", "instructions of the host port's interrupt for a received byte"),
    (bridge::IMAGE, "received byte, USART2", "the same of an RS485 port"),
    (
        bridge::IMAGE,
        "reply from CAN to host, worst",
        "instructions from a reply's last frame to its first byte to the host",
    ),
    (bridge::IMAGE, "reply from RS485 to host, worst", "the same from a reply's last byte on RS485"),
    (
        bridge::IMAGE,
        "request from host to CAN, worst",
        "instructions from a request's last byte to its first frame for the CAN controller",
    ),
    (bridge::IMAGE, "idle turn", "instructions of an idle turn of the main loop"),
    (bridge::IMAGE, "idle turn, worst", "the same, the longest that was seen"),
    (bridge::IMAGE, "turn with nothing to do", "instructions of a turn that an interrupt woke for nothing"),
    (bridge::IMAGE, "a byte from the host", "instructions of a byte from the host, without that"),
    (bridge::IMAGE, "a byte to the host", "of a byte to the host"),
    (bridge::IMAGE, "a read by CAN", "of a read by CAN, from its first byte to the last of its reply"),
    (bridge::IMAGE, "a read by RS485", "of a read by RS485"),
    (
        bridge::IMAGE,
        "saturated, share of the processor, %",
        "share of the processor with all ports saturated both ways, %",
    ),
    (bridge::WIRE, "request, us", "time of the main loop in the simulation for a request, us"),
    (bridge::WIRE, "reply, us", "the same for a reply, us"),
    (bridge::WIRE, "delay added to a read, us", "delay added to a read of an NST device on CAN, us"),
    (
        bridge::WIRE,
        "transparent reads a second",
        "reads of one such device by the host, one behind the other, 1/s",
    ),
    (bridge::WIRE, "slot reads a second", "reads by all polling slots, 1/s"),
    (bridge::WIRE, "slot reads a second, limit of the bus", "what the bus can carry of them, 1/s"),
    (
        bridge::WIRE,
        "slot reads, sensor's delay, us",
        "with a device that takes so long, the worst of several, us",
    ),
    (bridge::WIRE, "slot reads, share of the limit, %", "share, %"),
];

/// All tables, in Markdown.
pub(crate) fn tables(figures: &Figures) -> Result<String> {
    let mut text = String::new();
    for (place, headline, ours) in COMPARISONS {
        text.push_str(&format!("### {headline}\n\n"));
        text.push_str(&servers(figures, place, ours)?);
        text.push('\n');
    }
    text.push_str("### The general server by its CRC, ten registers read\n\n");
    text.push_str(&crcs(figures)?);
    text.push_str("\n### Dispatchers, CAN and routing on the Cortex-M4\n\n");
    text.push_str(&parts(figures)?);
    text.push_str("\n### The bridge\n\n| | |\n|---|---|\n");
    for (place, what, name) in BRIDGE {
        let figure = figures.get(place, bridge::SUBJECT, what)?;
        text.push_str(&format!("| {name} | {} |\n", (figure * 10.0).round() / 10.0));
    }
    text.push_str("\n### One more of what the bridge has, instructions on the host\n\n");
    text.push_str(&more(figures)?);
    text.push_str("\n### Garbage on the host, instructions a byte\n\n| | 1 KiB | 64 KiB |\n|---|---|---|\n");
    for side in ["request", "reply"] {
        for kind in ["random bytes", "beginnings of replies"] {
            let subject = format!("decode {side}, {kind}");
            let few = figures.get(host::PLACE, &subject, "1024")? / 1024.0;
            let many = figures.get(host::PLACE, &subject, "65536")? / 65536.0;
            text.push_str(&format!("| {side} in {kind} | {few:.1} | {many:.1} |\n"));
        }
    }
    Ok(text)
}

/// Servers on one place, each figure with its ratio to ours where it is another's.
fn servers(figures: &Figures, place: &str, ours: &str) -> Result<String> {
    let on_part = place != host::PLACE;
    let mut columns = if on_part { vec!["flash", "static RAM", "state", "stack"] } else { Vec::new() };
    columns.extend(REQUESTS);
    let mut text = format!("| | {} |\n|---|{}\n", columns.join(" | "), "---|".repeat(columns.len()));
    for (server, name) in SERVERS.iter().filter(|(server, _)| *server != "libmodbus" || !on_part) {
        text.push_str(&format!("| {name} |"));
        for column in &columns {
            let figure = figures.get(place, server, column)?;
            let base = figures.get(place, ours, column)?;
            let is_ours = server.starts_with("server");
            if is_ours || base == 0.0 {
                text.push_str(&format!(" {figure} |"));
            } else {
                text.push_str(&format!(" {figure} ({:.2}x) |", figure / base));
            }
        }
        text.push('\n');
    }
    Ok(text)
}

fn crcs(figures: &Figures) -> Result<String> {
    let mut text = String::from(
        "| `checksum::` | its tables, B | flash, M4 size | instructions, M4 size | flash, M4 speed | \
         instructions, M4 speed | instructions, host |\n|---|---|---|---|---|---|---|\n",
    );
    let [request, ..] = REQUESTS;
    for (server, function, bytes) in CRCS {
        let figure = |place, what| figures.get(place, server, what);
        text.push_str(&format!(
            "| `{function}` | {bytes} | {} | {} | {} | {} | {} |\n",
            figure("m4 size", "flash")?,
            figure("m4 size", request)?,
            figure("m4 speed", "flash")?,
            figure("m4 speed", request)?,
            figure(host::PLACE, request)?,
        ));
    }
    Ok(text)
}

fn parts(figures: &Figures) -> Result<String> {
    let mut text = String::from(
        "| | asked | flash, size | stack, size | instructions, size | flash, speed | stack, speed | \
         instructions, speed |\n|---|---|---|---|---|---|---|---|\n",
    );
    for (part, name, request) in PARTS {
        text.push_str(&format!("| {name} | {request} |"));
        for place in ["m4 size", "m4 speed"] {
            for what in ["flash", "stack", request] {
                text.push_str(&format!(" {} |", figures.get(place, part, what)?));
            }
        }
        text.push('\n');
    }
    Ok(text)
}

fn more(figures: &Figures) -> Result<String> {
    let mut text = String::from(
        "| | numbers | instructions | the first ones, each | the last ones, each |\n|---|---|---|---|---|\n",
    );
    for (subject, numbers) in limits::MORE {
        let all = numbers.map(|number| figures.get(host::PLACE, subject, &number.to_string()));
        let all = all.into_iter().collect::<Result<Vec<_>>>()?;
        let [first, last] = limits::steps(figures, subject, numbers)?;
        let list = |values: Vec<String>| values.join(", ");
        let (numbers, all) = (numbers.map(|one| one.to_string()), all.iter().map(f64::to_string));
        let (numbers, all) = (list(numbers.to_vec()), list(all.collect()));
        text.push_str(&format!("| {subject} | {numbers} | {all} | {first:.1} | {last:.1} |\n"));
    }
    Ok(text)
}

/// File names and plots: instructions, and flash.
pub(crate) fn plots(figures: &Figures) -> Result<[(&'static str, String); 2]> {
    let servers = SERVERS.iter().filter(|(server, _)| *server != "libmodbus");
    let (subjects, names): (Vec<&str>, Vec<&str>) = servers.copied().unzip();
    let series = |place: &str, what: &str, name: &str| Series {
        name: name.to_owned(),
        values: subjects.iter().map(|subject| figures.get(place, subject, what).ok()).collect(),
    };
    let latency = REQUESTS.map(|request| series("m4 speed", request, request));
    let size = [
        series("m4 size", "flash", "flash, size"),
        series("m4 speed", "flash", "flash, speed"),
        series("m4 size", "stack", "stack, size"),
    ];
    Ok([
        (
            "latency.svg",
            plot::bars("Instructions a request, Cortex-M4, optimised for speed", &names, &latency),
        ),
        ("size.svg", plot::bars("Bytes, Cortex-M4", &names, &size)),
    ])
}

/// The report.
pub(crate) fn whole(tables: &str, limits: &str) -> String {
    format!(
        "# Benchmark\n\nBENCHMARKS.md tells how this was measured.\n\n![instructions](latency.svg)\n\
         ![bytes](size.svg)\n\n{tables}\n### Limits\n\n{limits}"
    )
}

const BEGIN: &str = "<!-- written by `cargo xtask bench --write` -->\n";
const END: &str = "<!-- end of what is written -->\n";

/// The page with these tables in place of those that it has.
pub(crate) fn put(page: &str, tables: &str, limits: &str) -> Result<String> {
    let (before, rest) = page.split_once(BEGIN).context("the page has no place for the tables")?;
    let (_, after) = rest.split_once(END).context("the place for the tables has no end")?;
    Ok(format!("{before}{BEGIN}\n{tables}\n### Limits\n\n{limits}\n{END}{after}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_keeps_what_is_around_the_tables() {
        let page = format!("before\n{BEGIN}old\n{END}after\n");
        let written = put(&page, "new\n", "limits\n").unwrap();
        assert!(written.starts_with("before\n") && written.ends_with("after\n"));
        assert!(written.contains("new") && written.contains("limits") && !written.contains("old"));
        assert_eq!(put(&written, "new\n", "limits\n").unwrap(), written, "once more changes nothing");
        assert!(put("nothing", "", "").is_err());
    }
}
