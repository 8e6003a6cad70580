//! What the instructions of the image are.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, Result};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object as _, ObjectSection as _, ObjectSymbol as _, SymbolKind};

/// Words of the vector table before the first handler that may return: stack pointer and reset.
const BEFORE_HANDLERS: usize = 2;

/// What an instruction does to the calls that have not returned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Calls a function.
    Call,
    /// Returns from one, or from an interrupt.
    Return,
    /// Anything else; a jump to another function leaves it to that one to return.
    Other,
}

/// The code of an image.
pub(crate) struct Code {
    start: u32,
    halves: Vec<u16>,
    /// Where each interrupt's handler begins, and what the interrupt is called.
    handlers: BTreeMap<u32, String>,
}

impl Code {
    /// Of an ELF file.
    pub(crate) fn of(file: &[u8]) -> Result<Self> {
        let elf = ElfFile32::<LittleEndian>::parse(file).context("not an ELF file of a 32-bit part")?;
        let vectors = elf.section_by_name(".vector_table").context("there is no vector table")?.data()?;
        let vectors: BTreeSet<u32> = vectors
            .as_chunks::<4>()
            .0
            .iter()
            .skip(BEFORE_HANDLERS)
            .map(|word| u32::from_le_bytes(*word))
            .collect();
        let functions = elf.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.size() > 0);
        let handlers = functions
            .filter(|symbol| vectors.contains(&(symbol.address() as u32)))
            .map(|symbol| Ok((symbol.address() as u32 & !1, symbol.name()?.to_owned())))
            .collect::<Result<_>>()?;
        let text = elf.section_by_name(".text").context("there is no code")?;
        let halves = text.data()?.as_chunks::<2>().0.iter().map(|half| u16::from_le_bytes(*half)).collect();
        Ok(Self { start: text.address() as u32, halves, handlers })
    }

    /// Of these halfwords from an address on, with a handler for each interrupt.
    #[cfg(test)]
    pub(crate) fn made_of(start: u32, halves: &[u16], handlers: &[(u32, &str)]) -> Self {
        let handlers = handlers.iter().map(|(address, name)| (*address, (*name).to_owned())).collect();
        Self { start, halves: halves.to_vec(), handlers }
    }

    /// The name of the interrupt whose handler begins there.
    pub(crate) fn handler(&self, address: u32) -> Option<&str> {
        self.handlers.get(&address).map(String::as_str)
    }

    /// Whether the instruction there puts the processor to sleep.
    pub(crate) fn is_sleep(&self, address: u32) -> bool {
        const WFI: u16 = 0xBF30;
        self.halves_at(address).0 == WFI
    }

    /// The instruction's kind, and its length in bytes (ARM DDI 0403E, A5 and A7).
    pub(crate) fn kind(&self, address: u32) -> (Kind, u32) {
        let (first, second) = self.halves_at(address);
        match first {
            // bl
            0xF000..=0xF7FF if second & 0xD000 == 0xD000 => (Kind::Call, 4),
            // ldm sp!, {..., pc}; ldr pc, [sp], #4
            0xE8BD if second & 0x8000 != 0 => (Kind::Return, 4),
            0xF85D if second == 0xFB04 => (Kind::Return, 4),
            // blx
            _ if first & 0xFF87 == 0x4780 => (Kind::Call, 2),
            // bx lr; pop {..., pc}
            _ if first == 0x4770 || first & 0xFF00 == 0xBD00 => (Kind::Return, 2),
            _ => (Kind::Other, if first >= 0xE800 { 4 } else { 2 }),
        }
    }

    /// Whether the instruction there may depend on a condition: `it` stands up to three instructions before it.
    pub(crate) fn is_conditional(&self, address: u32) -> bool {
        let is_it = |half: u16| half & 0xFF00 == 0xBF00 && half & 0x000F != 0;
        (1..=7).any(|back| is_it(self.halves_at(address.wrapping_sub(2 * back)).0))
    }

    fn halves_at(&self, address: u32) -> (u16, u16) {
        let index = address.wrapping_sub(self.start) as usize / 2;
        let half = |index| self.halves.get(index).copied().unwrap_or(0);
        (half(index), half(index.wrapping_add(1)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_condition_stands_before_what_depends_on_it() {
        let halves = [0xBF00, 0xBF08, 0x4770, 0xBF00, 0xBF00, 0xBF00, 0xBF00, 0xBF00, 0xBF00, 0x4770];
        let code = Code::made_of(0x1000, &halves, &[]);
        assert!(code.is_conditional(0x1004), "it eq; bxeq lr");
        assert!(!code.is_conditional(0x1002) && !code.is_conditional(0x1012));
    }

    #[test]
    fn calls_and_returns_are_known_by_their_bits() {
        for (halves, expected) in [
            ([0xF000, 0xF800], (Kind::Call, 4)),   // bl
            ([0x4798, 0xBF00], (Kind::Call, 2)),   // blx r3
            ([0x4770, 0xBF00], (Kind::Return, 2)), // bx lr
            ([0xBD80, 0xBF00], (Kind::Return, 2)), // pop {r7, pc}
            ([0xE8BD, 0x8FF0], (Kind::Return, 4)), // pop.w {r4-r11, pc}
            ([0xF85D, 0xFB04], (Kind::Return, 4)), // ldr pc, [sp], #4
            ([0xBC80, 0xBF00], (Kind::Other, 2)),  // pop {r7}
            ([0xF000, 0xB800], (Kind::Other, 4)),  // b.w
            ([0xE8BD, 0x0FF0], (Kind::Other, 4)),  // pop.w {r4-r11}
            ([0x4718, 0xBF00], (Kind::Other, 2)),  // bx r3
        ] {
            assert_eq!(Code::made_of(0x1000, &halves, &[]).kind(0x1000), expected, "{halves:04x?}");
        }
    }
}
