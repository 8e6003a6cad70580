//! The call graph of an image, followed from its entries on.

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail, ensure};
use rustc_demangle::demangle;

use super::code::{self, Callee, Interrupts, Summary};
use super::image::Image;
/// What runs at one priority.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Level {
    /// 0 for what no interrupt started.
    pub(super) priority: u8,
    /// Pushed by the processor on the way in.
    pub(super) exception: u32,
    pub(super) bytes: u32,
    /// The deepest chain of calls: each function, and how deep it is where it calls the next.
    pub(super) chain: Vec<(String, u32)>,
}

/// The call graph, as far as it has been walked.
pub(super) struct Walk<'image, 'data> {
    image: &'image Image<'data>,
    pub(super) done: BTreeMap<(u32, Interrupts), Done>,
    /// Functions that may end the masking of interrupts, by themselves or by what they call.
    unmasking: BTreeMap<u32, bool>,
    under_way: Vec<u32>,
    /// The deepest function that a pointer may lead to.
    pub(super) pointed: Option<(u32, u32)>,
}

/// A function that is entered with interrupts open or masked, and everything below it.
#[derive(Clone, Copy)]
pub(super) struct Done {
    open: Option<Deepest>,
    masked: Option<Deepest>,
    /// The function that uses the floating-point unit.
    float: Option<u32>,
    /// It calls through a pointer itself.
    pub(super) indirect: bool,
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
    pub(super) fn new(image: &'image Image<'data>) -> Self {
        let (done, unmasking) = (BTreeMap::new(), BTreeMap::new());
        Self { image, done, unmasking, under_way: Vec::new(), pointed: None }
    }

    /// The deepest chain from an entry on that ends with interrupts in one of these states.
    pub(super) fn level(&mut self, entry: u32, states: &[Interrupts]) -> Result<Level> {
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
    pub(super) fn check_float(&mut self, handler: u32) -> Result<()> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stack::code::Code;
    use crate::stack::image::Function;
    use std::collections::BTreeSet;

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
