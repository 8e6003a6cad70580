//! What takes the flash and the static RAM of an image: by symbol, and by crate.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use anyhow::{Context, Result};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object as _, ObjectSection as _, ObjectSymbol as _, SectionKind};
use rustc_demangle::demangle;

/// Lines of each list.
const SHOWN: usize = 15;

/// Bytes by name.
type Sizes = BTreeMap<String, u64>;

/// Four lists for people: symbols and crates in flash, then in RAM.
pub(crate) fn lines(file: &[u8]) -> Result<String> {
    let elf = ElfFile32::<LittleEndian>::parse(file).context("not an ELF file of a 32-bit part")?;
    let mut text = String::new();
    for (place, in_ram) in [("flash", false), ("static RAM", true)] {
        let symbols = symbols(&elf, in_ram)?;
        let mut crates = Sizes::new();
        for (name, size) in &symbols {
            *crates.entry(owner(name)).or_default() += size;
        }
        for (what, sizes) in [("symbols", symbols), ("crates", crates)] {
            writeln!(text, "{place}, {what}:")?;
            let mut sizes: Vec<_> = sizes.into_iter().collect();
            sizes.sort_by(|(a, x), (b, y)| y.cmp(x).then(a.cmp(b)));
            for (name, size) in sizes.iter().filter(|(_, size)| *size > 0).take(SHOWN) {
                writeln!(text, "{size:>8}  {name}")?;
            }
        }
    }
    Ok(text)
}

/// The symbols that lie in flash or in RAM, and what there is without a symbol.
fn symbols(elf: &ElfFile32<'_, LittleEndian>, in_ram: bool) -> Result<Sizes> {
    let mut sizes = Sizes::new();
    for section in elf.sections() {
        let is_here = match section.kind() {
            SectionKind::Text | SectionKind::ReadOnlyData | SectionKind::ReadOnlyString => !in_ram,
            // what has an initial value takes flash for that as well
            SectionKind::Data => true,
            SectionKind::UninitializedData => in_ram,
            _ => false,
        };
        if !is_here {
            continue;
        }
        let mut counted = BTreeMap::new();
        for symbol in
            elf.symbols().filter(|one| one.section_index() == Some(section.index()) && one.size() > 0)
        {
            // of several names for one place the longest is counted
            let place: &mut (u64, String) = counted.entry(symbol.address()).or_default();
            *place = (symbol.size(), format!("{:#}", demangle(symbol.name()?))).max(std::mem::take(place));
        }
        let named: u64 = counted.values().map(|(size, _)| size).sum();
        *sizes.entry(format!("(no name) in {}", section.name()?)).or_default() +=
            section.size().saturating_sub(named);
        for (size, name) in counted.into_values() {
            *sizes.entry(name).or_default() += size;
        }
    }
    Ok(sizes)
}

/// The crate that a symbol is from: of a method in a trait, the crate of the type.
fn owner(name: &str) -> String {
    let start = name.trim_start_matches(['<', '&', '(']).trim_start_matches("mut ");
    match start.split_once("::") {
        Some((first, _))
            if first.chars().all(|character| character.is_alphanumeric() || character == '_') =>
        {
            first.to_owned()
        }
        _ if name.starts_with('(') => name.to_owned(),
        _ => "(no crate)".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn symbols_belong_to_crates() {
        for (name, expected) in [
            ("heapless::spsc::Queue::new", "heapless"),
            ("<stm32f405::flash::Sectors as some::Flash>::erase", "stm32f405"),
            ("<&[u8] as sequential_storage::map::Value>::serialize_into", "(no crate)"),
            ("__aeabi_memcpy", "(no crate)"),
            ("(no name) in .rodata", "(no name) in .rodata"),
        ] {
            assert_eq!(owner(name), expected, "{name}");
        }
    }
}
