//! One instruction: how long it is, what it does to the stack pointer and the masking of interrupts, and where it goes on.

use anyhow::{Context, Result, bail, ensure};
use yaxpeax_arch::{Decoder as _, U8Reader};
use yaxpeax_arm::armv7::{ConditionCode, InstDecoder, Instruction, Opcode, Operand};

use super::{Callee, Code};

/// Numbers of registers.
const SP: u8 = 13;
const LR: u8 = 14;
const PC: u8 = 15;

/// One instruction as far as it matters here.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Step {
    pub(super) length: u32,
    /// Bytes that it pushes; negative where it pops.
    pub(super) pushes: i32,
    pub(super) flow: Flow,
    pub(super) float: bool,
    pub(super) mask: Mask,
}

/// What becomes of the masking of interrupts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mask {
    Stays,
    Set,
    /// Or is given a value that nobody knows.
    Cleared,
}

/// Where it goes on.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Flow {
    Next,
    /// To an address, and to the next instruction where there is a condition.
    Jump(u32),
    Branch(u32),
    Call(Callee),
    /// To where a register points, and not back.
    Leave,
    /// By a table behind it, whose entries have so many bytes.
    Table(u32),
    /// Into a row of jumps behind it.
    Row,
    /// A condition for so many instructions.
    Conditions(u32),
    /// Back to the caller, or nowhere.
    End,
}

/// The instruction at an address.
pub(super) fn decode(code: Code<'_>, address: u32) -> Result<Step> {
    let bytes =
        code.from(address).with_context(|| format!("the code leaves its function at {address:#x}"))?;
    let (Some(first), second) = (code.half(address), code.half(address + 2)) else {
        bail!("the code leaves its function at {address:#x}");
    };
    // coprocessor space, where the decoder knows nothing of floating-point instructions
    if let (0b111, Some(second)) = (first >> 13 & 0b111, second)
        && first & 0x0C00 == 0x0C00
    {
        return coprocessor(first, second).with_context(|| format!("at {address:#x}"));
    }
    let instruction = InstDecoder::default_thumb()
        .decode(&mut U8Reader::new(bytes))
        .map_err(|error| anyhow::anyhow!("no instruction at {address:#x}: {error:?}"))?;
    let length = if instruction.wide { 4 } else { 2 };
    let mask = mask(first, second);
    let flow = flow(&instruction, address).with_context(|| format!("{instruction} at {address:#x}"))?;
    let pushes = pushes(&instruction).with_context(|| format!("{instruction} at {address:#x}"))?;
    Ok(Step { length, pushes, flow, float: false, mask })
}

/// What an instruction does to PRIMASK: CPSID and CPSIE, and MSR, which may write anything (ARMv7-M reference manual,
/// B5.2.1 and B5.2.3).
fn mask(first: u32, second: Option<u32>) -> Mask {
    const PRIMASK: u32 = 16;
    match (first, second) {
        // the second bit stands for PRIMASK, the first one for FAULTMASK
        (0xB672 | 0xB673, _) => Mask::Set,
        (0xB662 | 0xB663, _) => Mask::Cleared,
        (0xF380..=0xF38F, Some(second)) if second & 0xFF == PRIMASK => Mask::Cleared,
        _ => Mask::Stays,
    }
}

/// An instruction of a coprocessor: the floating-point unit's push and pop, or one that leaves the stack pointer
/// alone (ARMv7-M reference manual, A6.4 to A6.7).
fn coprocessor(first: u32, second: u32) -> Result<Step> {
    let bytes = 4 * (second & 0xFF) as i32;
    let float = matches!(second >> 8 & 0xF, 10 | 11);
    let pushes = match first & 0xFFBF {
        0xED2D if float => bytes,
        0xECBD if float => -bytes,
        _ => {
            let moves_memory = first & 0x0200 == 0;
            let writes_back = first & 0x0020 != 0;
            ensure!(
                !(moves_memory && writes_back && first & 0xF == u32::from(SP)),
                "an unknown change of the stack pointer"
            );
            0
        }
    };
    Ok(Step { length: 4, pushes, flow: Flow::Next, float, mask: Mask::Stays })
}

fn flow(instruction: &Instruction, address: u32) -> Result<Flow> {
    let is_short = !instruction.wide
        && (instruction.condition != ConditionCode::AL
            || matches!(instruction.opcode, Opcode::CBZ | Opcode::CBNZ));
    // the decoder counts the short conditional ones from the next instruction, the others from four bytes on
    let base = address.wrapping_add(if is_short { 2 } else { 4 });
    let target = |offset: i32| base.wrapping_add_signed(2 * offset);
    let [first, second, ..] = &instruction.operands;
    Ok(match (instruction.opcode, first, second) {
        (Opcode::B, Operand::BranchThumbOffset(offset), _) => match instruction.condition {
            ConditionCode::AL => Flow::Jump(target(*offset)),
            _ => Flow::Branch(target(*offset)),
        },
        (Opcode::CBZ | Opcode::CBNZ, _, Operand::BranchThumbOffset(offset)) => Flow::Branch(target(*offset)),
        (Opcode::BL, Operand::BranchThumbOffset(offset), _) => Flow::Call(Callee::At(target(*offset))),
        (Opcode::BLX, Operand::Reg(_), _) => Flow::Call(Callee::Unknown),
        (Opcode::BX, Operand::Reg(register), _) if register.number() == LR => Flow::End,
        (Opcode::BX, Operand::Reg(_), _) => Flow::Leave,
        (Opcode::TBB, ..) => Flow::Table(1),
        (Opcode::TBH, ..) => Flow::Table(2),
        (Opcode::IT, _, Operand::Imm32(mask)) => Flow::Conditions(4 - mask.trailing_zeros().min(3)),
        (Opcode::POP, Operand::RegList(registers), _) if registers & 1 << PC != 0 => Flow::End,
        (Opcode::UDF, ..) => Flow::End,
        (Opcode::MOV, Operand::Reg(to), Operand::Reg(from)) if to.number() == PC => {
            if from.number() == LR {
                Flow::End
            } else {
                Flow::Row
            }
        }
        (Opcode::LDR, Operand::Reg(to), Operand::RegDerefPostindexOffset(base, 4, true, _))
            if to.number() == PC && base.number() == SP =>
        {
            Flow::End
        }
        // what else could write the program counter
        (Opcode::STR | Opcode::CMP | Opcode::TST | Opcode::CMN | Opcode::TEQ, ..) => Flow::Next,
        (_, Operand::Reg(to), _) if to.number() == PC => bail!("an unknown jump"),
        _ => Flow::Next,
    })
}

/// Bytes that an instruction pushes.
fn pushes(instruction: &Instruction) -> Result<i32> {
    let [first, second, third, _] = &instruction.operands;
    let registers = |list: u16| 4 * list.count_ones() as i32;
    let is_sp = |operand: &Operand| matches!(operand, Operand::Reg(register) if register.number() == SP);
    Ok(match (instruction.opcode, first, second, third) {
        (Opcode::PUSH, Operand::RegList(list), ..) => registers(*list),
        (Opcode::POP, Operand::RegList(list), ..) => -registers(*list),
        (Opcode::SUB, _, _, Operand::Imm32(bytes)) if is_sp(first) && is_sp(second) => i32::try_from(*bytes)?,
        (Opcode::ADD, _, _, Operand::Imm32(bytes)) if is_sp(first) && is_sp(second) => {
            -i32::try_from(*bytes)?
        }
        (Opcode::CMP | Opcode::CMN | Opcode::TST | Opcode::TEQ, ..) => 0,
        // loads, stores and everything else: the operand that is changed by the way
        _ => {
            ensure!(
                !is_sp(first) || matches!(instruction.opcode, Opcode::MSR),
                "an unknown change of the stack pointer"
            );
            let mut change = 0;
            for operand in &instruction.operands {
                change += match operand {
                    Operand::RegDerefPreindexOffset(base, bytes, up, true)
                    | Operand::RegDerefPostindexOffset(base, bytes, up, _)
                        if base.number() == SP =>
                    {
                        if *up {
                            -i32::from(*bytes)
                        } else {
                            i32::from(*bytes)
                        }
                    }
                    Operand::RegWBack(base, true)
                    | Operand::RegDerefPreindexReg(base, _, _, true)
                    | Operand::RegDerefPostindexReg(base, ..)
                    | Operand::RegDerefPreindexRegShift(base, _, _, true)
                    | Operand::RegDerefPostindexRegShift(base, ..)
                        if base.number() == SP =>
                    {
                        bail!("an unknown change of the stack pointer")
                    }
                    _ => 0,
                };
            }
            change
        }
    })
}
