//! Where the things that `cargo xtask test` builds are. A test that needs them fails without them.

use std::path::PathBuf;

fn told(variable: &str) -> PathBuf {
    match std::env::var_os(variable) {
        Some(path) => path.into(),
        None => panic!("{variable} is not set: run this test through `cargo xtask test --only tests`"),
    }
}

/// The firmware's image.
pub(crate) fn image() -> PathBuf {
    told("JOINTBUS_IMAGE")
}

/// The emulator's plugin.
pub(crate) fn plugin() -> PathBuf {
    told("JOINTBUS_EMULATOR_PLUGIN")
}

/// The Python that has the real clients.
#[allow(dead_code, reason = "not every test talks Python")]
pub(crate) fn python() -> PathBuf {
    told("JOINTBUS_PYTHON")
}
