//! The worst-case stack of an image, worked out from its machine code: no run has to meet the worst case to see it.
//!
//! [`image`] finds the functions, [`code`] tells of each how deep it goes and whom it calls, [`walk`] follows the calls.
//! The worst case is the deepest chain of calls from the reset on while interrupts are open, and on top of it one exception
//! frame and the deepest handler of every interrupt priority; or the deepest chain while they are masked, if that is deeper.
//! A call through a pointer counts as the deepest function whose address is anywhere in the image. Recursion is an error.

mod code;
mod image;
mod walk;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use anyhow::{Context, Result};
use object::LittleEndian;
use object::read::elf::ElfFile32;

use self::code::Interrupts;
use self::image::{HARD_FAULT, Image, RESET, kinds};
use self::walk::{Level, Walk};

/// What the processor pushes for an exception: eight registers, and a word where the stack has to be aligned (ARMv7-M
/// reference manual, B1.5.6 and B1.5.7). The firmware has it keep no floating-point registers, which a test of the image
/// sees; here no handler may therefore touch them.
const EXCEPTION: u32 = 8 * 4 + 4;

/// What stands in the vector table where there is no handler.
const NO_HANDLER: &str = "DefaultHandler";

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
}
