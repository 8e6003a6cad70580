//! What the fuzz targets start from: the frames of the manuals, and what has broken Modbus libraries before. They are
//! written to `checks/fuzz/seeds/` by `cargo xtask fuzz --write-seeds`, in the form that each target reads.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result};

use crate::workspace::Workspace;

/// A seed's place below `checks/fuzz/seeds/`, and its bytes.
type Seeds = BTreeMap<PathBuf, Vec<u8>>;

/// One frame of a manual.
struct Vector<'a> {
    id: &'a str,
    device: &'a str,
    link: &'a str,
    is_request: bool,
    hex: &'a str,
}

/// What must not break a Modbus server: a name, and a request's unit, function code and data.
const FAULTS: [(&str, &[u8]); 9] = [
    ("coil-value-0x1234", &[1, 0x05, 0, 0, 0x12, 0x34]),
    ("exception-of-one-byte", &[1, 0x83]),
    ("byte-count-beyond-frame", &[1, 0x10, 0, 0, 0, 2, 200, 0, 1]),
    ("byte-count-0-quantity-10", &[1, 0x0F, 0, 0, 0, 10, 0]),
    ("quantity-0", &[1, 0x03, 0, 0, 0, 0]),
    ("quantity-65535", &[1, 0x01, 0, 0, 0xFF, 0xFF]),
    ("past-the-end", &[1, 0x04, 0xFF, 0xFF, 0, 2]),
    ("unknown-function", &[1, 0x41, 1, 2, 3]),
    ("read-and-write", &[1, 0x17, 0, 0, 0, 1, 0, 0, 0, 1, 2, 0xAB, 0xCD]),
];

/// Layouts of the three modules in `ndam_station`: inputs, outputs, both digital and analog.
const LAYOUTS: [u8; 12] = [14, 10, 8, 4, 4, 4, 0, 0, 16, 16, 16, 16];

/// Where they are.
pub(super) fn folder(workspace: &Workspace) -> PathBuf {
    super::folder(workspace).join("seeds")
}

/// Writes all seeds.
pub(super) fn write(workspace: &Workspace) -> Result<()> {
    let folder = folder(workspace);
    for (path, bytes) in seeds(workspace)? {
        let path = folder.join(path);
        let parent = path.parent().context("a seed lies in a folder")?;
        fs::create_dir_all(parent).with_context(|| format!("cannot make {}", parent.display()))?;
        fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(())
}

/// All seeds.
fn seeds(workspace: &Workspace) -> Result<Seeds> {
    let table = workspace.root.join("host-tests").join("vectors").join("manual.csv");
    let table = fs::read_to_string(&table).with_context(|| format!("cannot read {}", table.display()))?;
    let mut seeds = Seeds::new();
    let mut add = |target: &str, name: &str, bytes: Vec<u8>| {
        seeds.insert([target, name].iter().collect(), bytes);
    };
    let mut transfers = Vec::new();
    let mut station = LAYOUTS.to_vec();
    for vector in table.lines().skip(1).filter_map(vector) {
        if vector.link == "can" {
            let (identifier, data) = vector.hex.split_once('#').context("a CAN frame without a #")?;
            let (identifier, data) = (bytes(identifier)?, bytes(data)?);
            add("slcan", vector.id, slcan(&identifier, &data));
            add("engine", vector.id, engine_frame(&identifier, &data));
            transfers.extend(transfer(&data));
            continue;
        }
        let frame = bytes(vector.hex)?;
        let Some((content, _crc)) = frame.split_last_chunk::<2>() else { continue };
        let Some((_unit, body)) = content.split_first() else { continue };
        match (vector.device, vector.is_request) {
            ("nst", true) => {
                add("nst_bodies", vector.id, body.to_vec());
                add("nst_line", vector.id, piece(&frame));
                add("nst_daq", vector.id, [&[0][..], &record(&[4, 0], content)].concat());
                add("engine", vector.id, [&[1, length(content)][..], content, &[11, 0, 10, 0]].concat());
            }
            ("nst", false) => add("nst_bodies", vector.id, body.to_vec()),
            (device, _) => {
                add("modbus_pdu", vector.id, body.to_vec());
                add("shared_line", vector.id, [&[0][..], &piece(&frame)].concat());
                if device == "nxi6201" {
                    add("nxi_card", vector.id, record(&[15], content));
                } else {
                    station.extend(record(&[15], &[&[2][..], body].concat()));
                }
            }
        }
    }
    add("nst_can", "manual", transfers);
    add("ndam_station", "manual", station);
    for (name, content) in FAULTS {
        let pdu = content.get(1..).unwrap_or_default();
        let wrong = piece(&[content, &[0xDE, 0xAD]].concat());
        add("rtu_line", name, [&wrong[..], &wrong].concat());
        add("shared_line", name, [&[0][..], &wrong].concat());
        add("modbus_pdu", name, pdu.to_vec());
        add("modbus_server", name, [&[0][..], &record(&[1, 0], pdu)].concat());
        add("ndam_station", name, [&LAYOUTS[..], &record(&[15], &[&[2][..], pdu].concat())].concat());
        add("engine", name, [&[1, length(content)][..], content, &[11, 0, 10, 0]].concat());
    }
    let noise: Vec<u8> = piece(&[0x55; 60]).repeat(5);
    for target in ["rtu_line", "nst_line"] {
        add(target, "300-times-0x55", noise.clone());
    }
    add("modbus_ascii", "without-end", [&b":0203"[..], &b"00".repeat(400)].concat());
    add("modbus_ascii", "request", b":020100000001FC\r\n".to_vec());
    add("modbus_tcp", "request", [&[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1][..]; 2].concat());
    for declared in [0, 1, 254, 255] {
        add("modbus_tcp", &format!("length-{declared}"), [&[0, 1, 0, 0, 0, declared, 1, 3][..]; 2].concat());
    }
    Ok(seeds)
}

/// A line of the table; the columns that may be quoted come after those that we read.
fn vector(line: &str) -> Option<Vector<'_>> {
    let mut columns = line.split(',');
    let [id, device, link, direction, hex] = std::array::from_fn(|_| columns.next().unwrap_or_default());
    (!hex.is_empty()).then_some(Vector { id, device, link, is_request: direction == "request", hex })
}

/// The bytes of hexadecimal digits, with or without spaces.
fn bytes(hex: &str) -> Result<Vec<u8>> {
    let digits: Vec<u8> = hex.bytes().filter(|digit| !digit.is_ascii_whitespace()).collect();
    let pairs = digits.chunks(2).map(|pair| Ok(u8::from_str_radix(std::str::from_utf8(pair)?, 16)?));
    pairs.collect::<Result<_>>().with_context(|| format!("`{hex}` is not hexadecimal"))
}

/// The length of less than a frame.
fn length(content: &[u8]) -> u8 {
    u8::try_from(content.len()).expect("less than a frame")
}

/// A record of a script: what stands before it, its length, its bytes.
fn record(head: &[u8], content: &[u8]) -> Vec<u8> {
    [head, &[length(content)], content].concat()
}

/// A frame of less than 64 bytes as a piece of a stream, after the silence that ends a burst.
fn piece(frame: &[u8]) -> Vec<u8> {
    [&[0xC0 | length(frame) & 0x3F][..], frame].concat()
}

/// A frame for the reassembler of `nst_can`: right away, from node 1, the only one of its transfer.
fn transfer(data: &[u8]) -> Vec<u8> {
    let mut payload = data.to_vec();
    payload.resize(8, 0);
    [&[0, 1, 0x10, length(data)][..], &payload].concat()
}

/// A frame at the bridge's CAN port.
fn engine_frame(identifier: &[u8], data: &[u8]) -> Vec<u8> {
    let mut payload = data.to_vec();
    payload.resize(8, 0);
    [&[3, length(data)][..], identifier, &payload].concat()
}

/// The line of a CAN frame.
fn slcan(identifier: &[u8], data: &[u8]) -> Vec<u8> {
    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02X}")).collect::<String>();
    format!("T{}{}{}\r", hex(identifier), data.len(), hex(data)).into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_seeds_are_those_of_the_manuals() {
        let workspace = Workspace::locate().unwrap();
        let (seeds, folder) = (seeds(&workspace).unwrap(), folder(&workspace));
        assert!(seeds.values().map(Vec::len).sum::<usize>() < 100 * 1024);
        for (path, bytes) in seeds {
            let kept = fs::read(folder.join(&path)).unwrap_or_default();
            assert!(kept == bytes, "{}: cargo xtask fuzz --write-seeds", path.display());
        }
    }

    #[test]
    fn frames_become_lines() {
        assert_eq!(slcan(&[0, 2, 1, 0x10], &[0x10, 1]), b"T0002011021001\r");
    }
}
