//! The library that the general server is compared with.

use std::process::Command;

use anyhow::{Context, Result, bail};

use super::apt;
use crate::run;

const PACKAGE: &str = "libmodbus-dev";
const ADVICE: &str = "missing: libmodbus with its development files\n  \
                      Debian and Ubuntu: apt-get install libmodbus-dev\n  \
                      elsewhere: libmodbus 3.1, where the linker finds it";

/// Installs it where it is missing.
pub(crate) fn ensure() -> Result<()> {
    if links() {
        return Ok(());
    }
    apt::install(&[PACKAGE]).context(ADVICE)?;
    if !links() {
        bail!("{PACKAGE} is installed, but the linker does not find it\n{ADVICE}");
    }
    Ok(())
}

/// Whether a program can be linked against it.
fn links() -> bool {
    let Ok(folder) = tempfile::tempdir() else { return false };
    let mut command = Command::new("cc");
    command.args(["-shared", "-o"]).arg(folder.path().join("probe")).args(["-Wl,--no-as-needed", "-lmodbus"]);
    run::output(&mut command).is_ok()
}
