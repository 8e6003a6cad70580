//! What a function's machine code does to the stack: how deep it goes by itself, and how deep it is where it calls.
//!
//! Every path through the function is followed, with the stack pointer counted along, and with it whether interrupts are
//! masked for certain. Whatever cannot be followed is an error: an unknown change of the stack pointer, an unknown jump,
//! a stack that grows in a loop.

mod step;

use std::collections::BTreeMap;

use anyhow::{Context, Result, ensure};

use self::step::{Flow, Mask, Step, decode};

/// No function of a small part goes this deep, so a loop that pushes is noticed.
const ABSURD: u32 = 1 << 16;

/// Fills up to whole words.
const NOP: u32 = 0xBF00;

/// The code of a function.
#[derive(Clone, Copy)]
pub(super) struct Code<'data> {
    /// Address of the first instruction.
    pub(super) start: u32,
    pub(super) bytes: &'data [u8],
    /// Where in the image code (`true`) or data begins, in the order of addresses.
    pub(super) kinds: &'data [(u32, bool)],
}

/// Whether an interrupt may come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Interrupts {
    /// It may, or nobody knows.
    Open,
    /// PRIMASK is set for certain.
    Masked,
}

/// What a function does.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Summary {
    /// Bytes that it takes by itself while interrupts are open, if they ever are.
    pub(super) open: Option<u32>,
    /// The same while they are masked.
    pub(super) masked: Option<u32>,
    /// Whom it calls, the bytes that it has taken then, and whether interrupts are masked.
    pub(super) calls: Vec<(Callee, u32, Interrupts)>,
    /// Whether it uses the floating-point unit.
    pub(super) float: bool,
    /// Whether it may end the masking of interrupts by itself.
    pub(super) unmasks: bool,
}

/// What is called.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Callee {
    /// The function at an address.
    At(u32),
    /// Whatever a register points to.
    Unknown,
}

/// Follows every path of a function that is entered like this; `unmasks` tells of a callee whether it may end the
/// masking of interrupts.
pub(super) fn summary(
    code: Code<'_>,
    entry: Interrupts,
    mut unmasks: impl FnMut(Callee) -> Result<bool>,
) -> Result<Summary> {
    let mut summary = Summary::default();
    // depth before each instruction
    let mut known: BTreeMap<(u32, Interrupts), u32> = BTreeMap::new();
    // and how many instructions from it on have a condition
    let mut open = vec![(code.start, 0u32, 0u32, entry)];
    while let Some((address, depth, conditions, interrupts)) = open.pop() {
        ensure!(depth < ABSURD, "the stack grows in a loop at {address:#x}");
        match known.get_mut(&(address, interrupts)) {
            Some(seen) if *seen >= depth => continue,
            Some(seen) => *seen = depth,
            None => drop(known.insert((address, interrupts), depth)),
        }
        let step = decode(code, address)?;
        summary.float |= step.float;
        summary.unmasks |= step.mask == Mask::Cleared;
        let after = depth
            .checked_add_signed(step.pushes)
            .with_context(|| format!("more is popped than was pushed at {address:#x}"))?;
        let frame = match interrupts {
            Interrupts::Open => &mut summary.open,
            Interrupts::Masked => &mut summary.masked,
        };
        *frame = (*frame).max(Some(after));
        let next = address + step.length;
        let is_conditional = conditions > 0;
        let left = conditions.saturating_sub(1);
        // a return pops what its function has pushed, which is then still there for whom it did not return
        ensure!(
            !is_conditional || step.pushes == 0 || step.flow == Flow::End,
            "the stack changes under a condition at {address:#x}"
        );
        let behind = match step.mask {
            // under a condition it may not come to that
            Mask::Set if !is_conditional => Interrupts::Masked,
            Mask::Cleared => Interrupts::Open,
            Mask::Set | Mask::Stays => interrupts,
        };
        let mut go = |to: u32, depth: u32, conditions: u32| open.push((to, depth, conditions, behind));
        match step.flow {
            Flow::Next => go(next, after, left),
            Flow::Conditions(count) => go(next, after, count),
            Flow::Jump(to) | Flow::Branch(to) if !code.contains(to) => {
                // the last thing that a function does may be to jump to another one
                summary.calls.push((Callee::At(to), after, interrupts));
                if matches!(step.flow, Flow::Branch(_)) || is_conditional {
                    go(next, after, left);
                }
            }
            Flow::Jump(to) => {
                go(to, after, 0);
                if is_conditional {
                    go(next, after, left);
                }
            }
            Flow::Branch(to) => {
                go(to, after, 0);
                go(next, after, left);
            }
            Flow::Call(callee) => {
                summary.calls.push((callee, after, interrupts));
                let back = if unmasks(callee)? { Interrupts::Open } else { interrupts };
                // behind the call of a function that does not return there may be nothing, or data after a filler
                let place = if code.half(next) == Some(NOP) { next + 2 } else { next };
                if code.contains(place) && code.is_code(place) {
                    open.push((next, after, left, back));
                }
            }
            Flow::Leave => {
                summary.calls.push((Callee::Unknown, after, interrupts));
                if is_conditional {
                    go(next, after, left);
                }
            }
            Flow::Table(width) => {
                for to in table(code, next, width)? {
                    go(to, after, 0);
                }
            }
            Flow::Row => {
                for to in row(code, next)? {
                    go(to, after, 0);
                }
            }
            Flow::End if is_conditional => go(next, depth, left),
            Flow::End => {}
        }
    }
    Ok(summary)
}

impl<'data> Code<'data> {
    fn contains(self, address: u32) -> bool {
        self.from(address).is_some_and(|rest| !rest.is_empty())
    }

    fn is_code(self, address: u32) -> bool {
        let before = self.kinds.partition_point(|(start, _)| *start <= address);
        before.checked_sub(1).is_none_or(|last| self.kinds.get(last).is_none_or(|(_, is_code)| *is_code))
    }

    fn from(self, address: u32) -> Option<&'data [u8]> {
        self.bytes.get(usize::try_from(address.checked_sub(self.start)?).ok()?..)
    }

    fn half(self, address: u32) -> Option<u32> {
        self.from(address)?.first_chunk().map(|bytes| u32::from(u16::from_le_bytes(*bytes)))
    }
}

/// Targets of a table of offsets that starts at an address and ends where code follows again.
fn table(code: Code<'_>, base: u32, width: u32) -> Result<Vec<u32>> {
    let end = code.kinds.iter().find(|(start, is_code)| *start > base && *is_code);
    let (end, _) = *end.with_context(|| format!("the table at {base:#x} has no end"))?;
    let mut targets = Vec::new();
    for place in (base..end).step_by(width as usize) {
        let half = code.half(place & !1).with_context(|| format!("the table at {base:#x} has no end"))?;
        let entry = match (width, place & 1) {
            (1, 0) => half & 0xFF,
            (1, _) => half >> 8,
            _ => half,
        };
        // a byte fills up the table to whole instructions
        let is_filler = width == 1 && entry == 0 && place + 1 == end;
        if !is_filler {
            let target = base + 2 * entry;
            ensure!(code.contains(target) && target >= end, "the table at {base:#x} leads astray");
            targets.push(target);
        }
    }
    Ok(targets)
}

/// The jumps that stand in a row from an address on, after a filler.
fn row(code: Code<'_>, start: u32) -> Result<Vec<u32>> {
    let mut place = if code.half(start) == Some(NOP) { start + 2 } else { start };
    let mut jumps = Vec::new();
    while let Ok(Step { length: 4, flow: Flow::Jump(_), .. }) = decode(code, place) {
        jumps.push(place);
        place += 4;
    }
    ensure!(!jumps.is_empty(), "a computed jump at {start:#x} leads nobody knows where");
    Ok(jumps)
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: u32 = 0x0800_0100;

    fn summary_of(halves: &[u16]) -> Result<Summary> {
        summary_with(halves, &[])
    }

    fn summary_with(halves: &[u16], kinds: &[(u32, bool)]) -> Result<Summary> {
        let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        summary(Code { start: START, bytes: &bytes, kinds }, Interrupts::Open, |_| Ok(false))
    }

    /// What a function takes that calls nobody while interrupts are masked.
    fn open(frame: u32, calls: Vec<(Callee, u32)>) -> Summary {
        let calls = calls.into_iter().map(|(callee, depth)| (callee, depth, Interrupts::Open)).collect();
        Summary { open: Some(frame), calls, ..Summary::default() }
    }

    #[test]
    fn pushes_and_frames_add_up_at_each_call() {
        let found = summary_of(&[
            0xB5F0, // push {r4-r7, lr}
            0xB087, // sub sp, #28
            0x4798, // blx r3
            0xB007, // add sp, #28
            0xF84D, 0x8D04, // str r8, [sp, #-4]!
            0xF000, 0xF879, // bl start + 0x102
            0xF85D, 0x8B04, // ldr r8, [sp], #4
            0xBDF0, // pop {r4-r7, pc}
        ])
        .unwrap();
        let calls = vec![(Callee::Unknown, 48), (Callee::At(START + 0x102), 24)];
        assert_eq!(found, open(48, calls));
    }

    #[test]
    fn both_ways_of_a_branch_are_followed() {
        let found = summary_of(&[
            0xB108, // cbz r0, the return
            0xB082, // sub sp, #8
            0xB002, // add sp, #8
            0x4770, // bx lr
        ])
        .unwrap();
        assert_eq!(found, open(8, vec![]));
    }

    #[test]
    fn every_form_of_a_branch_is_measured_from_its_own_base() {
        let branches: [(&[u16], u32); 5] = [
            (&[0xE00E], 32),         // b
            (&[0xD10E], 32),         // bne
            (&[0xB178], 34),         // cbz r0
            (&[0xF000, 0xB80E], 32), // b.w
            (&[0xF040, 0x800E], 32), // bne.w
        ];
        for (halves, distance) in branches {
            let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
            let step = decode(Code { start: START, bytes: &bytes, kinds: &[] }, START).unwrap();
            let to = START + distance;
            assert!([Flow::Jump(to), Flow::Branch(to)].contains(&step.flow), "{halves:x?}: {step:?}");
        }
    }

    #[test]
    fn a_conditional_return_leaves_the_frame_to_the_other_way() {
        let found = summary_of(&[
            0xB510, // push {r4, lr}
            0xBF08, // it eq
            0xBD10, // popeq {r4, pc}
            0xB081, // sub sp, #4
            0xB001, // add sp, #4
            0xBD10, // pop {r4, pc}
        ])
        .unwrap();
        assert_eq!(found.open, Some(12));
    }

    #[test]
    fn tables_are_followed_to_each_of_their_targets() {
        let found = summary_with(
            &[
                0xE8DF, 0xF000, // tbb [pc, r0]
                0x0301, // two entries
                0xB081, 0x4770, // sub sp, #4, and back
                0xB084, 0x4770, // sub sp, #16, and back
            ],
            &[(START + 4, false), (START + 6, true)],
        )
        .unwrap();
        assert_eq!(found.open, Some(16));
    }

    #[test]
    fn floating_point_registers_are_pushed() {
        let found = summary_of(&[0xED2D, 0x8B04, 0xECBD, 0x8B04, 0x4770]).unwrap();
        assert_eq!(found, Summary { float: true, ..open(16, vec![]) });
    }

    #[test]
    fn data_behind_a_call_that_does_not_return_is_no_code() {
        // bl start + 0x102, a nop, and what is no instruction
        let halves = [0xF000, 0xF87F, 0xBF00, 0xE800, 0x0000];
        let found = summary_with(&halves, &[(START, true), (START + 6, false)]).unwrap();
        assert_eq!(found.calls, [(Callee::At(START + 0x102), 0, Interrupts::Open)]);
        assert!(summary_of(&halves).is_err());
    }

    #[test]
    fn a_jump_to_another_function_is_a_call_of_it() {
        let found = summary_of(&[0xE07E]).unwrap();
        assert_eq!(found.calls, [(Callee::At(START + 0x100), 0, Interrupts::Open)]);
    }

    #[test]
    fn what_is_taken_while_interrupts_are_masked_is_told_apart() {
        let masked = |end: &[u16]| {
            // push {r4, lr}; cpsid i; sub sp, #16; bl start + 0x106; add sp, #16; the end; push {r0}; pop {r0}; pop
            let mut halves = vec![0xB510, 0xB672, 0xB084, 0xF000, 0xF87E, 0xB004];
            halves.extend([end, &[0xB401, 0xBC01, 0xBD10]].concat());
            summary_of(&halves).unwrap()
        };
        let callee = Callee::At(START + 0x106);
        for end in [&[0xB662][..], &[0xF384, 0x8810]] {
            // cpsie i; msr primask, r4
            let found = masked(end);
            assert_eq!((found.open, found.masked, found.unmasks), (Some(12), Some(24), true));
            assert_eq!(found.calls, [(callee, 24, Interrupts::Masked)]);
        }
        let found = masked(&[0xF384, 0x8811]);
        assert_eq!((found.open, found.masked), (Some(8), Some(24)), "msr basepri, r4");
    }

    #[test]
    fn a_callee_may_end_the_masking() {
        // cpsid i; bl start + 0x102; push {r0}; pop {r0}; bx lr
        let bytes: Vec<u8> = [0xB672u16, 0xF000, 0xF87E, 0xB401, 0xBC01, 0x4770]
            .iter()
            .flat_map(|half| half.to_le_bytes())
            .collect();
        let code = Code { start: START, bytes: &bytes, kinds: &[] };
        let found = |unmasks: bool| summary(code, Interrupts::Open, |_| Ok(unmasks)).unwrap();
        assert_eq!((found(true).open, found(true).masked), (Some(4), Some(0)));
        assert_eq!((found(false).open, found(false).masked), (Some(0), Some(4)));
        let masked = summary(code, Interrupts::Masked, |_| Ok(false)).unwrap();
        assert_eq!((masked.open, masked.masked), (None, Some(4)));
    }

    #[test]
    fn what_cannot_be_followed_is_an_error() {
        for (halves, why) in [
            (&[0xEBAD, 0x0D00][..], "unknown change"),  // sub.w sp, sp, r0
            (&[0x4685, 0x4770], "unknown change"),      // mov sp, r0
            (&[0xB081, 0xE7FD], "in a loop"),           // sub sp, #4, again and again
            (&[0x4687, 0x4770], "computed jump"),       // mov pc, r0
            (&[0xBF08, 0xB081, 0x4770], "a condition"), // subeq sp, #4
            (&[0xB001, 0x4770], "more is popped"),      // add sp, #4
            (&[0xBF00], "leaves its function"),         // nop
        ] {
            let error = format!("{:#}", summary_of(halves).unwrap_err());
            assert!(error.contains(why), "{error}");
        }
    }
}
