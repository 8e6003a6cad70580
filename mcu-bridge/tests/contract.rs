//! `CONTRACT.md` names tests that exist.

use std::path::Path;

/// Files of each prefix in the table, from the root of the workspace.
const FILES: [(&str, &[&str]); 6] = [
    ("engine", &["mcu-bridge/tests/engine.rs"]),
    ("store", &["mcu-bridge/tests/store.rs"]),
    ("image", &["host-tests/tests/image.rs"]),
    ("clients", &["host-tests/tests/real_clients.rs"]),
    (
        "unit",
        &[
            "mcu-bridge/src/engine/polling.rs",
            "mcu-bridge/src/engine/quarantine.rs",
            "mcu-bridge/src/engine/settings.rs",
            "mcu-bridge/src/engine/transaction.rs",
        ],
    ),
    ("deframe", &["protocol/src/deframe.rs"]),
];

#[test]
fn every_test_that_the_contract_names_exists() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let contract = include_str!("../CONTRACT.md");
    let named = contract.split('`').skip(1).step_by(2).filter_map(|code| code.split_once("::"));
    let mut count = 0;
    for (prefix, name) in named {
        let (_, files) = FILES.iter().find(|(known, _)| *known == prefix).expect(prefix);
        let found = files.iter().any(|file| {
            let source = std::fs::read_to_string(root.join(file)).expect(file);
            source.contains(&format!("#[test]\n    fn {name}()"))
                || source.contains(&format!("#[test]\nfn {name}()"))
        });
        assert!(found, "no test {name} in {files:?}");
        count += 1;
    }
    assert!(count > 40, "only {count} tests named");
}
