//! The machine that QEMU has given the plugin, and how it is told of changes.

use super::peripherals::{self, Serial};
use super::port::Port;
use super::qemu::{CLOCK_VIRTUAL, Pointer, Qemu, RegionOps, SCALE_NS, opaque_structure};
use super::state::{Effects, State, with};
use super::system;
use std::ffi::{CStr, c_int};
use std::ptr;
use std::sync::OnceLock;

/// CAN1_TX, CAN1_RX0, CAN1_RX1, CAN1_SCE.
pub(super) const CAN1_INTERRUPTS: [c_int; 4] = [19, 20, 21, 22];
/// Shortest time that a timer is set to.
const SHORTEST_NS: u64 = 1000;

pub(super) static QEMU: OnceLock<Qemu> = OnceLock::new();
pub(super) static MACHINE: OnceLock<Machine> = OnceLock::new();

/// The machine that QEMU has given us.
pub(super) struct Machine {
    pub(super) processor: Pointer,
    pub(super) interrupts: [Pointer; 4],
    pub(super) clock: Pointer,
    pub(super) timer: Pointer,
    pub(super) watchdog: Pointer,
    pub(super) can: Option<Port>,
    pub(super) console: Option<Port>,
    /// USART2 and USART3, where they are not QEMU's.
    pub(super) serial: [Option<Serial>; 2],
}

// SAFETY: the pointers are only used by QEMU's functions, which its big lock serialises.
unsafe impl Send for Machine {}
// SAFETY: as above.
unsafe impl Sync for Machine {}

pub(super) fn qemu() -> &'static Qemu {
    QEMU.get().expect("installed before anything else is called")
}

impl Machine {
    pub(super) fn find(qemu: &Qemu) -> Result<Self, String> {
        let find = |path: &CStr, kind: &CStr| {
            // SAFETY: both are C strings, and whether there were several is not asked.
            unsafe { (qemu.object_resolve_path_type)(path.as_ptr(), kind.as_ptr(), ptr::null_mut()) }
        };
        let processor = find(c"", c"armv7m");
        if processor.is_null() || find(c"", c"stm32f405-soc").is_null() {
            return Err("this machine has no STM32F405; use -M netduinoplus2".into());
        }
        Ok(Self {
            processor,
            // SAFETY: the processor is a device with a line for each interrupt.
            interrupts: CAN1_INTERRUPTS.map(|number| unsafe { (qemu.qdev_get_gpio_in)(processor, number) }),
            clock: find(c"/machine/SYSCLK", c"clock"),
            timer: opaque_structure(),
            watchdog: opaque_structure(),
            can: Port::open(qemu, c"can0", &system::CAN_HANDLERS, ptr::null_mut()),
            console: Port::open(qemu, c"canctl", &system::CONSOLE_HANDLERS, ptr::null_mut()),
            serial: [0, 1].map(|index| Serial::find(qemu, index, processor)),
        })
    }

    pub(super) fn start(&self, qemu: &Qemu) {
        let none = ptr::null_mut();
        // SAFETY: the timer's memory is large enough and lives as long as the process, like the function.
        unsafe { (qemu.timer_init_full)(self.timer, none, CLOCK_VIRTUAL, SCALE_NS, 0, system::tick, none) };
        // SAFETY: as above.
        unsafe {
            (qemu.timer_init_full)(self.watchdog, none, CLOCK_VIRTUAL, SCALE_NS, 0, system::bite, none)
        };
        system::start(qemu);
        peripherals::start(qemu);
        for (index, serial) in self.serial.iter().enumerate() {
            if let Some(serial) = serial {
                serial.start(qemu, index);
            }
        }
        if let Some(port) = &self.can {
            port.start(qemu, &system::CAN_HANDLERS);
        }
        if let Some(port) = &self.console {
            port.start(qemu, &system::CONSOLE_HANDLERS);
        }
        // SAFETY: the function lives as long as the process.
        unsafe { (qemu.qemu_register_reset)(system::reset, none) };
    }
}

/// Lays registers over what QEMU has at an address.
pub(super) fn overlay(
    qemu: &Qemu,
    base: u64,
    size: u32,
    ops: &'static RegionOps,
    opaque: Pointer,
    name: &CStr,
) {
    let (region, none) = (opaque_structure(), ptr::null_mut());
    // SAFETY: the region's memory is large enough; it and the functions live as long as the process.
    unsafe {
        (qemu.memory_region_init_io)(region, none, ops, opaque, name.as_ptr(), u64::from(size));
        (qemu.memory_region_add_subregion_overlap)((qemu.get_system_memory)(), base, region, 1);
    }
}

impl Machine {
    fn apply(&self, qemu: &Qemu, effects: &Effects) {
        for &(line, level) in &effects.lines {
            // SAFETY: the line is an input of the processor.
            unsafe { (qemu.qemu_set_irq)(self.interrupts[line], c_int::from(level)) };
        }
        if let Some(hz) = effects.sysclk_hz {
            self.set_clock(qemu, hz);
        }
        if let Some(delay) = effects.deadline_ns {
            self.set_timer(qemu, self.timer, delay);
        }
        send(qemu, self.can.as_ref(), &effects.can_output);
        send(qemu, self.console.as_ref(), &effects.console_output);
        if let Some(port) = self.can.as_ref().filter(|_| effects.accept_input) {
            port.accept_input(qemu);
        }
        for (serial, effects) in self.serial.iter().zip(&effects.serial) {
            if let Some(serial) = serial {
                serial.apply(qemu, effects);
            }
        }
    }

    fn set_clock(&self, qemu: &Qemu, hz: u32) {
        if self.clock.is_null() {
            return;
        }
        let period = (1_000_000_000_u64 << 32) / u64::from(hz.max(1));
        // SAFETY: the clock is the machine's own, which nothing else drives.
        unsafe {
            if (qemu.clock_set)(self.clock, period) {
                (qemu.clock_propagate)(self.clock);
            }
        }
    }

    pub(super) fn set_timer(&self, qemu: &Qemu, timer: Pointer, delay: u64) {
        let delay = i64::try_from(delay.max(SHORTEST_NS)).unwrap_or(i64::MAX / 2);
        // SAFETY: the timer was initialised before anything could set it.
        unsafe { (qemu.timer_mod_ns)(timer, (qemu.qemu_clock_get_ns)(CLOCK_VIRTUAL).saturating_add(delay)) };
    }
}

fn send(qemu: &Qemu, port: Option<&Port>, bytes: &[u8]) {
    if let Some(port) = port.filter(|_| !bytes.is_empty()) {
        port.send(qemu, bytes);
    }
}

/// Does something with the state, then tells QEMU what has come of it.
pub(super) fn update<R>(action: impl FnOnce(&mut State) -> R) -> R {
    let (result, effects) = with(|state| {
        let result = action(state);
        (result, state.effects())
    });
    if let Some(machine) = MACHINE.get() {
        machine.apply(qemu(), &effects);
    }
    result
}

pub(super) fn forget(port: impl FnOnce(&'static Machine) -> Option<&'static Port>) {
    if let Some(port) = MACHINE.get().and_then(port) {
        port.forget();
    }
}

/// Sends more to a client that has made room; ends the watch, for a new one is set where needed.
pub(super) fn resume(port: impl FnOnce(&'static Machine) -> Option<&'static Port>) -> c_int {
    if let Some(port) = MACHINE.get().and_then(port) {
        port.resume(qemu());
    }
    0
}
