//! The registers of clock control, CAN controller, flash and watchdog, and the character devices `can0` and `canctl`.

use super::machine::{MACHINE, forget, overlay, qemu, resume, update};
use super::part::Part;
use super::peripherals;
use super::port::{Handlers, received};
use super::qemu::{CHARDEV_CLOSED, CHARDEV_OPENED, GUEST_RESET, Pointer, Qemu, RegionOps};
use super::state::with;
use crate::{bxcan, flash, iwdg, rcc};
use std::ffi::{c_int, c_uint};
use std::ptr;

pub(super) const CAN1_BASE: u64 = 0x4000_6400;
pub(super) const RCC_BASE: u64 = 0x4002_3800;
const IWDG_BASE: u64 = 0x4000_3000;
const FLASH_BASE: u64 = 0x4002_3C00;

static CAN_OPS: RegionOps = RegionOps::new(read_can, write_can, 4);
static RCC_OPS: RegionOps = RegionOps::new(read_rcc, write_rcc, 1);
static FLASH_OPS: RegionOps = RegionOps::new(read_flash_register, write_flash_register, 4);
static IWDG_OPS: RegionOps = RegionOps::new(read_watchdog, write_watchdog, 1);
static SECTORS_OPS: RegionOps = RegionOps::new(read_sectors, write_sectors, 1);
pub(super) static CAN_HANDLERS: Handlers =
    Handlers { room: can_room, read: can_read, event: can_event, writable: can_writable };
pub(super) static CONSOLE_HANDLERS: Handlers =
    Handlers { room: console_room, read: console_read, event: console_event, writable: console_writable };

/// Lays the registers over what QEMU has in their place.
pub(super) fn start(qemu: &Qemu) {
    let none = ptr::null_mut();
    overlay(qemu, IWDG_BASE, iwdg::SIZE, &IWDG_OPS, none, c"jointbus.iwdg");
    if with(|state| state.has_can) {
        overlay(qemu, CAN1_BASE, bxcan::SIZE, &CAN_OPS, none, c"jointbus.can1");
    }
    overlay(qemu, RCC_BASE, rcc::SIZE, &RCC_OPS, none, c"jointbus.rcc");
    overlay(qemu, FLASH_BASE, flash::SIZE, &FLASH_OPS, none, c"jointbus.flash");
    let sectors = u64::from(flash::SECTORS_BASE);
    overlay(qemu, sectors, flash::SECTORS_SIZE, &SECTORS_OPS, none, c"jointbus.flash-sectors");
}

pub(super) extern "C" fn reset(_opaque: Pointer) {
    update(|state| {
        // The first one is the power-on after which the board was made.
        if std::mem::replace(&mut state.started, true) {
            state.board.reset(peripherals::now());
        }
    });
    if let Some(machine) = MACHINE.get() {
        // SAFETY: the timer was initialised before anything could be reset.
        unsafe { (qemu().timer_del)(machine.watchdog) };
    }
}

/// The watchdog was not fed in time.
pub(super) extern "C" fn bite(_opaque: Pointer) {
    with(|state| state.board.watchdog_bites());
    // SAFETY: the reason is one of QEMU's.
    unsafe { (qemu().qemu_system_reset_request)(GUEST_RESET) };
}

pub(super) extern "C" fn tick(_opaque: Pointer) {
    let next = update(|state| {
        let next = state.board.step();
        // What `update` would announce comes after this.
        state.armed = next.is_some();
        next
    });
    if let (Some(next), Some(machine)) = (next, MACHINE.get()) {
        machine.set_timer(qemu(), machine.timer, next);
    }
}

extern "C" fn read_can(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(with(|state| state.board.read_can(offset as u32)))
}

extern "C" fn write_can(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    update(|state| state.board.write_can(offset as u32, value as u32));
}

extern "C" fn read_rcc(_opaque: Pointer, offset: u64, size: c_uint) -> u64 {
    let part = Part::of(offset, size);
    u64::from(part.read(with(|state| state.board.read_rcc(part.register))))
}

extern "C" fn write_rcc(_opaque: Pointer, offset: u64, value: u64, size: c_uint) {
    let part = Part::of(offset, size);
    update(|state| {
        let whole = part.write(state.board.read_rcc(part.register), value as u32);
        state.board.write_rcc(part.register, whole);
    });
}

extern "C" fn read_flash_register(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(with(|state| state.board.flash().read_register(offset as u32)))
}

extern "C" fn write_flash_register(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    with(|state| {
        let change = state.board.write_flash_register(offset as u32, value as u32);
        state.keep(change);
    });
}

extern "C" fn read_sectors(_opaque: Pointer, offset: u64, size: c_uint) -> u64 {
    u64::from(with(|state| state.board.flash().read(offset as u32, size)))
}

extern "C" fn write_sectors(_opaque: Pointer, offset: u64, value: u64, size: c_uint) {
    with(|state| {
        let change = state.board.program_flash(offset as u32, value as u32, size);
        state.keep(change);
    });
}

extern "C" fn read_watchdog(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(with(|state| state.board.read_watchdog(offset as u32)))
}

extern "C" fn write_watchdog(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    let period = with(|state| {
        let period = state.board.write_watchdog(offset as u32, value as u32);
        period.filter(|_| state.watchdog)
    });
    if let (Some(period), Some(machine)) = (period, MACHINE.get()) {
        machine.set_timer(qemu(), machine.watchdog, period);
    }
}

extern "C" fn can_room(_opaque: Pointer) -> c_int {
    with(|state| {
        let room = state.board.can_room();
        state.starved |= room == 0;
        room as c_int
    })
}

extern "C" fn can_read(_opaque: Pointer, bytes: *const u8, length: c_int) {
    // SAFETY: QEMU hands over that many bytes for the time of the call.
    let bytes = unsafe { received(bytes, length) };
    update(|state| state.board.take_can_bytes(bytes));
}

extern "C" fn can_event(_opaque: Pointer, event: c_int) {
    if let CHARDEV_OPENED | CHARDEV_CLOSED = event {
        with(|state| state.board.can_client_connected());
        forget(|machine| machine.can.as_ref());
    }
}

extern "C" fn can_writable(_unused: Pointer, _condition: c_uint, _opaque: Pointer) -> c_int {
    resume(|machine| machine.can.as_ref())
}

extern "C" fn console_room(_opaque: Pointer) -> c_int {
    256
}

extern "C" fn console_read(_opaque: Pointer, bytes: *const u8, length: c_int) {
    // SAFETY: QEMU hands over that many bytes for the time of the call.
    let bytes = unsafe { received(bytes, length) };
    update(|state| state.board.take_console_bytes(bytes));
}

extern "C" fn console_event(_opaque: Pointer, event: c_int) {
    if let CHARDEV_OPENED | CHARDEV_CLOSED = event {
        forget(|machine| machine.console.as_ref());
    }
}

extern "C" fn console_writable(_unused: Pointer, _condition: c_uint, _opaque: Pointer) -> c_int {
    resume(|machine| machine.console.as_ref())
}
