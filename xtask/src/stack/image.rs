//! The functions and the vector table of an image.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, Result, ensure};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object as _, ObjectSection as _, ObjectSymbol as _, SectionKind, SymbolKind};
use rustc_demangle::demangle;

use super::code::Code;

/// Entries of the vector table before the first interrupt, and those of two exceptions.
const SYSTEM_VECTORS: usize = 16;
pub(super) const RESET: usize = 1;
pub(super) const HARD_FAULT: usize = 3;
/// The functions of an image.
pub(super) struct Image<'data> {
    pub(super) functions: BTreeMap<u32, Function<'data>>,
    pub(super) vectors: Vec<u32>,
    /// Functions whose address is somewhere among data or in code.
    pub(super) pointed: BTreeSet<u32>,
}

pub(super) struct Function<'data> {
    pub(super) name: &'data str,
    pub(super) code: Code<'data>,
}

impl<'data> Image<'data> {
    pub(super) fn read(elf: &ElfFile32<'data, LittleEndian>, kinds: &'data [(u32, bool)]) -> Result<Self> {
        let mut starts = BTreeMap::new();
        for symbol in elf.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text) {
            let name = symbol.name()?;
            // the lowest bit of an address says that the code is Thumb; a name that starts with `$` marks its kind
            let start = u32::try_from(symbol.address())? & !1;
            let Some(index) = symbol.section_index().filter(|_| !name.starts_with('$')) else { continue };
            starts.entry(start).or_insert((name, u32::try_from(symbol.size())?, index));
        }
        let mut functions = BTreeMap::new();
        for (start, (name, size, index)) in &starts {
            let section = elf.section_by_index(*index)?;
            let offset = usize::try_from(u64::from(*start) - section.address())?;
            let next = starts.range(start + 1..).next().map_or(u32::MAX, |(next, _)| *next);
            let all = section.data()?.get(offset..).context("a function lies outside of its section")?;
            // some functions of assembly have no size
            let size = if *size == 0 { next - start } else { *size };
            let bytes = all.get(..size as usize).unwrap_or(all);
            functions.insert(*start, Function { name, code: Code { start: *start, bytes, kinds } });
        }
        let table = elf.section_by_name(".vector_table").context("there is no vector table")?.data()?;
        let vectors = words(table).collect();
        let mut image = Self { functions, vectors, pointed: BTreeSet::new() };
        for section in elf.sections() {
            let is_loaded = matches!(
                section.kind(),
                SectionKind::Text
                    | SectionKind::ReadOnlyData
                    | SectionKind::Data
                    | SectionKind::ReadOnlyString
            );
            if is_loaded && section.name()? != ".vector_table" {
                image.find_pointers(section.data()?);
            }
        }
        Ok(image)
    }

    /// Marks the functions whose address stands among these bytes, as a word or built by two instructions.
    pub(super) fn find_pointers(&mut self, bytes: &[u8]) {
        let functions = &self.functions;
        let mut found = |value: u32| {
            if value & 1 == 1 && functions.contains_key(&(value & !1)) {
                self.pointed.insert(value & !1);
            }
        };
        words(bytes).for_each(&mut found);
        // MOVW leaves the low half in a register, MOVT adds the high half
        let mut low = [0; 16];
        for start in (0..bytes.len().saturating_sub(3)).step_by(2) {
            let Some([a, b, c, d]) = bytes.get(start..).and_then(|rest| rest.first_chunk::<4>()) else {
                break;
            };
            let (first, second) = (u16::from_le_bytes([*a, *b]), u16::from_le_bytes([*c, *d]));
            let register = usize::from(second >> 8 & 0xF);
            let half = u32::from(first & 0xF) << 12
                | u32::from(first >> 10 & 1) << 11
                | u32::from(second >> 12 & 7) << 8
                | u32::from(second & 0xFF);
            match first & 0xFBF0 {
                0xF240 => low[register] = half,
                0xF2C0 => found(half << 16 | low[register]),
                _ => {}
            }
        }
    }

    pub(super) fn vector(&self, index: usize) -> Result<u32> {
        Ok(self.vectors.get(index).with_context(|| format!("there is no vector {index}"))? & !1)
    }

    /// The handlers of interrupts and of every exception but reset and hard fault, which never return.
    pub(super) fn handlers(&self) -> Result<BTreeSet<(u32, &str)>> {
        let mut handlers = BTreeSet::new();
        let others =
            self.vectors.iter().enumerate().skip(RESET + 1).filter(|(index, _)| *index != HARD_FAULT);
        for (_, vector) in others.filter(|(_, vector)| **vector != 0) {
            handlers.insert((vector & !1, self.function(vector & !1)?.name));
        }
        ensure!(self.vectors.len() > SYSTEM_VECTORS, "the vector table has no interrupts");
        Ok(handlers)
    }

    pub(super) fn function(&self, address: u32) -> Result<&Function<'data>> {
        self.functions.get(&address).with_context(|| format!("there is no function at {address:#x}"))
    }

    pub(super) fn name(&self, address: u32) -> String {
        self.functions
            .get(&address)
            .map_or_else(|| format!("{address:#x}"), |function| format!("{:#}", demangle(function.name)))
    }
}

/// Where code and where data begins: the mapping symbols of the ABI for the ARM architecture.
pub(super) fn kinds(elf: &ElfFile32<'_, LittleEndian>) -> Result<Vec<(u32, bool)>> {
    let mut kinds = Vec::new();
    for symbol in elf.symbols() {
        let is_code = match symbol.name()?.as_bytes() {
            [b'$', b't'] | [b'$', b't', b'.', ..] => true,
            [b'$', b'd'] | [b'$', b'd', b'.', ..] => false,
            _ => continue,
        };
        kinds.push((u32::try_from(symbol.address())? & !1, is_code));
    }
    kinds.sort_unstable();
    Ok(kinds)
}

fn words(bytes: &[u8]) -> impl Iterator<Item = u32> + '_ {
    bytes.as_chunks::<4>().0.iter().map(|word| u32::from_le_bytes(*word))
}
