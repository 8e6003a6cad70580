//! `cargo fmt` and `cargo clippy`, which a minimal Rust installation lacks.

use std::time::Duration;

use anyhow::{Context, Result};

use super::apt;
use crate::run;
use crate::workspace::Workspace;

/// Two small downloads.
const RUSTUP_LIMIT: Duration = Duration::from_secs(120);

/// A subcommand of cargo, and where it comes from.
#[derive(Clone, Copy)]
struct Component {
    subcommand: &'static str,
    /// With rustup.
    component: &'static str,
    /// Debian's package beside its `rustc-web`.
    package: &'static str,
}

const COMPONENTS: [Component; 2] = [
    Component { subcommand: "fmt", component: "rustfmt", package: "rustfmt-web" },
    Component { subcommand: "clippy", component: "clippy", package: "rust-web-clippy" },
];

/// Installs what is missing, the way the toolchain itself was installed.
pub(crate) fn ensure(workspace: &Workspace) -> Result<()> {
    let missing: Vec<Component> =
        COMPONENTS.into_iter().filter(|component| !works(workspace, *component)).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let components: Vec<_> = missing.iter().map(|component| component.component).collect();
    let packages: Vec<_> = missing.iter().map(|component| component.package).collect();
    let installed = if run::find("rustup").is_some() {
        println!("setup: adding {} with rustup", components.join(", "));
        let mut command = workspace.command("rustup");
        run::quiet(command.args(["component", "add"]).args(&components), RUSTUP_LIMIT)
    } else {
        apt::install(&packages)
    };
    installed.with_context(|| {
        format!(
            "missing: {}\n  with rustup: rustup component add {}\n  Debian: apt-get install {}",
            components.join(", "),
            components.join(" "),
            packages.join(" ")
        )
    })
}

/// Whether cargo has the subcommand.
fn works(workspace: &Workspace, component: Component) -> bool {
    run::output(workspace.cargo().args([component.subcommand, "--version"])).is_ok()
}
