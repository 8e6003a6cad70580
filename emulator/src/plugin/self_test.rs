//! A test of the machine that QEMU has made of the plugin's parts, before its first instruction: does the processor see
//! the registers, does its clock follow them, do interrupts arrive, does a CAN frame pass?
//!
//! Releases of QEMU differ in what the plugin builds on. One that differs too much is found here, not by firmware that
//! behaves strangely.

use super::complain;
use super::machine::{CAN1_INTERRUPTS, Machine, update};
use super::peripherals::USART_INTERRUPTS;
use super::qemu::{Inspection, Qemu};
use super::state::{State, with};
use super::system::{CAN1_BASE, RCC_BASE, tick};
use std::ffi::{CStr, c_int};
use std::fmt;
use std::ptr;

/// Set pending bits of the interrupts from 0 on, 32 a register (ARMv7-M, B3.4.5); writing the other one clears them.
const NVIC_ISPR: u64 = 0xE000_E200;
const NVIC_ICPR: u64 = 0xE000_E280;

/// `MemTxAttrs`: a secure access, without which a processor that has no security extension shows no interrupts. Releases
/// differ in which of the two lowest bits says so; the other one changes nothing here.
const SECURE: u64 = 0b11;

/// RCC registers and bits (RM0090, 7.3).
const RCC_CR: u64 = RCC_BASE;
const RCC_PLLCFGR: u64 = RCC_BASE + 0x04;
const RCC_CFGR: u64 = RCC_BASE + 0x08;
const RCC_APB1ENR: u64 = RCC_BASE + 0x40;
const HSEON: u32 = 1 << 16;
const HSERDY: u32 = 1 << 17;
const PLLON: u32 = 1 << 24;
/// The crystal's 8 MHz, divided by 8, times 336, divided by 2.
const PLL_168_MHZ: u32 = 1 << 22 | 336 << 6 | 8;
/// The PLL feeds the processor, and a quarter of its frequency the APB1.
const RUN_FROM_PLL: u32 = 0b101 << 10 | 0b10;
const CAN1EN: u32 = 1 << 25;

/// CAN registers and bits (RM0090, 32.9).
const CAN_MCR: u64 = CAN1_BASE;
const CAN_MSR: u64 = CAN1_BASE + 0x004;
const CAN_RF0R: u64 = CAN1_BASE + 0x00C;
const CAN_IER: u64 = CAN1_BASE + 0x014;
const CAN_BTR: u64 = CAN1_BASE + 0x01C;
const CAN_TI0R: u64 = CAN1_BASE + 0x180;
const CAN_TDT0R: u64 = CAN1_BASE + 0x184;
const CAN_RI0R: u64 = CAN1_BASE + 0x1B0;
const CAN_FMR: u64 = CAN1_BASE + 0x200;
const CAN_FS1R: u64 = CAN1_BASE + 0x20C;
const CAN_FA1R: u64 = CAN1_BASE + 0x21C;
const INRQ: u32 = 1 << 0;
const INAK: u32 = 1 << 0;
const FMPIE0: u32 = 1 << 1;
const FINIT: u32 = 1 << 0;
/// Silent and looped back: the controller hears itself and disturbs nobody. 1 Mbit/s at 42 MHz.
const LOOP_BACK: u32 = 0b11 << 30 | 1 << 20 | 10 << 16 | 2;
/// Identifier 0x123 with its request to send.
const FRAME: u32 = 0x123 << 21 | 1;
/// Interrupt of receive FIFO 0, an index into [`CAN1_INTERRUPTS`].
const RECEIVED: usize = 1;
/// Steps of the bus in which a frame has passed.
const STEPS: u32 = 1000;

/// The machine, as the test reaches it.
trait Access {
    /// Reads a register as the processor does.
    fn read(&self, address: u64) -> u32;
    /// Writes a register as the processor does.
    fn write(&self, address: u64, value: u32);
    /// The frequency of the processor's clock, as QEMU writes it.
    fn processor_clock(&self) -> String;
    /// Drives an interrupt line.
    fn drive(&self, interrupt: c_int, level: bool);
    /// Lets the next thing happen on the CAN bus; whether a timer was set for it.
    fn step_bus(&self) -> bool;
}

/// A part that does not work, and how it showed.
#[derive(Debug, PartialEq, Eq)]
struct Failure {
    part: &'static str,
    why: String,
}

/// All that does not work.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Failures(Vec<Failure>);

impl fmt::Display for Failures {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, Failure { part, why }) in self.0.iter().enumerate() {
            write!(formatter, "{}{part} ({why})", if index > 0 { "; " } else { "" })?;
        }
        Ok(())
    }
}

/// Tests the machine and leaves the plugin's own state as it was.
pub(super) fn run(qemu: &Qemu, machine: &Machine) -> Result<(), Failures> {
    let inspection = match Inspection::find() {
        Ok(inspection) => inspection,
        Err(name) => {
            complain(&format!("this QEMU does not export {name:?}, so the emulated board is not tested"));
            return Ok(());
        }
    };
    let (has_can, board) = with(|state| (state.has_can, std::mem::take(&mut state.board)));
    let failures = test(&Running { qemu, inspection, machine }, has_can);
    update(|state| {
        state.board = board;
        restore(state);
    });
    // SAFETY: the timer was initialised when the machine was started.
    unsafe { (qemu.timer_del)(machine.timer) };
    if failures.is_empty() { Ok(()) } else { Err(Failures(failures)) }
}

/// Nothing has been told to QEMU yet.
fn restore(state: &mut State) {
    state.sysclk_hz = 0;
    state.armed = false;
    state.starved = false;
}

fn test(machine: &impl Access, has_can: bool) -> Vec<Failure> {
    let mut failures: Vec<Failure> = Vec::new();
    let mut check = |part, result: Result<(), String>| {
        failures.extend(result.err().map(|why| Failure { part, why }));
    };
    check("clock", clock(machine));
    check("interrupts", interrupts(machine));
    if has_can {
        check("CAN", can(machine));
    }
    failures
}

/// Crystal, PLL and the processor's clock.
fn clock(machine: &impl Access) -> Result<(), String> {
    machine.write(RCC_CR, machine.read(RCC_CR) | HSEON);
    if machine.read(RCC_CR) & HSERDY == 0 {
        return Err("another RCC answers in the plugin's place".into());
    }
    machine.write(RCC_PLLCFGR, PLL_168_MHZ);
    machine.write(RCC_CR, machine.read(RCC_CR) | PLLON);
    machine.write(RCC_CFGR, RUN_FROM_PLL);
    match machine.processor_clock() {
        clock if clock == "168 MHz" => Ok(()),
        clock => Err(format!("the processor runs with {clock} instead of 168 MHz")),
    }
}

/// Each line reaches the processor as the interrupt that it is.
fn interrupts(machine: &impl Access) -> Result<(), String> {
    for interrupt in CAN1_INTERRUPTS.into_iter().chain(USART_INTERRUPTS) {
        machine.drive(interrupt, true);
        let seen = pending(machine);
        machine.drive(interrupt, false);
        clear_pending(machine);
        if seen != 1 << interrupt {
            return Err(format!("line {interrupt} arrives as {seen:#x}"));
        }
    }
    Ok(())
}

/// The controller receives a frame of its own and says so by its interrupt.
fn can(machine: &impl Access) -> Result<(), String> {
    machine.write(RCC_APB1ENR, CAN1EN);
    machine.write(CAN_MCR, INRQ);
    if machine.read(CAN_MSR) & INAK == 0 {
        return Err("the controller does not answer".into());
    }
    machine.write(CAN_BTR, LOOP_BACK);
    machine.write(CAN_IER, FMPIE0);
    let filters = machine.read(CAN_FMR);
    machine.write(CAN_FMR, filters | FINIT);
    // one filter of 32 bits whose mask lets everything through
    machine.write(CAN_FS1R, 1);
    machine.write(CAN_FA1R, 1);
    machine.write(CAN_FMR, filters & !FINIT);
    machine.write(CAN_MCR, 0);
    machine.write(CAN_TDT0R, 0);
    machine.write(CAN_TI0R, FRAME);
    let mut steps = 0;
    while machine.read(CAN_RF0R) & 0b11 == 0 {
        if steps == STEPS || !machine.step_bus() {
            return Err(format!("a frame has not passed after {steps} steps of the bus"));
        }
        steps += 1;
    }
    let received = machine.read(CAN_RI0R) >> 21;
    if received != FRAME >> 21 {
        return Err(format!("frame {received:#x} has come instead of {:#x}", FRAME >> 21));
    }
    let seen = pending(machine);
    if seen & 1 << CAN1_INTERRUPTS[RECEIVED] == 0 {
        return Err(format!("no interrupt for a received frame: {seen:#x}"));
    }
    Ok(())
}

/// The pending interrupts from 0 to 63.
fn pending(machine: &impl Access) -> u64 {
    u64::from(machine.read(NVIC_ISPR + 4)) << 32 | u64::from(machine.read(NVIC_ISPR))
}

fn clear_pending(machine: &impl Access) {
    machine.write(NVIC_ICPR, u32::MAX);
    machine.write(NVIC_ICPR + 4, u32::MAX);
}

/// The machine in the running QEMU.
struct Running<'q> {
    qemu: &'q Qemu,
    inspection: Inspection,
    machine: &'q Machine,
}

impl Running<'_> {
    fn access(&self, address: u64, value: &mut u32, is_write: bool) {
        let inspection = &self.inspection;
        let buffer = ptr::from_mut(value).cast();
        // SAFETY: the machine has its processor, and the buffer holds the four bytes that are read or written.
        unsafe {
            let space = (inspection.cpu_get_address_space)((inspection.qemu_get_cpu)(0), 0);
            (inspection.address_space_rw)(space, address, SECURE, buffer, 4, is_write);
        }
    }
}

impl Access for Running<'_> {
    fn read(&self, address: u64) -> u32 {
        let mut value = 0;
        self.access(address, &mut value, false);
        u32::from_le(value)
    }

    fn write(&self, address: u64, value: u32) {
        self.access(address, &mut value.to_le(), true);
    }

    fn processor_clock(&self) -> String {
        let inspection = &self.inspection;
        // SAFETY: the processor is a device; the text is a C string of this process's allocator.
        unsafe {
            let clock = (inspection.qdev_get_clock_in)(self.machine.processor, c"cpuclk".as_ptr());
            if clock.is_null() {
                return "no clock".into();
            }
            let text = (inspection.clock_display_freq)(clock);
            let frequency = CStr::from_ptr(text).to_string_lossy().into_owned();
            libc::free(text.cast());
            frequency
        }
    }

    fn drive(&self, interrupt: c_int, level: bool) {
        let qemu = self.qemu;
        // SAFETY: the processor is a device with a line for each interrupt.
        unsafe {
            let line = (qemu.qdev_get_gpio_in)(self.machine.processor, interrupt);
            (qemu.qemu_set_irq)(line, level.into());
        }
    }

    fn step_bus(&self) -> bool {
        // SAFETY: the timer was initialised when the machine was started.
        let is_set = unsafe { (self.inspection.timer_pending)(self.machine.timer) };
        if is_set {
            tick(ptr::null_mut());
        }
        is_set
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Board;
    use std::cell::RefCell;

    /// A way in which a release of QEMU may differ.
    #[derive(Clone, Copy, PartialEq, Eq)]
    enum Flaw {
        None,
        /// QEMU's own clock control lies over the plugin's.
        OtherRcc,
        /// The processor's clock is not the one that the plugin sets.
        OtherClock,
        /// An interrupt has another number.
        OtherNumbers,
        /// Timers are never set.
        NoTimers,
        /// The controller's registers are not there.
        NoCan,
    }

    /// The board without QEMU.
    struct Bare {
        flaw: Flaw,
        board: RefCell<Board>,
        pending: RefCell<u64>,
    }

    impl Bare {
        fn new(flaw: Flaw) -> Self {
            Self { flaw, board: RefCell::new(Board::new()), pending: RefCell::new(0) }
        }

        fn latch(&self) {
            let now = self.board.borrow().interrupts();
            for (level, interrupt) in
                [now.transmit, now.receive[0], now.receive[1], now.status].into_iter().zip(CAN1_INTERRUPTS)
            {
                *self.pending.borrow_mut() |= u64::from(level) << interrupt;
            }
        }
    }

    impl Access for Bare {
        fn read(&self, address: u64) -> u32 {
            let mut board = self.board.borrow_mut();
            match address {
                RCC_BASE.. if address < RCC_BASE + 0x400 => match self.flaw {
                    Flaw::OtherRcc => 0,
                    _ => board.read_rcc((address - RCC_BASE) as u32),
                },
                CAN1_BASE.. if address < CAN1_BASE + 0x400 => match self.flaw {
                    Flaw::NoCan => 0,
                    _ => board.read_can((address - CAN1_BASE) as u32),
                },
                NVIC_ISPR => *self.pending.borrow() as u32,
                _ if address == NVIC_ISPR + 4 => (*self.pending.borrow() >> 32) as u32,
                _ => unreachable!("{address:#x}"),
            }
        }

        fn write(&self, address: u64, value: u32) {
            match address {
                RCC_BASE.. if address < RCC_BASE + 0x400 => {
                    self.board.borrow_mut().write_rcc((address - RCC_BASE) as u32, value);
                }
                CAN1_BASE.. if address < CAN1_BASE + 0x400 => {
                    self.board.borrow_mut().write_can((address - CAN1_BASE) as u32, value);
                }
                _ => *self.pending.borrow_mut() = 0,
            }
            self.latch();
        }

        fn processor_clock(&self) -> String {
            let hz = self.board.borrow().sysclk_hz();
            if self.flaw == Flaw::OtherClock { "1 GHz".into() } else { format!("{} MHz", hz / 1_000_000) }
        }

        fn drive(&self, interrupt: c_int, level: bool) {
            let number = interrupt + c_int::from(self.flaw == Flaw::OtherNumbers);
            *self.pending.borrow_mut() |= u64::from(level) << number;
        }

        fn step_bus(&self) -> bool {
            self.board.borrow_mut().step();
            self.latch();
            self.flaw != Flaw::NoTimers
        }
    }

    fn failures(flaw: Flaw) -> String {
        Failures(test(&Bare::new(flaw), true)).to_string()
    }

    #[test]
    fn a_machine_that_works_passes() {
        assert_eq!(failures(Flaw::None), "");
    }

    #[test]
    fn each_part_that_does_not_work_is_named() {
        for (flaw, message) in [
            (Flaw::OtherRcc, "clock (another RCC answers in the plugin's place)"),
            (Flaw::OtherClock, "clock (the processor runs with 1 GHz instead of 168 MHz)"),
            (Flaw::OtherNumbers, "interrupts (line 19 arrives as 0x100000)"),
            (Flaw::NoTimers, "CAN (a frame has not passed after 0 steps of the bus)"),
            (Flaw::NoCan, "CAN (the controller does not answer)"),
        ] {
            assert!(failures(flaw).contains(message), "{}", failures(flaw));
        }
    }

    #[test]
    fn without_a_controller_the_rest_is_tested() {
        assert_eq!(test(&Bare::new(Flaw::NoCan), false), []);
    }
}
