//! The page of the register map, as Markdown.

use jointbus_mcu_bridge::board::{Description, Topology};
use jointbus_mcu_bridge::boards::stm32f405::BOARD;
use jointbus_mcu_bridge::registers::{ALL, Access, Initial, MAP, Range, Register, Repeat, Space};
use std::fmt::Write as _;

const HEAD: &str = "\
# The bridge's own unit

Unit 247 speaks Modbus: function codes 03, 06 and 10 for holding registers, 04 for input registers, 08 diagnostics, 11
server ID and 2B/0E device identification. Values of several registers come high word first. A write is all or nothing.

This page is written from the table that the engine dispatches by (`src/registers.rs`):
`cargo run --package jointbus-mcu-bridge --example registers > mcu-bridge/REGISTERS.md`. A test fails where it is not
current.
";

/// The whole page.
pub(crate) fn page() -> String {
    let mut page = format!("{HEAD}\nThis is version {MAP} of the map.\n");
    section(
        &mut page,
        "Input registers",
        "Read with function code 04. What is not listed reads 0, up to 0x02FF; beyond is exception 02.",
        Space::Input,
    );
    section(
        &mut page,
        "Holding registers",
        "A *staged* value acts with the command *apply*, all others act at once; a *command* reads 0. A value out of its range \
         is exception 03. What is not listed reads 0, and writing it is exception 02.",
        Space::Holding,
    );
    defaults(&mut page, BOARD);
    page
}

fn section(page: &mut String, title: &str, about: &str, space: Space) {
    let _ = write!(page, "\n## {title}\n\n{about}\n\n");
    page.push_str("| address | registers | name | unit | access | range | default | meaning |\n");
    page.push_str("|---|---|---|---|---|---|---|---|\n");
    for row in ALL.iter().filter(|row| row.space == space) {
        let _ = writeln!(
            page,
            "| {} | {} | `{}` | {} | {} | {} | {} | {} |",
            address(row),
            row.words,
            row.name,
            row.unit,
            access(row),
            range(row.range, row.access),
            initial(row.initial),
            row.meaning
        );
    }
}

fn address(row: &Register) -> String {
    let first = row.address;
    let letter = match row.repeat {
        Repeat::Once => return format!("{first:#06X}").replace('X', "x"),
        Repeat::Ports => 'p',
        Repeat::Targets => 't',
        Repeat::Routes => 'r',
        Repeat::Slots => 's',
    };
    let stride = if row.stride == 1 { String::new() } else { format!("{:#X} ", row.stride) };
    format!("{first:#06X} + {stride}{letter}").replace("0X", "0x")
}

fn access(row: &Register) -> &'static str {
    match row.access {
        Access::Read => "read",
        Access::Command => "command",
        Access::Write => "at once",
        Access::Staged => "staged",
    }
}

fn range(range: Range, access: Access) -> String {
    match (range, access) {
        (_, Access::Read) => String::new(),
        (Range::Any, _) => "0-65535".to_owned(),
        (Range::Between(first, last), _) => format!("{first}-{last}"),
        (Range::OneOf(values), _) => {
            values.iter().map(|value| format!("0x{value:04X}")).collect::<Vec<_>>().join(", ")
        }
        (Range::Target, _) => "1 to the number of targets".to_owned(),
    }
}

fn initial(initial: Initial) -> String {
    match initial {
        Initial::None => String::new(),
        Initial::Value(value) => value.to_string(),
        Initial::Board => "the board's".to_owned(),
    }
}

fn defaults(page: &mut String, board: &Description) {
    let _ = write!(page, "\n## Defaults of the board `{}`\n\n", board.name);
    page.push_str("| p | port | rate | format | gap | own node |\n|---|---|---|---|---|---|\n");
    let topology = Topology::of(board);
    for (port, own) in board.ports().zip(board.ports) {
        let config = topology.ports[port.index()];
        let _ = writeln!(
            page,
            "| {} | {} | {} | {:?}, {} stop | {} | {} |",
            port.index(),
            own.name,
            config.rate,
            config.parity,
            config.stop_bits,
            config.gap_100us,
            config.node
        );
    }
    page.push_str("\n| r | units | target | protocol | first address |\n|---|---|---|---|---|\n");
    for (number, row) in topology.routes.iter().enumerate().filter(|(_, row)| row.is_used()) {
        let _ = writeln!(
            page,
            "| {number} | {}-{} | {} | {} | {} |",
            row.first_unit,
            row.last_unit,
            board.target_number(row.target),
            row.protocol.value(),
            row.first_address
        );
    }
    let limits = board.limits;
    let _ = writeln!(
        page,
        "\n`QUARANTINE_AFTER` {}, `PROBE_PERIOD` {}, `HOST_SILENCE` {}, `BURST_SILENCE` {}.",
        limits.quarantine_after, limits.probe_period_ms, limits.host_silence_ms, limits.burst_silence_100us
    );
}
