//! `CONTRACT.md` names tests that exist.

use std::path::Path;

/// File or folder of each prefix in the table, from the root of the workspace.
const PLACES: [(&str, &str); 10] = [
    ("engine", "mcu-bridge/tests/engine"),
    ("boards", "mcu-bridge/tests/boards.rs"),
    ("registers", "mcu-bridge/tests/registers"),
    ("store", "mcu-bridge/tests/store.rs"),
    ("image", "host-tests/tests/image"),
    ("clients", "host-tests/tests/real_clients.rs"),
    ("sim", "host-tests/tests/sim.rs"),
    ("unit", "mcu-bridge/src"),
    ("decode", "protocol/src/decode"),
    ("nst", "protocol/src/nst"),
];

/// The sources at a place, folders with all that is in them.
fn sources(place: &Path) -> Vec<String> {
    if place.is_file() {
        return vec![std::fs::read_to_string(place).expect("a source")];
    }
    let inside = std::fs::read_dir(place).expect("a file or a folder of sources");
    inside.flat_map(|entry| sources(&entry.expect("an entry").path())).collect()
}

#[test]
fn every_test_that_the_contract_names_exists() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let contract = include_str!("../CONTRACT.md");
    let named = contract.split('`').skip(1).step_by(2).filter_map(|code| code.split_once("::"));
    let mut count = 0;
    for (prefix, name) in named {
        let (_, place) = PLACES.iter().find(|(known, _)| *known == prefix).expect(prefix);
        let found = sources(&root.join(place)).iter().any(|source| {
            source.contains(&format!("#[test]\n    fn {name}()"))
                || source.contains(&format!("#[test]\nfn {name}()"))
        });
        assert!(found, "no test {name} in {place}");
        count += 1;
    }
    assert!(count > 100, "only {count} tests named");
    let rows = contract.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| promise"));
    for row in rows {
        assert!(row.contains("::"), "nothing holds {row}");
    }
}
