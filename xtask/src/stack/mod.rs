//! The worst-case stack of an image, worked out from its machine code: no run has to meet the worst case to see it.
//!
//! [`code`] tells of each function how deep it goes and whom it calls. The worst case is the deepest chain of calls
//! from the reset on while interrupts are open, and on top of it one exception frame and the deepest handler of every
//! interrupt priority; or the deepest chain while they are masked, if that is deeper. A call through a pointer counts as
//! the deepest function whose address is anywhere in the image. Recursion is an error.

mod code;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use anyhow::{Context, Result, bail, ensure};
use object::read::elf::ElfFile32;
use object::{LittleEndian, Object as _, ObjectSection as _, ObjectSymbol as _, SectionKind, SymbolKind};
use rustc_demangle::demangle;

use self::code::{Callee, Code, Interrupts, Summary};

/// What the processor pushes for an exception: eight registers, and a word where the stack has to be aligned (ARMv7-M
/// reference manual, B1.5.6 and B1.5.7). The firmware has it keep no floating-point registers, which a test of the image
/// sees; here no handler may therefore touch them.
const EXCEPTION: u32 = 8 * 4 + 4;

/// What stands in the vector table where there is no handler.
const NO_HANDLER: &str = "DefaultHandler";

/// Entries of the vector table before the first interrupt, and those of two exceptions.
const SYSTEM_VECTORS: usize = 16;
const RESET: usize = 1;
const HARD_FAULT: usize = 3;

/// The worst case.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Worst {
    /// In bytes.
    pub(crate) bytes: u32,
    /// From the reset on with interrupts open, then each priority.
    levels: Vec<Level>,
    /// From the reset on with interrupts masked.
    masked: Level,
    /// Functions that call through a pointer.
    indirect: BTreeSet<String>,
    /// The deepest function that such a call may reach.
    reached: Option<(String, u32)>,
}

/// What runs at one priority.
#[derive(Debug, Default, PartialEq, Eq)]
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
    let mut walk = Walk::new(&image);
    let reset = image.vector(RESET)?;
    let mut handlers = BTreeMap::<u8, Vec<u32>>::new();
    for (address, name) in image.handlers()? {
        walk.check_float(address)?;
        if name.starts_with(NO_HANDLER) {
            continue;
        }
        let priority =
            priorities.get(name).with_context(|| format!("the priority of {name} is not known"))?;
        handlers.entry(*priority).or_default().push(address);
    }
    let mut levels = vec![walk.level(reset, &[Interrupts::Open])?];
    for (priority, addresses) in handlers {
        let mut worst = Level::default();
        for address in addresses {
            let level = walk.level(address, &[Interrupts::Open, Interrupts::Masked])?;
            worst = if level.bytes >= worst.bytes { level } else { worst };
        }
        levels.push(Level { priority, exception: EXCEPTION, ..worst });
    }
    let masked = walk.level(reset, &[Interrupts::Masked])?;
    // a fault may come on top of all, but starts a stack of its own; its code has to be one that can be followed
    image.function(image.vector(HARD_FAULT)?)?;
    let open: u32 = levels.iter().map(|level| level.exception + level.bytes).sum();
    let reached = walk.pointed.map(|(address, bytes)| (image.name(address), bytes));
    let indirect =
        walk.done.iter().filter(|(_, done)| done.indirect).map(|((at, _), _)| image.name(*at)).collect();
    Ok(Worst { bytes: open.max(masked.bytes), levels, masked, indirect, reached })
}

impl Worst {
    /// Some lines for people.
    pub(crate) fn lines(&self) -> String {
        let mut text = String::new();
        let mut line = |words: String| writeln!(text, "{words}").expect("a string takes everything");
        let mut show = |level: &Level, what: String| {
            line(format!("{:>6}  {what}", level.exception + level.bytes));
            for (name, depth) in &level.chain {
                line(format!("{depth:>14}  {name}"));
            }
        };
        show(&self.masked, "from the reset on with interrupts masked, alone".into());
        for level in &self.levels {
            let what = match level.priority {
                0 => "from the reset on with interrupts open, and on top of it".into(),
                priority => {
                    format!(
                        "interrupt of priority {priority}, {} of it pushed by the processor",
                        level.exception
                    )
                }
            };
            show(level, what);
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

    /// The handlers of interrupts and of every exception but reset and hard fault, which never return.
    fn handlers(&self) -> Result<BTreeSet<(u32, &str)>> {
        let mut handlers = BTreeSet::new();
        let others =
            self.vectors.iter().enumerate().skip(RESET + 1).filter(|(index, _)| *index != HARD_FAULT);
        for (_, vector) in others.filter(|(_, vector)| **vector != 0) {
            handlers.insert((vector & !1, self.function(vector & !1)?.name));
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
    done: BTreeMap<(u32, Interrupts), Done>,
    /// Functions that may end the masking of interrupts, by themselves or by what they call.
    unmasking: BTreeMap<u32, bool>,
    under_way: Vec<u32>,
    /// The deepest function that a pointer may lead to.
    pointed: Option<(u32, u32)>,
}

/// A function that is entered with interrupts open or masked, and everything below it.
#[derive(Clone, Copy)]
struct Done {
    open: Option<Deepest>,
    masked: Option<Deepest>,
    /// The function that uses the floating-point unit.
    float: Option<u32>,
    /// It calls through a pointer itself.
    indirect: bool,
}

/// How deep it goes.
#[derive(Clone, Copy)]
struct Deepest {
    bytes: u32,
    /// The call that makes it so deep, and how deep the function itself is there.
    call: Option<(u32, Interrupts, u32)>,
}

impl Done {
    fn deepest(&mut self, interrupts: Interrupts) -> &mut Option<Deepest> {
        match interrupts {
            Interrupts::Open => &mut self.open,
            Interrupts::Masked => &mut self.masked,
        }
    }
}

impl<'image, 'data> Walk<'image, 'data> {
    fn new(image: &'image Image<'data>) -> Self {
        let (done, unmasking) = (BTreeMap::new(), BTreeMap::new());
        Self { image, done, unmasking, under_way: Vec::new(), pointed: None }
    }

    /// The deepest chain from an entry on that ends with interrupts in one of these states.
    fn level(&mut self, entry: u32, states: &[Interrupts]) -> Result<Level> {
        let mut worst = Level::default();
        for state in states {
            if let Some(Deepest { bytes, .. }) = *self.visit(entry, Interrupts::Open)?.deepest(*state)
                && bytes >= worst.bytes
            {
                worst = Level { bytes, chain: self.chain(entry, *state)?, ..worst };
            }
        }
        Ok(worst)
    }

    fn chain(&mut self, entry: u32, state: Interrupts) -> Result<Vec<(String, u32)>> {
        let mut chain = Vec::new();
        let mut next = Some((entry, Interrupts::Open));
        while let Some((address, entered)) = next {
            let deepest = *self.visit(address, entered)?.deepest(state);
            let Deepest { bytes, call } = deepest.context("a chain that leads nowhere")?;
            chain.push((self.image.name(address), call.map_or(bytes, |(_, _, depth)| depth)));
            next = call.map(|(callee, entered, _)| (callee, entered));
        }
        Ok(chain)
    }

    /// Nothing from a handler on may use the floating-point unit.
    fn check_float(&mut self, handler: u32) -> Result<()> {
        if let Some(float) = self.visit(handler, Interrupts::Open)?.float {
            let (handler, float) = (self.image.name(handler), self.image.name(float));
            bail!(
                "{handler} uses floating-point registers, which are not kept for what it interrupts: in {float}"
            );
        }
        Ok(())
    }

    fn targets(&self, callee: Callee) -> Vec<u32> {
        match callee {
            Callee::At(target) => vec![target],
            Callee::Unknown => self.image.pointed.iter().copied().collect(),
        }
    }

    fn summary(&mut self, address: u32, entry: Interrupts) -> Result<Summary> {
        let function = self.image.function(address)?;
        let unmasks = |callee| {
            let targets = self.targets(callee);
            targets.into_iter().try_fold(false, |any, target| Ok(any | self.unmasks(target)?))
        };
        code::summary(function.code, entry, unmasks).with_context(|| format!("{:#}", demangle(function.name)))
    }

    /// Whether a function may end the masking of interrupts, by itself or by what it calls.
    fn unmasks(&mut self, address: u32) -> Result<bool> {
        if let Some(known) = self.unmasking.get(&address) {
            return Ok(*known);
        }
        // recursion ends here, and is refused when the function is visited
        self.unmasking.insert(address, false);
        let Summary { mut unmasks, calls, .. } = self.summary(address, Interrupts::Open)?;
        for (callee, ..) in calls {
            for target in self.targets(callee) {
                unmasks |= self.unmasks(target)?;
            }
        }
        self.unmasking.insert(address, unmasks);
        Ok(unmasks)
    }

    fn visit(&mut self, address: u32, entry: Interrupts) -> Result<Done> {
        if let Some(done) = self.done.get(&(address, entry)) {
            return Ok(*done);
        }
        if let Some(start) = self.under_way.iter().position(|one| *one == address) {
            let names: Vec<_> = self.under_way.iter().skip(start).map(|one| self.image.name(*one)).collect();
            bail!("recursion has no worst case: {}", names.join(" -> "));
        }
        self.under_way.push(address);
        let Summary { open, masked, calls, float, .. } = self.summary(address, entry)?;
        let by_itself = |frame: Option<u32>| frame.map(|bytes| Deepest { bytes, call: None });
        let mut done = Done {
            open: by_itself(open),
            masked: by_itself(masked),
            float: float.then_some(address),
            indirect: false,
        };
        for (callee, depth, entered) in calls {
            let targets = self.targets(callee);
            done.indirect |= callee == Callee::Unknown;
            ensure!(!targets.is_empty(), "a pointer leads nowhere in {}", self.image.name(address));
            for target in targets {
                let mut below = self.visit(target, entered)?;
                done.float = done.float.or(below.float);
                for state in [Interrupts::Open, Interrupts::Masked] {
                    let Some(Deepest { bytes, .. }) = *below.deepest(state) else { continue };
                    if callee == Callee::Unknown && self.pointed.is_none_or(|(_, most)| most < bytes) {
                        self.pointed = Some((target, bytes));
                    }
                    let deepest = done.deepest(state);
                    if deepest.is_none_or(|deepest| depth + bytes > deepest.bytes) {
                        let call = Some((target, entered, depth));
                        *deepest = Some(Deepest { bytes: depth + bytes, call });
                    }
                }
            }
        }
        self.under_way.pop();
        self.done.insert((address, entry), done);
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

    fn open(image: &Image<'_>, address: u32) -> u32 {
        Walk::new(image).level(address, &[Interrupts::Open]).unwrap().bytes
    }

    // push {r4, lr}; bl 0x200; pop {r4, pc}
    const CALLS_0X200: [u8; 8] = [0x10, 0xB5, 0x00, 0xF0, 0x7D, 0xF8, 0x10, 0xBD];
    // sub sp, #16; add sp, #16; bx lr
    const LEAF: [u8; 6] = [0x84, 0xB0, 0x04, 0xB0, 0x70, 0x47];

    #[test]
    fn a_chain_of_calls_adds_up() {
        let image = image(&[(0x100, "caller", &CALLS_0X200), (0x200, "leaf", &LEAF)]);
        let level = Walk::new(&image).level(0x100, &[Interrupts::Open]).unwrap();
        assert_eq!(level.bytes, 24);
        assert_eq!(level.chain, [("caller".to_owned(), 8), ("leaf".to_owned(), 16)]);
    }

    #[test]
    fn a_call_through_a_pointer_counts_as_the_deepest_that_it_may_reach() {
        // push {r4, lr}; blx r3; pop {r4, pc}
        let caller = [0x10, 0xB5, 0x98, 0x47, 0x10, 0xBD];
        let mut image = image(&[(0x100, "caller", &caller), (0x200, "leaf", &LEAF)]);
        assert!(Walk::new(&image).visit(0x100, Interrupts::Open).is_err(), "there is none");
        image.find_pointers(&[0x01, 0x02, 0, 0]);
        assert_eq!(open(&image, 0x100), 24);
        image.pointed.clear();
        // movw r3, #0x201; movt r3, #0
        image.find_pointers(&[0x40, 0xF2, 0x01, 0x23, 0xC0, 0xF2, 0x00, 0x03]);
        assert_eq!(open(&image, 0x100), 24);
    }

    #[test]
    fn recursion_is_refused() {
        // push {r4, lr}; bl 0x200
        let image = image(&[(0x200, "endless", &[0x10, 0xB5, 0xFF, 0xF7, 0xFD, 0xFF])]);
        let error = Walk::new(&image).visit(0x200, Interrupts::Open).err().unwrap().to_string();
        assert!(error.contains("endless"), "{error}");
    }

    #[test]
    fn interrupts_count_only_where_they_are_open() {
        // push {r4, lr}; cpsid i; bl 0x200; cpsie i; bl 0x300; pop {r4, pc}
        let caller: Vec<u8> = [0xB510u16, 0xB672, 0xF000, 0xF87C, 0xB662, 0xF000, 0xF8F9, 0xBD10]
            .map(u16::to_le_bytes)
            .concat();
        // sub sp, #8; add sp, #8; bx lr
        let small = [0x82, 0xB0, 0x02, 0xB0, 0x70, 0x47];
        let functions = |first: &'static str| {
            [(0x100, "caller", &caller[..]), (0x200, first, &LEAF), (0x300, "small", &small)]
        };
        let image = image(&functions("leaf"));
        let mut walk = Walk::new(&image);
        let [open, masked] =
            [Interrupts::Open, Interrupts::Masked].map(|state| walk.level(0x100, &[state]).unwrap());
        assert_eq!((open.bytes, masked.bytes), (16, 24));
        assert_eq!(masked.chain, [("caller".to_owned(), 8), ("leaf".to_owned(), 16)]);
        assert_eq!(open.chain, [("caller".to_owned(), 8), ("small".to_owned(), 8)]);
    }

    #[test]
    fn what_a_callee_calls_may_end_the_masking() {
        // cpsid i; bl 0x200; push {r0}; pop {r0}; bx lr
        let caller = [0xB672u16, 0xF000, 0xF87D, 0xB401, 0xBC01, 0x4770].map(u16::to_le_bytes).concat();
        // push {r4, lr}; bl 0x300; pop {r4, pc}
        let between = CALLS_0X200;
        // cpsie i; bx lr
        let unmasks = [0x62, 0xB6, 0x70, 0x47];
        let image =
            image(&[(0x100, "caller", &caller), (0x200, "between", &between), (0x300, "unmasks", &unmasks)]);
        let mut walk = Walk::new(&image);
        assert!(walk.unmasks(0x200).unwrap());
        assert_eq!(walk.level(0x100, &[Interrupts::Open]).unwrap().bytes, 8, "from within `unmasks` on");
    }

    #[test]
    fn a_handler_that_uses_floating_point_registers_is_refused() {
        // vmov s0, r0; bx lr
        let float = [0x00, 0xEE, 0x10, 0x0A, 0x70, 0x47];
        let image = image(&[(0x100, "handler", &CALLS_0X200), (0x200, "float", &float)]);
        let error = Walk::new(&image).check_float(0x100).unwrap_err().to_string();
        assert!(error.contains("handler") && error.contains("in float"), "{error}");
        let image = self::image(&[(0x100, "handler", &CALLS_0X200), (0x200, "leaf", &LEAF)]);
        Walk::new(&image).check_float(0x100).unwrap();
    }
}
