//! What the compiler calls for to copy and fill memory, on the image's own code.

use super::*;
use object::{Object as _, ObjectSymbol as _};

/// Memory that nothing else uses before the first instruction.
const FROM: u32 = 0x2000_8000;
const TO: u32 = 0x2000_8100;
const BACK: u32 = 0x2000_8200;

/// Longer than what any of the functions takes in one step, a few times over.
const LENGTHS: std::ops::Range<usize> = 0..71;
const ROOM: usize = LENGTHS.end + 8;

#[test]
fn memory_is_copied_whatever_its_place_and_length() {
    let mut processor = Processor::start();
    let source: Vec<u8> = (1..).take(ROOM).collect();
    processor.debugger.write(FROM, &source).unwrap();
    let copies = processor.functions(&["memcpy", "__aeabi_memcpy", "__aeabi_memcpy4", "__aeabi_memcpy8"]);
    for (name, function) in copies {
        let step = step(name);
        for (from, to) in places(step).flat_map(|from| places(step).map(move |to| (from, to))) {
            for length in LENGTHS {
                let copied = &source[from as usize..][..length];
                processor.run(name, function, |length| vec![TO + to, FROM + from, length], to, copied);
            }
        }
    }
}

#[test]
fn memory_is_filled_whatever_its_place_and_length() {
    let mut processor = Processor::start();
    // only the lowest byte of the value counts
    const VALUE: u32 = 0x1234_56C3;
    let fills = processor.functions(&["__aeabi_memset", "__aeabi_memset4", "__aeabi_memset8"]);
    let clears = processor.functions(&["__aeabi_memclr", "__aeabi_memclr4", "__aeabi_memclr8"]);
    let c_fills = processor.functions(&["memset"]);
    for (name, function) in fills.into_iter().chain(clears).chain(c_fills) {
        for to in places(step(name)) {
            let arguments = |length| match name {
                "memset" => vec![TO + to, VALUE, length],
                _ => vec![TO + to, length, VALUE],
            };
            let value = if name.contains("memclr") { 0 } else { VALUE as u8 };
            for length in LENGTHS {
                processor.run(name, function, arguments, to, &vec![value; length]);
            }
        }
    }
}

/// The image before its first instruction.
struct Processor {
    debugger: Debugger,
    symbols: Vec<(String, u32)>,
    // stops the emulator when it goes
    _emulator: Emulator,
    _socket: DebuggerSocket,
}

impl Processor {
    fn start() -> Self {
        let (options, socket) = debuggable(Options { paused: true, ..options() });
        let file = std::fs::read(&options.image).unwrap();
        let image = object::File::parse(&*file).unwrap();
        let symbols = image.symbols().filter_map(|symbol| {
            Some((symbol.name().ok()?.to_owned(), u32::try_from(symbol.address()).ok()?))
        });
        let symbols = symbols.collect();
        let emulator = Emulator::launch(&options).unwrap();
        Self { debugger: stop(&socket), symbols, _emulator: emulator, _socket: socket }
    }

    /// Those of the functions that the image has.
    fn functions<'n>(&self, names: &[&'n str]) -> Vec<(&'n str, u32)> {
        let find = |name: &&'n str| {
            self.symbols.iter().find(|(symbol, _)| symbol == name).map(|(_, address)| (*name, *address))
        };
        let functions: Vec<_> = names.iter().filter_map(find).collect();
        println!("{functions:x?}");
        assert!(!functions.is_empty(), "the image has none of {names:?}");
        functions
    }

    /// Runs a function, which is to leave the `expected` bytes from `TO + to` on and to touch nothing beside them.
    fn run(
        &mut self,
        name: &str,
        function: u32,
        arguments: impl Fn(u32) -> Vec<u32>,
        to: u32,
        expected: &[u8],
    ) {
        const UNTOUCHED: u8 = 0xEE;
        let length = expected.len();
        self.debugger.write(TO, &[UNTOUCHED; ROOM]).unwrap();
        let arguments = arguments(u32::try_from(length).unwrap());
        let returned = self.debugger.call(function, &arguments, BACK).unwrap();
        let mut memory = [UNTOUCHED; ROOM];
        memory[to as usize..][..length].copy_from_slice(expected);
        assert_eq!(self.debugger.read(TO, ROOM).unwrap(), memory, "{name} of {length} bytes to {to}");
        // as the C library's functions do
        assert!(name.starts_with("__") || returned == TO + to, "{name} returns {returned:#x}");
    }
}

/// What the places of a function are multiples of, as its name promises.
fn step(name: &str) -> usize {
    name.chars().last().and_then(|digit| digit.to_digit(10)).map_or(1, |step| step as usize)
}

fn places(step: usize) -> impl Iterator<Item = u32> {
    (0..=8).step_by(step).take(4)
}
