//! The worst-case stack of an image, worked out from its machine code: no run has to meet the worst case to see it.
//!
//! [`code`] tells of each function how deep it goes and whom it calls. The worst case is the deepest chain of calls
//! from the reset on, and on top of it one exception frame and the deepest handler of every interrupt priority. A call
//! through a pointer counts as the deepest function whose address is anywhere in the image. Recursion is an error.

mod code;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use anyhow::{Context, Result, bail, ensure};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object as _, ObjectSection as _, ObjectSymbol as _, SectionKind, SymbolKind};
use rustc_demangle::demangle;

use self::code::{Callee, Code, Summary};

/// What the processor pushes for an exception: eight registers, with the floating-point unit's 26, and a word where
/// the stack has to be aligned (ARMv7-M reference manual, B1.5.6 and B1.5.7).
const EXCEPTION: u32 = 8 * 4 + 4;
const EXCEPTION_FLOAT: u32 = 26 * 4 + 4;

/// Entries of the vector table before the first interrupt, and those of two exceptions.
const SYSTEM_VECTORS: usize = 16;
const RESET: usize = 1;
const HARD_FAULT: usize = 3;

/// The worst case.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Worst {
    /// In bytes.
    pub(crate) bytes: u32,
    levels: Vec<Level>,
    /// Functions that call through a pointer.
    indirect: BTreeSet<String>,
    /// The deepest function that such a call may reach.
    reached: Option<(String, u32)>,
}

/// What runs at one priority.
#[derive(Debug, PartialEq, Eq)]
struct Level {
    /// 0 for what no interrupt started.
    priority: u8,
    /// Pushed by the processor on the way in.
    exception: u32,
    bytes: u32,
    /// The deepest chain of calls: each function, and how deep it is where it calls the next.
    chain: Vec<(String, u32)>,
}

/// Works it out for an image whose interrupts have these priorities.
pub(crate) fn worst(file: &[u8], priorities: &BTreeMap<String, u8>) -> Result<Worst> {
    let elf = ElfFile32::<LittleEndian>::parse(file).context("not an ELF file of a 32-bit part")?;
    let kinds = kinds(&elf)?;
    let image = Image::read(&elf, &kinds)?;
    let mut walk = Walk { image: &image, done: BTreeMap::new(), under_way: Vec::new(), pointed: None };
    let entry = image.vector(RESET)?;
    let mut handlers = BTreeMap::<u8, Vec<u32>>::new();
    for (address, name) in image.handlers()? {
        let priority =
            priorities.get(name).with_context(|| format!("the priority of {name} is not known"))?;
        handlers.entry(*priority).or_default().push(address);
    }
    let mut levels = vec![Level { priority: 0, exception: 0, ..walk.level(&[entry])? }];
    let mut float = walk.uses_float(entry)?;
    for (priority, addresses) in handlers {
        let exception = if float { EXCEPTION_FLOAT } else { EXCEPTION };
        levels.push(Level { priority, exception, ..walk.level(&addresses)? });
        for address in addresses {
            float |= walk.uses_float(address)?;
        }
    }
    // a fault may come on top of all, but starts a stack of its own; its code has to be one that can be followed
    image.function(image.vector(HARD_FAULT)?)?;
    let bytes = levels.iter().map(|level| level.exception + level.bytes).sum();
    let reached = walk.pointed.map(|(address, bytes)| (image.name(address), bytes));
    let indirect =
        walk.done.iter().filter(|(_, done)| done.indirect).map(|(at, _)| image.name(*at)).collect();
    Ok(Worst { bytes, levels, indirect, reached })
}

impl Worst {
    /// Some lines for people.
    pub(crate) fn lines(&self) -> String {
        let mut text = String::new();
        let mut line = |words: String| writeln!(text, "{words}").expect("a string takes everything");
        for level in &self.levels {
            let what = match level.priority {
                0 => "from the reset on".into(),
                priority => format!(
                    "interrupt of priority {priority}, {} of it pushed by the processor",
                    level.exception
                ),
            };
            line(format!("{:>6}  {what}", level.exception + level.bytes));
            for (name, depth) in &level.chain {
                line(format!("{depth:>14}  {name}"));
            }
        }
        if let Some((name, bytes)) = &self.reached {
            let callers: Vec<_> = self.indirect.iter().map(String::as_str).collect();
            line(format!(
                "calls through a pointer are counted with {bytes}, for {name}; they are in {}",
                callers.join(", ")
            ));
        }
        text
    }
}

/// The functions of an image.
struct Image<'data> {
    functions: BTreeMap<u32, Function<'data>>,
    vectors: Vec<u32>,
    /// Functions whose address is somewhere among data or in code.
    pointed: BTreeSet<u32>,
}

struct Function<'data> {
    name: &'data str,
    code: Code<'data>,
}

impl<'data> Image<'data> {
    fn read(elf: &ElfFile32<'data, LittleEndian>, kinds: &'data [(u32, bool)]) -> Result<Self> {
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
    fn find_pointers(&mut self, bytes: &[u8]) {
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

    fn vector(&self, index: usize) -> Result<u32> {
        Ok(self.vectors.get(index).with_context(|| format!("there is no vector {index}"))? & !1)
    }

    /// The handlers of interrupts and of every exception but reset and hard fault, without the one that stands where
    /// there is none.
    fn handlers(&self) -> Result<BTreeSet<(u32, &str)>> {
        let mut handlers = BTreeSet::new();
        let others =
            self.vectors.iter().enumerate().skip(RESET + 1).filter(|(index, _)| *index != HARD_FAULT);
        for (_, vector) in others.filter(|(_, vector)| **vector != 0) {
            let function = self.function(vector & !1)?;
            if !function.name.starts_with("DefaultHandler") {
                handlers.insert((vector & !1, function.name));
            }
        }
        ensure!(self.vectors.len() > SYSTEM_VECTORS, "the vector table has no interrupts");
        Ok(handlers)
    }

    fn function(&self, address: u32) -> Result<&Function<'data>> {
        self.functions.get(&address).with_context(|| format!("there is no function at {address:#x}"))
    }

    fn name(&self, address: u32) -> String {
        self.functions
            .get(&address)
            .map_or_else(|| format!("{address:#x}"), |function| format!("{:#}", demangle(function.name)))
    }
}

/// Where code and where data begins: the mapping symbols of the ABI for the ARM architecture.
fn kinds(elf: &ElfFile32<'_, LittleEndian>) -> Result<Vec<(u32, bool)>> {
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

/// The call graph, as far as it has been walked.
struct Walk<'image, 'data> {
    image: &'image Image<'data>,
    done: BTreeMap<u32, Done>,
    under_way: Vec<u32>,
    /// The deepest function that a pointer may lead to.
    pointed: Option<(u32, u32)>,
}

/// A function and everything below it.
#[derive(Clone, Copy)]
struct Done {
    bytes: u32,
    /// The call that makes it so deep, and how deep the function itself is there.
    deepest: Option<(u32, u32)>,
    float: bool,
    /// It calls through a pointer itself.
    indirect: bool,
}

impl Walk<'_, '_> {
    fn level(&mut self, entries: &[u32]) -> Result<Level> {
        let mut worst = Level { priority: 0, exception: 0, bytes: 0, chain: Vec::new() };
        for entry in entries {
            let bytes = self.visit(*entry)?.bytes;
            if bytes >= worst.bytes {
                worst = Level { bytes, chain: self.chain(*entry)?, ..worst };
            }
        }
        Ok(worst)
    }

    fn uses_float(&mut self, address: u32) -> Result<bool> {
        Ok(self.visit(address)?.float)
    }

    fn chain(&mut self, entry: u32) -> Result<Vec<(String, u32)>> {
        let mut chain = Vec::new();
        let mut next = Some(entry);
        while let Some(address) = next {
            let done = self.visit(address)?;
            let depth = done.deepest.map_or(done.bytes, |(_, depth)| depth);
            chain.push((self.image.name(address), depth));
            next = done.deepest.map(|(callee, _)| callee);
        }
        Ok(chain)
    }

    fn visit(&mut self, address: u32) -> Result<Done> {
        if let Some(done) = self.done.get(&address) {
            return Ok(*done);
        }
        if let Some(start) = self.under_way.iter().position(|one| *one == address) {
            let names: Vec<_> = self.under_way.iter().skip(start).map(|one| self.image.name(*one)).collect();
            bail!("recursion has no worst case: {}", names.join(" -> "));
        }
        self.under_way.push(address);
        let function = self.image.function(address)?;
        let Summary { frame, calls, float } =
            code::summary(function.code).with_context(|| format!("{:#}", demangle(function.name)))?;
        let mut done = Done { bytes: frame, deepest: None, float, indirect: false };
        for (callee, depth) in calls {
            let targets = match callee {
                Callee::At(target) => vec![target],
                Callee::Unknown => {
                    done.indirect = true;
                    self.image.pointed.iter().copied().collect()
                }
            };
            ensure!(!targets.is_empty(), "a pointer leads nowhere in {:#}", demangle(function.name));
            for target in targets {
                let below = self.visit(target)?;
                done.float |= below.float;
                if callee == Callee::Unknown && self.pointed.is_none_or(|(_, bytes)| bytes < below.bytes) {
                    self.pointed = Some((target, below.bytes));
                }
                if depth + below.bytes > done.bytes {
                    done.bytes = depth + below.bytes;
                    done.deepest = Some((target, depth));
                }
            }
        }
        self.under_way.pop();
        self.done.insert(address, done);
        Ok(done)
    }
}

/// The priorities that a program written with RTIC gives its interrupts: `#[task(binds = NAME, priority = N`.
pub(crate) fn priorities(source: &str) -> Result<BTreeMap<String, u8>> {
    let mut priorities = BTreeMap::new();
    for task in source.split("#[task(").skip(1) {
        let arguments = task.split_once(']').map_or(task, |(arguments, _)| arguments);
        let value = |name: &str| {
            let rest = arguments.split_once(name)?.1.trim_start().strip_prefix('=')?.trim_start();
            rest.split(|character: char| !character.is_alphanumeric() && character != '_').next()
        };
        let name = value("binds").with_context(|| format!("a task without an interrupt: {arguments}"))?;
        // what names none has the lowest
        let priority = value("priority").map_or(Ok(1), str::parse)?;
        priorities.insert(name.to_owned(), priority);
    }
    Ok(priorities)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn priorities_are_read_from_the_tasks() {
        let source = "#[task(binds = SysTick, priority = 4)]\nfn a() {}\n#[task(binds=USART1, shared = [x])]";
        let expected = BTreeMap::from([("SysTick".to_owned(), 4), ("USART1".to_owned(), 1)]);
        assert_eq!(priorities(source).unwrap(), expected);
        assert!(priorities("#[task(priority = 1)]").is_err());
    }

    /// A small image: functions of half-words at 0x100, 0x200 and so on.
    fn image<'data>(functions: &[(u32, &'static str, &'data [u8])]) -> Image<'data> {
        let functions = functions
            .iter()
            .map(|(start, name, bytes)| {
                (*start, Function { name, code: Code { start: *start, bytes, kinds: &[] } })
            })
            .collect();
        Image { functions, vectors: Vec::new(), pointed: BTreeSet::new() }
    }

    fn walk<'image, 'data>(image: &'image Image<'data>) -> Walk<'image, 'data> {
        Walk { image, done: BTreeMap::new(), under_way: Vec::new(), pointed: None }
    }

    // push {r4, lr}; bl 0x200; pop {r4, pc}
    const CALLS_0X200: [u8; 8] = [0x10, 0xB5, 0x00, 0xF0, 0x7D, 0xF8, 0x10, 0xBD];
    // sub sp, #16; add sp, #16; bx lr
    const LEAF: [u8; 6] = [0x84, 0xB0, 0x04, 0xB0, 0x70, 0x47];

    #[test]
    fn a_chain_of_calls_adds_up() {
        let image = image(&[(0x100, "caller", &CALLS_0X200), (0x200, "leaf", &LEAF)]);
        let level = walk(&image).level(&[0x100]).unwrap();
        assert_eq!(level.bytes, 24);
        assert_eq!(level.chain, [("caller".to_owned(), 8), ("leaf".to_owned(), 16)]);
    }

    #[test]
    fn a_call_through_a_pointer_counts_as_the_deepest_that_it_may_reach() {
        // push {r4, lr}; blx r3; pop {r4, pc}
        let caller = [0x10, 0xB5, 0x98, 0x47, 0x10, 0xBD];
        let mut image = image(&[(0x100, "caller", &caller), (0x200, "leaf", &LEAF)]);
        assert!(walk(&image).visit(0x100).is_err(), "there is none");
        image.find_pointers(&[0x01, 0x02, 0, 0]);
        assert_eq!(walk(&image).visit(0x100).unwrap().bytes, 24);
        image.pointed.clear();
        // movw r3, #0x201; movt r3, #0
        image.find_pointers(&[0x40, 0xF2, 0x01, 0x23, 0xC0, 0xF2, 0x00, 0x03]);
        assert_eq!(walk(&image).visit(0x100).unwrap().bytes, 24);
    }

    #[test]
    fn recursion_is_refused() {
        // push {r4, lr}; bl 0x200
        let image = image(&[(0x200, "endless", &[0x10, 0xB5, 0xFF, 0xF7, 0xFD, 0xFF])]);
        let error = walk(&image).visit(0x200).err().unwrap().to_string();
        assert!(error.contains("endless"), "{error}");
    }
}
