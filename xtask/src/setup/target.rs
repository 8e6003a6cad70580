//! A toolchain that builds for the microcontroller. There are two, because the second one works where only Debian's
//! packages can be had: rustup's, with a core library built by others, and Debian's, which builds the core library
//! itself from its source package.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};

use super::advice::Advice;
use super::packages::{self, Source};
use super::toolbox::{Toolbox, library_path};
use crate::run;
use crate::workspace::Workspace;

/// What the STM32F405 is to the compiler: a Cortex-M4 with its floating-point unit.
pub(crate) const TARGET: &str = "thumbv7em-none-eabihf";

/// The processors that the library crates are built for: that one, the smallest (a Cortex-M0+, without atomic operations
/// beyond loads and stores), and one of the newer ones (a Cortex-M33).
pub(crate) const TARGETS: [&str; 3] = [TARGET, "thumbv6m-none-eabi", "thumbv8m.main-none-eabihf"];

/// Forces one of the two ways: `rustup` or `debian`.
const CHOICE: &str = "JOINTBUS_TOOLCHAIN";

/// A core library of some megabytes.
const RUSTUP_LIMIT: Duration = Duration::from_secs(120);

/// Debian's Rust that is kept current for the browsers: compiler, cargo, library source, linter, linker.
const DEBIAN_PACKAGES: [&str; 5] = ["rustc-web", "cargo-web", "rust-web-src", "rust-web-clippy", "lld"];
/// Debian's compiler comes without the linker that rustup's brings along for bare-metal targets.
const DEBIAN_LINKER: &str = "ld.lld";
/// Its programs that are used here.
const DEBIAN_PROGRAMS: [&str; 4] = ["cargo", "rustc", "cargo-clippy", DEBIAN_LINKER];

/// What `cargo run` and rustup set for us, and what would lead Debian's cargo back to the other toolchain.
const FOREIGN: [&str; 9] = [
    "CARGO",
    "CARGO_BUILD_RUSTC",
    "LD_LIBRARY_PATH",
    "RUSTC",
    "RUSTC_WORKSPACE_WRAPPER",
    "RUSTC_WRAPPER",
    "RUSTDOC",
    "RUSTUP_TOOLCHAIN",
    "RUST_RECURSION_COUNT",
];

/// Where the system's own programs begin.
const SYSTEM: &str = "/";

const ADVICE: Advice = Advice {
    what: "a Rust toolchain for thumbv7em-none-eabihf, thumbv6m-none-eabi and thumbv8m.main-none-eabihf",
    purpose: "the image and the library crates (with rustup: rustup target add, with each target)",
    debian: "sudo apt-get install rustc-web cargo-web rust-web-src rust-web-clippy lld",
    fedora: "sudo dnf install rustup, then rustup-init",
    arch: "sudo pacman -S rustup",
    macos: "brew install rustup",
};

/// Whose toolchain it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    Rustup,
    Debian,
}

/// The way to build for the microcontroller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Toolchain {
    /// The toolchain that runs this program, with the target installed (by rustup, or by whatever else installs it).
    Rustup,
    /// Debian's own compiler, which builds the core library from source: the system's, or one unpacked into this folder.
    Debian(PathBuf),
}

impl Toolchain {
    /// `cargo SUBCOMMAND` for the STM32F405, still without packages and features.
    pub(crate) fn cargo(&self, workspace: &Workspace, subcommand: &str) -> Command {
        self.cargo_for(workspace, subcommand, TARGET)
    }

    /// The same for one of [`TARGETS`].
    pub(crate) fn cargo_for(&self, workspace: &Workspace, subcommand: &str, target: &str) -> Command {
        match self {
            Self::Rustup => {
                let mut command = workspace.cargo();
                command.args([subcommand, "--target", target]);
                command
            }
            Self::Debian(root) => {
                let mut command = debian(workspace, root, "cargo");
                command
                    // Building the core library is an unstable option; the compiler and the source are one release.
                    .env("RUSTC_BOOTSTRAP", "1")
                    .env(linker_variable(target), DEBIAN_LINKER)
                    .args([subcommand, "-Zbuild-std=core", "--target", target]);
                command
            }
        }
    }
}

/// A program of Debian's toolchain, which finds its like before any other.
fn debian(workspace: &Workspace, root: &Path, program: &str) -> Command {
    let programs = root.join("usr/bin");
    let mut command = workspace.command(programs.join(program));
    for name in FOREIGN {
        command.env_remove(name);
    }
    // cargo finds the compiler through PATH, where rustup's may stand first.
    command.env("PATH", path_with_front(&programs.to_string_lossy()));
    if root != Path::new(SYSTEM) {
        command.env("LD_LIBRARY_PATH", library_path(root));
    }
    command
}

/// A toolchain that is ready, else one that can be made so. Whatever is there already goes before any installation.
pub(crate) fn ensure(workspace: &Workspace) -> Result<Toolchain> {
    let choice = env::var(CHOICE).ok();
    let allowed = allowed(choice.as_deref())?;
    for way in allowed {
        let ready = match way {
            Way::Rustup => rustup_ready(workspace).map(|()| Toolchain::Rustup),
            Way::Debian => debian_ready(workspace, SYSTEM.into()),
        };
        if let Ok(toolchain) = ready {
            return Ok(toolchain);
        }
    }
    let mut reasons = Vec::new();
    for way in allowed {
        let installed = match way {
            Way::Rustup => install_rustup(workspace),
            Way::Debian => unpack_debian(workspace),
        };
        match installed {
            Ok(toolchain) => return Ok(toolchain),
            Err(error) => {
                println!("setup: {error:#}");
                reasons.push(format!("{error:#}"));
            }
        }
    }
    Err(anyhow!(reasons.join("\n  and: ")).context(ADVICE))
}

/// The ways that the variable leaves open, the preferred one first.
fn allowed(choice: Option<&str>) -> Result<&'static [Way]> {
    match choice {
        None | Some("") => Ok(&[Way::Rustup, Way::Debian]),
        Some("rustup") => Ok(&[Way::Rustup]),
        Some("debian") => Ok(&[Way::Debian]),
        Some(other) => bail!("{CHOICE} is `{other}`; it can be `rustup` or `debian`"),
    }
}

/// Whether the running toolchain has the core libraries of the targets.
fn rustup_ready(workspace: &Workspace) -> Result<()> {
    let rustc = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    for target in TARGETS {
        let mut command = workspace.command(&rustc);
        let printed = run::output(command.args(["--print", "target-libdir", "--target", target]))?;
        let folder = Path::new(printed.trim());
        let has_core = fs::read_dir(folder).is_ok_and(|entries| {
            entries.flatten().any(|entry| is_core_library(&entry.file_name().to_string_lossy()))
        });
        if !has_core {
            bail!("no core library in {}", folder.display());
        }
    }
    Ok(())
}

fn install_rustup(workspace: &Workspace) -> Result<Toolchain> {
    if run::find("rustup").is_none() {
        bail!("rustup is not installed");
    }
    println!("setup: adding the targets {} with rustup", TARGETS.join(", "));
    run::quiet(workspace.command("rustup").args(["target", "add"]).args(TARGETS), RUSTUP_LIMIT)
        .context("rustup cannot add the targets")?;
    rustup_ready(workspace).context("rustup added the target to another toolchain than the running one")?;
    Ok(Toolchain::Rustup)
}

/// Debian's compiler at this root, if it is there, new enough, with the library's source, the linter and the linker.
fn debian_ready(workspace: &Workspace, root: PathBuf) -> Result<Toolchain> {
    for program in DEBIAN_PROGRAMS {
        let path = root.join("usr/bin").join(program);
        if !path.exists() {
            bail!("there is no {}", path.display());
        }
    }
    let rustc = |argument: &[&str]| run::output(debian(workspace, &root, "rustc").args(argument));
    let printed = rustc(&["--version"])?;
    let found = version(&printed).with_context(|| format!("`{}` is no version", printed.trim()))?;
    let wanted = version(env!("CARGO_PKG_RUST_VERSION")).context("the manifest has no version of Rust")?;
    if found < wanted {
        bail!("Debian's compiler is {}.{}, too old for {}.{}", found.0, found.1, wanted.0, wanted.1);
    }
    let sysroot = PathBuf::from(rustc(&["--print", "sysroot"])?.trim());
    let source = sysroot.join("lib/rustlib/src/rust/library/core/Cargo.toml");
    if !source.exists() {
        bail!("there is no {}", source.display());
    }
    Ok(Toolchain::Debian(root))
}

fn unpack_debian(workspace: &Workspace) -> Result<Toolchain> {
    let toolbox = Toolbox::new(workspace);
    let root = packages::unpack(&toolbox, "rust", Source::System, &DEBIAN_PACKAGES)
        .context("Debian's toolchain cannot be unpacked")?;
    debian_ready(workspace, root).context("Debian's toolchain is unpacked but not usable")
}

/// `PATH` with a folder before all others.
fn path_with_front(folder: &str) -> String {
    match env::var("PATH") {
        Ok(path) if !path.is_empty() => format!("{folder}:{path}"),
        _ => folder.to_owned(),
    }
}

/// The variable that tells cargo the linker of a target.
fn linker_variable(target: &str) -> String {
    format!("CARGO_TARGET_{}_LINKER", target.to_uppercase().replace('-', "_"))
}

/// Whether a file is the compiled core library, as in `libcore-0123456789abcdef.rlib`.
fn is_core_library(file: &str) -> bool {
    file.starts_with("libcore-") && file.ends_with(".rlib")
}

/// Major and minor of `1.88`, of `1.88.0`, or of `rustc 1.88.0 (hash date)`.
fn version(text: &str) -> Option<(u32, u32)> {
    let number =
        text.split_whitespace().find(|word| word.starts_with(|first: char| first.is_ascii_digit()))?;
    let mut parts = number.split('.');
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_read_and_compared_as_numbers() {
        assert_eq!(
            version("rustc 1.96.0 (abcdef012 2026-01-01) (built from a source tarball)"),
            Some((1, 96))
        );
        assert_eq!(version("1.88"), Some((1, 88)));
        assert_eq!(version("rustc unknown"), None);
        assert!(version("1.100.0") > version("1.96.0"));
    }

    #[test]
    fn the_choice_is_one_of_two_or_open() {
        assert_eq!(allowed(None).unwrap(), [Way::Rustup, Way::Debian]);
        assert_eq!(allowed(Some("debian")).unwrap(), [Way::Debian]);
        assert!(allowed(Some("gcc")).is_err());
    }

    #[test]
    fn cargo_is_told_the_linker() {
        assert_eq!(linker_variable(TARGET), "CARGO_TARGET_THUMBV7EM_NONE_EABIHF_LINKER");
    }

    #[test]
    fn only_the_core_library_counts() {
        assert!(is_core_library("libcore-0123456789abcdef.rlib"));
        assert!(!is_core_library("libcompiler_builtins-0123456789abcdef.rlib"));
        assert!(!is_core_library("libcore-0123456789abcdef.rmeta"));
    }
}
