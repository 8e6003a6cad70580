//! The STM32F405 image: built, written in the three formats that flash tools and the emulator want, and measured.

use std::fmt::Write as _;
use std::fs;
use std::ops::Range;
use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use object::LittleEndian;
use object::elf::{FileHeader32, PT_LOAD, SHT_SYMTAB};
use object::read::elf::{FileHeader as _, ProgramHeader as _, Sym as _};

use crate::run;
use crate::setup::{self, TARGET, Toolchain};
use crate::stack::{self, Worst};
use crate::workspace::Workspace;

/// The package, binary and feature of the image, and the profile it is built with.
const PACKAGE: &str = "jointbus-mcu-bridge";
const BINARY: &str = "stm32f405";
const FEATURE: &str = "stm32f405";
const PROFILE: &str = "firmware";

/// Where its tasks are, with their priorities.
const TASKS: &str = "mcu-bridge/src/bin/stm32f405/main.rs";

/// What the image is called when it is done.
const NAME: &str = "jointbus-stm32f405";

/// Where the program may lie; the rest of the flash keeps the configuration. The same figures as in `memory.x`.
const FLASH: Range<u32> = 0x0800_0000..0x0800_0000 + 768 * 1024;
/// The RAM that the static variables and the stack share, and above them the bytes that survive a reset.
const RAM: Range<u32> = 0x2000_0000..0x2000_0000 + 128 * 1024;

/// The content of flash between two pieces: what erased flash reads as.
const ERASED: u8 = 0xFF;

/// The image in its formats, and what it takes.
pub(crate) struct Image {
    /// With symbols; the emulator and debuggers take this one.
    pub(crate) elf: PathBuf,
    /// The bytes from the start of the flash on.
    pub(crate) bin: PathBuf,
    /// Intel HEX.
    pub(crate) hex: PathBuf,
    /// What it takes.
    pub(crate) usage: Usage,
    /// The deepest that the stack can get.
    pub(crate) worst: Worst,
}

/// How much of the part an image takes, in bytes.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Usage {
    /// Code, constants and the initial values of variables.
    pub(crate) flash: u32,
    /// Everything that has an address in RAM: initialised, zeroed, and kept over a reset.
    pub(crate) static_ram: u32,
    /// What is kept for the stack.
    stack: u32,
}

/// Some bytes and their address in flash.
#[derive(Debug, PartialEq, Eq)]
struct Piece<'data> {
    address: u32,
    bytes: &'data [u8],
}

impl Image {
    /// Prints where the image is and how much of the part it takes.
    pub(crate) fn report(&self) {
        for path in [&self.elf, &self.bin, &self.hex] {
            println!("{}", path.display());
        }
        println!("{}", self.usage.lines());
        println!(
            "stack      {:>9} of {} bytes at worst",
            grouped(self.worst.bytes),
            grouped(self.usage.stack)
        );
    }
}

/// Builds the image with a toolchain that is set up on the way, and writes it to `firmware/` in the build directory.
pub(crate) fn build(workspace: &Workspace) -> Result<Image> {
    let toolchain = setup::toolchain(workspace)?;
    cargo(workspace, toolchain, "build", &[])?;
    let built = workspace.target.join(TARGET).join(PROFILE).join(BINARY);
    let file = fs::read(&built).with_context(|| format!("cannot read {}", built.display()))?;
    let (pieces, entry, usage) = measure(&file).with_context(|| built.display().to_string())?;

    let tasks =
        fs::read_to_string(workspace.root.join(TASKS)).with_context(|| format!("cannot read {TASKS}"))?;
    let worst =
        stack::worst(&file, &stack::priorities(&tasks)?).context("the worst-case stack is not known")?;
    ensure!(
        worst.bytes <= usage.stack,
        "{} bytes of stack are too few for the worst case:\n{}",
        usage.stack,
        worst.lines()
    );

    let folder = workspace.target.join("firmware");
    fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let write = |extension: &str, content: &[u8]| -> Result<PathBuf> {
        let path = folder.join(format!("{NAME}.{extension}"));
        fs::write(&path, content).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(path)
    };
    Ok(Image {
        elf: write("elf", &file)?,
        bin: write("bin", &binary(&pieces))?,
        hex: write("hex", intel_hex(&pieces, entry).as_bytes())?,
        usage,
        worst,
    })
}

/// The linter over the image's code, which the host build leaves out.
pub(crate) fn clippy(workspace: &Workspace) -> Result<()> {
    let toolchain = setup::toolchain(workspace)?;
    cargo(workspace, toolchain, "clippy", &["--", "-D", "warnings"])
}

/// A cargo command on the image.
fn cargo(workspace: &Workspace, toolchain: Toolchain, subcommand: &str, more: &[&str]) -> Result<()> {
    let mut command = toolchain.cargo(workspace, subcommand);
    command
        .args(["--profile", PROFILE, "--package", PACKAGE, "--bin", BINARY, "--features", FEATURE])
        .args(more);
    run::shown(&mut command)
}

/// How much of the part an image takes.
pub(crate) fn usage(file: &[u8]) -> Result<Usage> {
    measure(file).map(|(_, _, usage)| usage)
}

/// What goes to flash, in the order of its addresses, where it starts, and what it takes.
fn measure(file: &[u8]) -> Result<(Vec<Piece<'_>>, u32, Usage)> {
    let header = FileHeader32::<LittleEndian>::parse(file).context("not an ELF file of a 32-bit part")?;
    let endian = header.endian()?;
    let mut pieces = Vec::new();
    let mut static_ram = 0;
    for segment in header.program_headers(endian, file)?.iter().filter(|one| one.p_type(endian) == PT_LOAD) {
        let bytes = segment.data(endian, file).ok().context("a segment is cut off")?;
        if !bytes.is_empty() {
            pieces.push(Piece { address: segment.p_paddr(endian), bytes });
        }
        if RAM.contains(&segment.p_vaddr(endian)) {
            static_ram += segment.p_memsz(endian);
        }
    }
    pieces.sort_by_key(|piece| piece.address);
    check_places(&pieces)?;
    let flash = pieces.iter().map(|piece| length(piece.bytes)).sum();

    let sections = header.sections(endian, file)?;
    let symbols = sections.symbols(endian, file, SHT_SYMTAB)?;
    let value = |name: &str| -> Result<u32> {
        let is_named = |symbol: &&object::elf::Sym32<LittleEndian>| {
            symbols.symbol_name(endian, *symbol).is_ok_and(|found| found == name.as_bytes())
        };
        let symbol = symbols.iter().find(is_named).with_context(|| format!("there is no symbol {name}"))?;
        Ok(symbol.st_value(endian))
    };
    // The stack grows down, out of the RAM if too far; the names are those of cortex-m-rt.
    let end = value("_stack_end")?;
    ensure!(
        end == RAM.start,
        "the stack ends at {end:#010x}: what overflows it would be written over variables"
    );
    let stack = value("_stack_start")?.checked_sub(end).context("the stack ends above its start")?;
    Ok((pieces, header.e_entry(endian), Usage { flash, static_ram, stack }))
}

/// Pieces, in the order of their addresses, fill flash from its start on without lying over each other.
fn check_places(pieces: &[Piece<'_>]) -> Result<()> {
    let first = pieces.first().context("there is nothing to flash")?;
    // The processor takes its first two words from there, and `.bin` is flashed there.
    ensure!(
        first.address == FLASH.start,
        "the first piece lies at {:#010x}, not at the start",
        first.address
    );
    let mut free = FLASH.start;
    for Piece { address, bytes } in pieces {
        if *address < free {
            bail!("two pieces lie over each other at {address:#010x}");
        }
        match address.checked_add(length(bytes)) {
            Some(end) if end <= FLASH.end => free = end,
            _ => bail!("the piece at {address:#010x} ends outside of the flash"),
        }
    }
    Ok(())
}

/// The pieces as one block from the start of the flash on, with erased flash between them.
fn binary(pieces: &[Piece<'_>]) -> Vec<u8> {
    let mut block = Vec::new();
    for Piece { address, bytes } in pieces {
        block.resize((address - FLASH.start) as usize, ERASED);
        block.extend_from_slice(bytes);
    }
    block
}

/// The pieces as Intel HEX (Intel's specification, revision A, 1988): 16 bytes a line, 32-bit addresses.
fn intel_hex(pieces: &[Piece<'_>], entry: u32) -> String {
    const LINE: u32 = 16;
    const DATA: u8 = 0x00;
    const END_OF_FILE: u8 = 0x01;
    const EXTENDED_LINEAR_ADDRESS: u8 = 0x04;
    const START_LINEAR_ADDRESS: u8 = 0x05;

    let mut text = String::new();
    let mut upper = None;
    for piece in pieces {
        let (mut address, mut rest) = (piece.address, piece.bytes);
        while !rest.is_empty() {
            let [a, b, offset @ ..] = address.to_be_bytes();
            if upper != Some([a, b]) {
                record(&mut text, EXTENDED_LINEAR_ADDRESS, [0, 0], &[a, b]);
                upper = Some([a, b]);
            }
            // A line ends at a multiple of its length, so that none goes over a boundary of 64 KiB.
            let room = (LINE - address % LINE) as usize;
            let (line, after) = rest.split_at(room.min(rest.len()));
            record(&mut text, DATA, offset, line);
            address += length(line);
            rest = after;
        }
    }
    record(&mut text, START_LINEAR_ADDRESS, [0, 0], &entry.to_be_bytes());
    record(&mut text, END_OF_FILE, [0, 0], &[]);
    text
}

/// One line of Intel HEX: length, offset, kind, data, and the byte that makes their sum zero.
fn record(text: &mut String, kind: u8, [high, low]: [u8; 2], data: &[u8]) {
    let count = u8::try_from(data.len()).expect("a line holds 16 bytes at most");
    let mut bytes = vec![count, high, low, kind];
    bytes.extend_from_slice(data);
    let sum = bytes.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    bytes.push(sum.wrapping_neg());
    text.push(':');
    for byte in bytes {
        write!(text, "{byte:02X}").expect("a string takes everything");
    }
    text.push('\n');
}

impl Usage {
    /// Two lines for people.
    fn lines(&self) -> String {
        let of = |used: u32, part: &Range<u32>| {
            let size = part.end - part.start;
            let percent = f64::from(used) * 100.0 / f64::from(size);
            format!("{:>9} of {} bytes ({percent:.1} %)", grouped(used), grouped(size))
        };
        format!("flash      {}\nstatic RAM {}", of(self.flash, &FLASH), of(self.static_ram, &RAM))
    }
}

/// A number with its thousands apart.
fn grouped(number: u32) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// The length of a part of a file that is far smaller than 4 GiB.
fn length(bytes: &[u8]) -> u32 {
    u32::try_from(bytes.len()).expect("a file of a 32-bit part has 32-bit lengths")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(address: u32, bytes: &[u8]) -> Piece<'_> {
        Piece { address, bytes }
    }

    #[test]
    fn the_limits_are_those_of_the_linker_script() {
        let script = include_str!("../../memory.x");
        assert!(script.contains("FLASH : ORIGIN = 0x08000000, LENGTH = 768K\n"));
        assert!(script.contains("STACK : ORIGIN = 0x20000000, LENGTH = 10K\n"));
        assert!(script.contains("RAM   : ORIGIN = 0x20002800, LENGTH = 118K - 32\n"));
    }

    #[test]
    fn a_binary_fills_gaps_with_erased_flash() {
        let pieces = [piece(0x0800_0000, &[1, 2]), piece(0x0800_0004, &[3])];
        assert_eq!(binary(&pieces), [1, 2, 0xFF, 0xFF, 3]);
    }

    #[test]
    fn hex_lines_carry_addresses_and_sums() {
        // 14 bytes up to the boundary of 64 KiB and one after it.
        let bytes: Vec<u8> = (0..15).collect();
        let text = intel_hex(&[piece(0x0800_FFF2, &bytes)], 0x0800_0101);
        let expected = [
            ":020000040800F2",
            ":0EFFF200000102030405060708090A0B0C0DA6",
            ":020000040801F1",
            ":010000000EF1",
            ":0400000508000101ED",
            ":00000001FF",
        ];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn every_hex_line_sums_to_zero() {
        let text = intel_hex(&[piece(0x0800_0003, &[0xA5; 100])], 0);
        for line in text.lines() {
            let digits = line.strip_prefix(':').unwrap().as_bytes();
            let bytes =
                digits.chunks(2).map(|two| u8::from_str_radix(str::from_utf8(two).unwrap(), 16).unwrap());
            assert_eq!(bytes.fold(0, u8::wrapping_add), 0, "{line}");
        }
    }

    #[test]
    fn pieces_outside_of_the_flash_are_refused() {
        let refused = |pieces: &[Piece<'_>]| check_places(pieces).unwrap_err().to_string();
        assert!(refused(&[]).contains("nothing"));
        assert!(refused(&[piece(0x0800_0100, &[0])]).contains("not at the start"));
        assert!(
            refused(&[piece(0x0800_0000, &[0; 8]), piece(0x0800_0004, &[0])]).contains("over each other")
        );
        assert!(refused(&[piece(0x0800_0000, &[0]), piece(0x080B_FFFF, &[0; 2])]).contains("outside"));
        assert!(refused(&[piece(0x0800_0000, &[0]), piece(0x2000_0000, &[0])]).contains("outside"));
        check_places(&[piece(0x0800_0000, &[0]), piece(0x080B_FFFF, &[0])]).unwrap();
    }

    #[test]
    fn usage_is_measured_in_an_elf_file() {
        let file = elf(&[
            (0x0800_0000, 0x0800_0000, 8, 8),
            (0x2000_2800, 0x0800_0008, 4, 4),
            (0x2000_2804, 0, 0, 96),
        ]);
        let (pieces, entry, usage) = measure(&file).unwrap();
        assert_eq!(pieces, [piece(0x0800_0000, &[0xAB; 8]), piece(0x0800_0008, &[0xAB; 4])]);
        assert_eq!(entry, 0x0800_0001);
        assert_eq!(usage, Usage { flash: 12, static_ram: 100, stack: 0x2800 });
        assert_eq!(
            usage.lines(),
            "flash             12 of 786,432 bytes (0.0 %)\n\
             static RAM       100 of 131,072 bytes (0.1 %)"
        );
    }

    #[test]
    fn a_file_that_is_cut_off_is_refused() {
        let file = elf(&[(0x0800_0000, 0x0800_0000, 8, 8)]);
        for length in 0..file.len() {
            assert!(measure(&file[..length]).is_err(), "{length} bytes");
        }
    }

    /// A small executable: segments (virtual address, load address, size in the file, size in memory) full of 0xAB,
    /// and the two symbols of the stack. Layout as in the ELF specification: header, program headers, content of the
    /// segments, symbols, names, section headers.
    fn elf(segments: &[(u32, u32, u32, u32)]) -> Vec<u8> {
        const HEADER: u32 = 52;
        const PROGRAM_HEADER: u32 = 32;
        let words = |words: &[u32]| words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>();
        let halves = |halves: &[u16]| halves.iter().flat_map(|half| half.to_le_bytes()).collect::<Vec<u8>>();

        let content_at = HEADER + PROGRAM_HEADER * segments.len() as u32;
        let mut program_headers = Vec::new();
        let mut content = Vec::new();
        for &(virtual_address, load_address, in_file, in_memory) in segments {
            let at = content_at + content.len() as u32;
            program_headers.extend(words(&[1, at, virtual_address, load_address, in_file, in_memory, 7, 4]));
            content.extend(vec![0xAB; in_file as usize]);
        }
        let symbols_at = content_at + content.len() as u32;
        let names = b"\0_stack_start\0_stack_end\0";
        let absolute = halves(&[0x0010, 0xFFF1]);
        let symbols = [
            words(&[0; 4]),
            [words(&[1, 0x2000_2800, 0]), absolute.clone()].concat(),
            [words(&[14, 0x2000_0000, 0]), absolute].concat(),
        ]
        .concat();
        let names_at = symbols_at + symbols.len() as u32;
        let sections_at = names_at + names.len() as u32;
        let sections = [
            words(&[0; 10]),
            words(&[0, 2, 0, 0, symbols_at, symbols.len() as u32, 2, 1, 4, 16]),
            words(&[0, 3, 0, 0, names_at, names.len() as u32, 0, 0, 1, 0]),
        ]
        .concat();
        [
            b"\x7FELF\x01\x01\x01\0\0\0\0\0\0\0\0\0".to_vec(),
            halves(&[2, 40]),
            words(&[1, 0x0800_0001, HEADER, sections_at, 0]),
            halves(&[52, 32, segments.len() as u16, 40, 3, 2]),
            program_headers,
            content,
            symbols,
            names.to_vec(),
            sections,
        ]
        .concat()
    }
}
