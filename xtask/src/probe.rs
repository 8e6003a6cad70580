//! The image of `checks/probe/`: it links only while nothing in the protocol crate can panic.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use object::read::elf::ElfFile32;
use object::{Object as _, ObjectSection as _, ObjectSymbol as _, RelocationTarget, SymbolKind};
use rustc_demangle::demangle;

use crate::run;
use crate::setup::{self, TARGETS, Toolchain};
use crate::workspace::Workspace;

/// The package, and the feature without which it is empty.
const PACKAGE: &str = "jointbus-probe";
const FEATURE: &str = "target";

/// The image that must link, the feature with which it must not, and the symbol that is missing then.
const IMAGE: &str = "panic-free";
const SABOTAGE: &str = "sabotage";
const MISSING: &str = "jointbus_a_panic_survives";

/// Both ends of the optimiser: `s` and 3.
const PROFILES: [&str; 2] = ["firmware", "firmware-fast"];

/// One small package and what it stands on, with link-time optimisation.
const BUILD_LIMIT: Duration = Duration::from_secs(600);

/// Proves that no public function of the protocol crate can panic, and that the proof would notice.
pub(crate) fn panic_free(workspace: &Workspace) -> Result<()> {
    let toolchain = setup::toolchain(workspace)?;
    every_function_is_probed(workspace)?;
    for target in TARGETS {
        for profile in PROFILES {
            proof(workspace, &toolchain, target, profile)?;
        }
    }
    Ok(())
}

/// The image links for this target; with a deliberate panic it does not.
fn proof(workspace: &Workspace, toolchain: &Toolchain, target: &str, profile: &str) -> Result<()> {
    println!("{IMAGE} for {target}, profile {profile}: links");
    let mut command = image(workspace, toolchain, "build", target, profile, FEATURE);
    if let Err(error) = run::quiet(&mut command, BUILD_LIMIT) {
        ensure!(error.to_string().contains(MISSING), "{error:#}");
        bail!("a panic survives profile {profile}:\n{}", callers(workspace, toolchain, target, profile)?);
    }
    let features = format!("{FEATURE},{SABOTAGE}");
    println!("{IMAGE} for {target}, profile {profile}, with a deliberate panic: does not link");
    match run::quiet(&mut image(workspace, toolchain, "build", target, profile, &features), BUILD_LIMIT) {
        Err(error) if error.to_string().contains(MISSING) => Ok(()),
        Err(error) => Err(error.context("it failed, but not for the panic")),
        Ok(()) => bail!("an image with a panic in it links with profile {profile}: the proof is void"),
    }
}

/// The linter over the probes.
pub(crate) fn clippy(workspace: &Workspace) -> Result<()> {
    let toolchain = setup::toolchain(workspace)?;
    let mut command = toolchain.cargo(workspace, "clippy");
    command.args(["--profile", PROFILES[0], "--package", PACKAGE, "--features", FEATURE]);
    run::shown(command.args(["--", "-D", "warnings"]))
}

/// A cargo command on the image.
fn image(
    workspace: &Workspace,
    toolchain: &Toolchain,
    subcommand: &str,
    target: &str,
    profile: &str,
    features: &str,
) -> Command {
    let mut command = toolchain.cargo_for(workspace, subcommand, target);
    command.args(["--profile", profile, "--package", PACKAGE, "--bin", IMAGE, "--features", features]);
    command
}

/// Who calls what can panic: the image is linked all the same, with its relocations kept.
fn callers(workspace: &Workspace, toolchain: &Toolchain, target: &str, profile: &str) -> Result<String> {
    let mut command = image(workspace, toolchain, "rustc", target, profile, FEATURE);
    let arguments = ["-C", "link-arg=--unresolved-symbols=ignore-all", "-C", "link-arg=--emit-relocs"];
    run::quiet(command.arg("--").args(arguments), BUILD_LIMIT)?;
    let path = workspace.target.join(target).join(profile).join(IMAGE);
    let file = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let calls = calls(&file)?;
    ensure!(!calls.is_empty(), "the callers cannot be told; the image is {}", path.display());
    Ok(calls.into_iter().collect::<Vec<_>>().join("\n"))
}

/// `caller -> callee` for every call of a panicking function by another one.
fn calls(file: &[u8]) -> Result<BTreeSet<String>> {
    let elf = ElfFile32::<object::LittleEndian>::parse(file).context("not an ELF file of a 32-bit part")?;
    let functions: Vec<_> =
        elf.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.size() > 0).collect();
    // The lowest bit of an address says that the code is Thumb.
    let containing = |place: u64| {
        functions.iter().find(|symbol| {
            let start = symbol.address() & !1;
            (start..start + symbol.size()).contains(&place)
        })
    };
    let mut calls = BTreeSet::new();
    for (place, relocation) in elf.sections().flat_map(|section| section.relocations()) {
        let RelocationTarget::Symbol(index) = relocation.target() else { continue };
        let callee = elf.symbol_by_index(index)?;
        let (Ok(callee), Some(caller)) = (callee.name(), containing(place)) else { continue };
        let caller = caller.name()?;
        if panics(callee) && !panics(caller) {
            calls.insert(format!("  {:#} -> {:#}", demangle(caller), demangle(callee)));
        }
    }
    Ok(calls)
}

/// Whether a function of the core library does nothing but panic.
fn panics(mangled: &str) -> bool {
    ["panicking", "_fail", "rust_begin_unwind", MISSING].iter().any(|part| mangled.contains(part))
}

/// Every public function of the protocol crate is at least named in the probe: one that is added is not forgotten.
fn every_function_is_probed(workspace: &Workspace) -> Result<()> {
    let mut probe = String::new();
    each_source(&workspace.root.join("checks/probe/src"), &mut |text| probe.push_str(text))?;
    let mut functions = BTreeSet::new();
    each_source(&workspace.root.join("protocol").join("src"), &mut |text| functions.extend(public(text)))?;
    let words: BTreeSet<_> = words(&probe).collect();
    let missing: Vec<_> = functions.iter().map(String::as_str).filter(|name| !words.contains(name)).collect();
    ensure!(
        missing.is_empty(),
        "checks/probe/ never calls these functions of protocol/: {}",
        missing.join(", ")
    );
    Ok(())
}

/// Hands every source file below `folder` to `user`.
fn each_source(folder: &Path, user: &mut dyn FnMut(&str)) -> Result<()> {
    let entries = fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    for entry in entries {
        let path = entry?.path();
        if path.is_dir() {
            each_source(&path, user)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            user(&fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?);
        }
    }
    Ok(())
}

/// The names of public functions; the tests at the end of a file have none.
fn public(source: &str) -> impl Iterator<Item = String> {
    let product = source.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
    product.lines().filter_map(|line| {
        let rest = line.trim_start().strip_prefix("pub ")?;
        let name = rest.strip_prefix("const ").unwrap_or(rest).strip_prefix("fn ")?;
        words(name).next().map(str::to_owned)
    })
}

fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|character: char| !character.is_alphanumeric() && character != '_')
        .filter(|word| !word.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn public_functions_are_found() {
        let source = "pub const fn one() {}\n    pub fn two<'b>(\nfn three() {}\npub(crate) fn four() {}\n\
                      #[cfg(test)]\nmod tests {\n pub fn five() {}\n";
        assert_eq!(public(source).collect::<Vec<_>>(), ["one", "two"]);
    }

    #[test]
    fn the_probe_names_every_function() {
        every_function_is_probed(&Workspace::locate().unwrap()).unwrap();
    }
}
