//! Whatever stands still or faults leads to a reset that tells its cause.

use super::*;
use jointbus::bench::OUTPUTS_UNIT;
use jointbus::client::WordOrder;
use jointbus::clock::Clock;
use jointbus_mcu_bridge::registers::{self, command};

#[test]
fn a_hard_fault_leads_to_a_reset_whose_cause_is_told() {
    let (options, debugger) = debuggable(options());
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1);
    set_register(&debugger, Debugger::PC, 0xF000_0000);
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 5));
    client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::REBOOT).unwrap();
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 3));
}

#[test]
fn a_main_loop_that_stands_still_is_reset_by_the_watchdog() {
    let (options, debugger) = debuggable(watched());
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1, "it was fed all the time");
    set_register(&debugger, Debugger::PC, standstill());
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 4));
}

#[test]
fn a_stack_that_overflows_leads_to_a_reset_whose_cause_is_told() {
    let (options, debugger) = debuggable(options());
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().reset_cause, 1);
    // as though the main loop had used all but 16 bytes: the next interrupt pushes more than that
    set_register(&debugger, Debugger::SP, STACK + 16);
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 5));
}

#[test]
fn a_tick_that_stops_is_noticed_by_the_watchdog() {
    const SYST_CSR: u32 = 0xE000_E010;
    // idle time passes as it does for the host, so that its questions keep the main loop turning
    let (options, debugger) = debuggable(Options { skip_idle: false, ..watched() });
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    store(&debugger, SYST_CSR, 0);
    client.set_timeout(Duration::from_millis(500));
    // each of these questions turns the main loop, which alone would feed the watchdog
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 4));
}

#[test]
fn a_port_that_sends_nothing_any_more_is_noticed_by_the_watchdog() {
    const NVIC_ICER1: u32 = 0xE000_E184;
    const USART2: u32 = 1 << (38 - 32);
    let (options, debugger) = debuggable(watched());
    let bench = Bench::emulated(&options).unwrap();
    let mut client = bench.client().unwrap();
    client.nst(RS485_A_UNIT).sample().unwrap();
    store(&debugger, NVIC_ICER1, USART2);
    client.set_timeout(Duration::from_millis(500));
    assert!(client.nst(RS485_A_UNIT).sample().is_err(), "it has something to send");
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 4));
}

#[test]
fn interrupts_keep_no_floating_point_registers() {
    /// Automatic and lazy keeping, as they are after a reset.
    const FPCCR: u32 = 0xE000_EF34;
    const KEEPING: u32 = 0b11 << 30;
    let (options, debugger) = debuggable(Options { paused: true, ..options() });
    let emulator = Emulator::launch(&options).unwrap();
    assert_eq!(load(&debugger, FPCCR) & KEEPING, KEEPING, "before the first instruction");
    let bench = Bench::with(Bridge::Emulated(Box::new(emulator)), Clock::default()).unwrap();
    let mut client = bench.client().unwrap();
    bridge::about(&mut client).unwrap();
    assert_eq!(load(&debugger, FPCCR) & KEEPING, 0);
}

#[test]
fn no_request_uses_more_stack_than_there_is() {
    const PAINT: u8 = 0xA5;
    let (options, debugger) = debuggable(Options { paused: true, ..options() });
    let emulator = Emulator::launch(&options).unwrap();
    let mut stopped = stop(&debugger);
    // the first word of the image is where its stack starts
    let top = u32::from_le_bytes(stopped.read(0x0800_0000, 4).unwrap().try_into().unwrap());
    let size = usize::try_from(top - STACK).unwrap();
    stopped.write(STACK, &vec![PAINT; size]).unwrap();
    stopped.resume().unwrap();

    let bench = Bench::with(Bridge::Emulated(Box::new(emulator)), Clock::default()).unwrap();
    let mut client = bench.client().unwrap();
    for _ in 0..3 {
        client.nst(CAN_UNIT).write(0x00E3, &[7; 144]).unwrap();
        client.nst(CAN_UNIT).read(0x0000, 227).unwrap();
        client.nst(RS485_A_UNIT).read(0x0000, 227).unwrap();
        client.modbus(RS485_B_UNIT).read_input_registers(0x0040, 8).unwrap();
        client.modbus(OUTPUTS_UNIT).read_holding_values::<u32>(4, 2, WordOrder::LowFirst).unwrap();
        client.modbus(bridge::UNIT).read_input_registers(0, 120).unwrap();
        client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::SAVE).unwrap();
    }
    let mut stopped = stop(&debugger);
    let stack = stopped.read(STACK, size).unwrap();
    stopped.resume().unwrap();
    let untouched = stack.iter().take_while(|byte| **byte == PAINT).count();
    println!("{} of {size} bytes of stack used", size - untouched);
    assert!(untouched > 0 && untouched < size, "{untouched} bytes of {size} are untouched");
}

/// Where the stack ends: at the start of the RAM.
const STACK: u32 = 0x2000_0000;

/// With a watchdog that bites.
fn watched() -> Options {
    Options { watchdog: true, ..counted() }
}

fn set_register(debugger: &DebuggerSocket, register: u8, value: u32) {
    let mut stopped = stop(debugger);
    stopped.set_register(register, value).unwrap();
    stopped.resume().unwrap();
}

/// Has the processor store a word, because the debugger's port reaches no registers of peripherals.
pub(super) fn store(debugger: &DebuggerSocket, address: u32, value: u32) {
    copy(debugger, SCRATCH, address, value);
}

/// Has the processor load a word, for the same reason.
fn load(debugger: &DebuggerSocket, address: u32) -> u32 {
    copy(debugger, address, SCRATCH, 0);
    scratch(debugger, SCRATCH)
}

fn scratch(debugger: &DebuggerSocket, address: u32) -> u32 {
    let mut stopped = stop(debugger);
    let value = u32::from_le_bytes(stopped.read(address, 4).unwrap().try_into().unwrap());
    stopped.resume().unwrap();
    value
}

/// A word at the end of the stack, which is not in use.
const SCRATCH: u32 = STACK;

/// Puts a value into the scratch word, and then has the processor copy a word; waits until it has.
fn copy(debugger: &DebuggerSocket, from: u32, to: u32, value: u32) {
    const DONE: u32 = SCRATCH + 4;
    const PLACE: u32 = SCRATCH + 8;
    let mut stopped = stop(debugger);
    let back = stopped.register(Debugger::PC).unwrap();
    let code: [u16; 10] = [
        0xB403, // push {r0, r1}
        0x4804, // ldr r0, the address that it comes from
        0x6800, // ldr r0, [r0]
        0x4904, // ldr r1, the address that it goes to
        0x6008, // str r0, [r1]
        0x4904, // ldr r1, the address of the word that says that it is done
        0x6009, // str r1, [r1]
        0xBC03, // pop {r0, r1}
        0xF8DF, 0xF00C, // ldr pc, the way back
    ];
    let mut bytes = [value.to_le_bytes(), [0; 4]].concat();
    bytes.extend(code.iter().flat_map(|half| half.to_le_bytes()));
    for word in [from, to, DONE, back | 1] {
        bytes.extend(word.to_le_bytes());
    }
    stopped.write(SCRATCH, &bytes).unwrap();
    stopped.set_register(Debugger::PC, PLACE).unwrap();
    stopped.resume().unwrap();
    until(|| scratch(debugger, DONE) == DONE);
}

/// An address in the image at which the processor jumps to where it is.
fn standstill() -> u32 {
    const BRANCH_TO_ITSELF: [u8; 2] = [0xFE, 0xE7];
    const FLASH: u32 = 0x0800_0000;
    let binary = std::fs::read(common::image().with_extension("bin")).unwrap();
    let place = binary.as_chunks::<2>().0.iter().position(|code| *code == BRANCH_TO_ITSELF);
    FLASH + 2 * u32::try_from(place.expect("every image has such an instruction")).unwrap()
}
