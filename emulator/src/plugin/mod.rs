//! Hangs a [`Board`] into QEMU's STM32F405 machine: registers over the regions that QEMU leaves unimplemented,
//! interrupt lines, the processor's clock, timers, and character devices: `can0`, `canctl`, `usart2` and `usart3`.
//!
//! QEMU calls everything here with its big lock held, so calls never overlap; the mutexes are there because the
//! language wants to see that, and none is held while QEMU is called.

mod options;
mod part;
mod peripherals;
mod port;
mod qemu;
mod self_test;

use crate::board::Board;
use crate::control::Control;
use crate::{bxcan, flash, iwdg, rcc};
use options::Options;
use part::Part;
use peripherals::{Serial, SerialEffects, SerialState};
use port::{Handlers, Port};
use qemu::{
    CHARDEV_CLOSED, CHARDEV_OPENED, CLOCK_VIRTUAL, GUEST_RESET, Info, Notifier, Pointer, Qemu, RegionOps,
    SCALE_NS,
};
use std::ffi::{CStr, c_char, c_int, c_uint};
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::ptr;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock};

const CAN1_BASE: u64 = 0x4000_6400;
const RCC_BASE: u64 = 0x4002_3800;
const IWDG_BASE: u64 = 0x4000_3000;
const FLASH_BASE: u64 = 0x4002_3C00;
/// CAN1_TX, CAN1_RX0, CAN1_RX1, CAN1_SCE.
const CAN1_INTERRUPTS: [c_int; 4] = [19, 20, 21, 22];
/// Shortest time that a timer is set to.
const SHORTEST_NS: u64 = 1000;
/// The oldest release that this was tried with; an older one is refused.
const OLDEST: (i64, i64) = (7, 2);
/// The newest release that this was tried with; the self-test has the last word on a newer one.
const NEWEST: (i64, i64) = (10, 0);

/// Version of QEMU's plugin interface, which QEMU reads before it calls [`qemu_plugin_install`]. Releases up to 8.2 take
/// version 1 at most, later ones version 2 at least.
#[unsafe(no_mangle)]
#[allow(non_upper_case_globals)]
static qemu_plugin_version: AtomicI32 = AtomicI32::new(1);

/// Runs when the library is loaded.
#[used]
#[cfg_attr(target_os = "linux", unsafe(link_section = ".init_array"))]
#[cfg_attr(target_os = "macos", unsafe(link_section = "__DATA,__mod_init_func"))]
static ON_LOAD: extern "C" fn() = choose_version;

/// Scoreboards came with version 2 of the interface.
extern "C" fn choose_version() {
    if qemu::exports(c"qemu_plugin_scoreboard_new") {
        qemu_plugin_version.store(2, Ordering::Relaxed);
    }
}

static CAN_OPS: RegionOps = RegionOps::new(read_can, write_can, 4);
static RCC_OPS: RegionOps = RegionOps::new(read_rcc, write_rcc, 1);
static FLASH_OPS: RegionOps = RegionOps::new(read_flash_register, write_flash_register, 4);
static IWDG_OPS: RegionOps = RegionOps::new(read_watchdog, write_watchdog, 1);
static SECTORS_OPS: RegionOps = RegionOps::new(read_sectors, write_sectors, 1);
static CAN_HANDLERS: Handlers =
    Handlers { room: can_room, read: can_read, event: can_event, writable: can_writable };
static CONSOLE_HANDLERS: Handlers =
    Handlers { room: console_room, read: console_read, event: console_event, writable: console_writable };

static QEMU: OnceLock<Qemu> = OnceLock::new();
static STATE: Mutex<Option<State>> = Mutex::new(None);
static MACHINE: OnceLock<Machine> = OnceLock::new();

/// What changes while the machine runs.
struct State {
    board: Board,
    /// Levels last driven, in the order of [`CAN1_INTERRUPTS`].
    levels: [bool; 4],
    sysclk_hz: u32,
    /// A step of the bus is announced.
    armed: bool,
    /// The client was told that there is no room.
    starved: bool,
    /// The machine has been reset once: it has started.
    started: bool,
    /// Keeps the flash's sectors when QEMU ends, however it ends.
    flash: Option<File>,
    /// Whether the independent watchdog bites.
    watchdog: bool,
    /// Whether there is a CAN controller.
    has_can: bool,
    /// QEMU ends after the self-test.
    self_test_only: bool,
    /// USART2 and USART3.
    serial: [SerialState; 2],
}

/// What QEMU has given us.
struct Machine {
    processor: Pointer,
    interrupts: [Pointer; 4],
    clock: Pointer,
    timer: Pointer,
    watchdog: Pointer,
    can: Option<Port>,
    console: Option<Port>,
    /// USART2 and USART3, where they are not QEMU's.
    serial: [Option<Serial>; 2],
}

// SAFETY: the pointers are only used by QEMU's functions, which its big lock serialises.
unsafe impl Send for Machine {}
// SAFETY: as above.
unsafe impl Sync for Machine {}

/// QEMU's way in: checks what can be checked, then waits for the machine.
///
/// # Safety
/// To be called by QEMU only, with the arguments that its plugin interface documents.
#[unsafe(no_mangle)]
unsafe extern "C" fn qemu_plugin_install(
    _id: u64,
    info: *const Info,
    argc: c_int,
    argv: *const *const c_char,
) -> c_int {
    // SAFETY: QEMU hands over its own structure, and as many C strings as it says.
    let installed = unsafe { arguments(argc, argv).and_then(|arguments| install(&*info, &arguments)) };
    match installed {
        Ok(()) => 0,
        Err(message) => {
            complain(&message);
            1
        }
    }
}

/// # Safety
/// `argv` must point to `argc` C strings.
unsafe fn arguments(argc: c_int, argv: *const *const c_char) -> Result<Vec<String>, String> {
    (0..usize::try_from(argc).unwrap_or(0))
        .map(|i| {
            // SAFETY: the caller says that there are that many.
            let argument = unsafe { CStr::from_ptr(*argv.add(i)) };
            argument.to_str().map(String::from).map_err(|error| error.to_string())
        })
        .collect()
}

fn install(info: &Info, arguments: &[String]) -> Result<(), String> {
    let options = Options::parse(arguments.iter().map(String::as_str))?;
    // SAFETY: QEMU names its target by a C string.
    let target = unsafe { CStr::from_ptr(info.target_name) };
    if !info.system_emulation || target != c"arm" {
        return Err(format!("this is for qemu-system-arm, not for {target:?}"));
    }
    let qemu = Qemu::find().map_err(|name| {
        format!("this QEMU does not export {name:?}; one that is built with loadable modules does")
    })?;
    check_version(&qemu)?;
    let mut board = Board::new();
    board.apply(Control::Crystal(options.crystal));
    let flash = options.flash.map(|path| open_flash(&path, &mut board)).transpose()?;
    let sysclk_hz = 0; // Not set yet; the first update does.
    *lock() = Some(State {
        board,
        levels: [false; 4],
        sysclk_hz,
        armed: false,
        starved: false,
        started: false,
        flash,
        watchdog: options.watchdog,
        has_can: options.can,
        self_test_only: options.self_test_only,
        serial: Default::default(),
    });
    let notifier = Notifier { notify: machine_complete, next: ptr::null_mut(), previous: ptr::null_mut() };
    let qemu = QEMU.get_or_init(|| qemu);
    // SAFETY: the notifier lives as long as the process.
    unsafe { (qemu.qemu_add_machine_init_done_notifier)(Box::leak(Box::new(notifier))) };
    Ok(())
}

/// Opens the file that keeps the flash and puts what it holds into the board; a new file is erased flash.
fn open_flash(path: &Path, board: &mut Board) -> Result<File, String> {
    let told = |error: io::Error| format!("{}: {error}", path.display());
    let mut file =
        File::options().read(true).write(true).create(true).truncate(false).open(path).map_err(told)?;
    let mut content = Vec::new();
    file.read_to_end(&mut content).map_err(told)?;
    board.load_flash(&content);
    file.write_all_at(board.flash().bytes(), 0).map_err(told)?;
    Ok(file)
}

/// The release of the running QEMU.
fn version(qemu: &Qemu) -> qemu::VersionTriple {
    // SAFETY: QEMU allocates both structures and fills them in.
    unsafe { *(*(qemu.qmp_query_version)(ptr::null_mut())).version }
}

/// Refuses releases that are too old. Structures of newer ones may be laid out differently: the self-test tells.
fn check_version(qemu: &Qemu) -> Result<(), String> {
    let found = version(qemu);
    if (found.major, found.minor) >= OLDEST {
        return Ok(());
    }
    Err(format!("this is QEMU {found}; 7.2 is the oldest that the plugin works in"))
}

fn complain(message: &str) {
    eprintln!("jointbus emulator plugin: {message}");
}

fn lock() -> MutexGuard<'static, Option<State>> {
    STATE.lock().expect("no panic is survived")
}

fn with<R>(action: impl FnOnce(&mut State) -> R) -> R {
    action(lock().as_mut().expect("installed before anything else is called"))
}

fn qemu() -> &'static Qemu {
    QEMU.get().expect("installed before anything else is called")
}

/// The machine has its processor and its character devices.
extern "C" fn machine_complete(_notifier: *mut Notifier, _data: Pointer) {
    match Machine::find(qemu()) {
        Ok(machine) => {
            let machine = MACHINE.get_or_init(|| machine);
            machine.start(qemu());
            check(machine);
        }
        Err(message) => {
            complain(&message);
            std::process::exit(1);
        }
    }
}

/// Has the machine tested, and ends QEMU where it does not work or nothing else is wanted. The reset with which every
/// machine starts comes after this and clears what the test has left in the processor.
fn check(machine: &Machine) {
    let found = version(qemu());
    let result = self_test::run(qemu(), machine);
    let is_last = with(|state| state.self_test_only);
    match result {
        Ok(()) if is_last => {
            println!("clock, interrupts and CAN work in QEMU {found}");
            std::process::exit(0);
        }
        Ok(()) => {}
        Err(failures) => {
            let newer = (found.major, found.minor) > NEWEST;
            let age = if newer { ", which is newer than those that the plugin was tried with" } else { "" };
            complain(&format!("the emulated board does not work in QEMU {found}{age}: {failures}"));
            std::process::exit(1);
        }
    }
}

impl Machine {
    fn find(qemu: &Qemu) -> Result<Self, String> {
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
            timer: qemu::opaque_structure(),
            watchdog: qemu::opaque_structure(),
            can: Port::open(qemu, c"can0", &CAN_HANDLERS, ptr::null_mut()),
            console: Port::open(qemu, c"canctl", &CONSOLE_HANDLERS, ptr::null_mut()),
            serial: [0, 1].map(|index| Serial::find(qemu, index, processor)),
        })
    }

    fn start(&self, qemu: &Qemu) {
        let none = ptr::null_mut();
        // SAFETY: the timer's memory is large enough and lives as long as the process, like the function.
        unsafe { (qemu.timer_init_full)(self.timer, none, CLOCK_VIRTUAL, SCALE_NS, 0, tick, none) };
        // SAFETY: as above.
        unsafe { (qemu.timer_init_full)(self.watchdog, none, CLOCK_VIRTUAL, SCALE_NS, 0, bite, none) };
        overlay(qemu, IWDG_BASE, iwdg::SIZE, &IWDG_OPS, none, c"jointbus.iwdg");
        if with(|state| state.has_can) {
            overlay(qemu, CAN1_BASE, bxcan::SIZE, &CAN_OPS, none, c"jointbus.can1");
        }
        overlay(qemu, RCC_BASE, rcc::SIZE, &RCC_OPS, none, c"jointbus.rcc");
        overlay(qemu, FLASH_BASE, flash::SIZE, &FLASH_OPS, none, c"jointbus.flash");
        let sectors = u64::from(flash::SECTORS_BASE);
        overlay(qemu, sectors, flash::SECTORS_SIZE, &SECTORS_OPS, none, c"jointbus.flash-sectors");
        peripherals::start(qemu);
        for (index, serial) in self.serial.iter().enumerate() {
            if let Some(serial) = serial {
                serial.start(qemu, index);
            }
        }
        if let Some(port) = &self.can {
            port.start(qemu, &CAN_HANDLERS);
        }
        if let Some(port) = &self.console {
            port.start(qemu, &CONSOLE_HANDLERS);
        }
        // SAFETY: the function lives as long as the process.
        unsafe { (qemu.qemu_register_reset)(reset, none) };
    }
}

/// Lays registers over what QEMU has at an address.
fn overlay(qemu: &Qemu, base: u64, size: u32, ops: &'static RegionOps, opaque: Pointer, name: &CStr) {
    let (region, none) = (qemu::opaque_structure(), ptr::null_mut());
    // SAFETY: the region's memory is large enough; it and the functions live as long as the process.
    unsafe {
        (qemu.memory_region_init_io)(region, none, ops, opaque, name.as_ptr(), u64::from(size));
        (qemu.memory_region_add_subregion_overlap)((qemu.get_system_memory)(), base, region, 1);
    }
}

/// What an update has to tell QEMU.
struct Effects {
    lines: Vec<(usize, bool)>,
    sysclk_hz: Option<u32>,
    deadline_ns: Option<u64>,
    can_output: Vec<u8>,
    console_output: Vec<u8>,
    accept_input: bool,
    serial: [SerialEffects; 2],
}

impl State {
    /// Keeps what has changed in the flash, half of it where the power goes meanwhile.
    fn keep(&mut self, change: Option<flash::Change>) {
        let Some(flash::Change { offset, length }) = change else { return };
        let is_last = self.board.power_goes();
        let length = if is_last { length / 2 } else { length };
        if let Some(file) = &self.flash {
            let bytes = &self.board.flash().bytes()[offset as usize..][..length as usize];
            if let Err(error) = file.write_all_at(bytes, offset.into()) {
                complain(&format!("the flash is not kept: {error}"));
            }
        }
        if is_last {
            // SAFETY: it ends the process at once, as a power cut does; nothing else is to happen
            unsafe { libc::_exit(0) };
        }
    }

    fn effects(&mut self) -> Effects {
        let now = self.board.interrupts();
        let levels = [now.transmit, now.receive[0], now.receive[1], now.status];
        let lines =
            (0..levels.len()).filter(|&i| levels[i] != self.levels[i]).map(|i| (i, levels[i])).collect();
        self.levels = levels;

        let sysclk_hz = self.board.sysclk_hz();
        let changed = std::mem::replace(&mut self.sysclk_hz, sysclk_hz) != sysclk_hz;

        let deadline_ns = if self.armed { None } else { self.board.idle_ns() };
        self.armed |= deadline_ns.is_some();
        let accept_input = self.starved && self.board.can_room() > 0;
        self.starved &= !accept_input;
        Effects {
            lines,
            sysclk_hz: changed.then_some(sysclk_hz),
            deadline_ns,
            can_output: self.board.can_output(),
            console_output: self.board.console_output(),
            accept_input,
            serial: std::array::from_fn(|index| self.serial[index].effects(self.board.usart(index).0)),
        }
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

    fn set_timer(&self, qemu: &Qemu, timer: Pointer, delay: u64) {
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
fn update<R>(action: impl FnOnce(&mut State) -> R) -> R {
    let (result, effects) = with(|state| {
        let result = action(state);
        (result, state.effects())
    });
    if let Some(machine) = MACHINE.get() {
        machine.apply(qemu(), &effects);
    }
    result
}

extern "C" fn reset(_opaque: Pointer) {
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
extern "C" fn bite(_opaque: Pointer) {
    with(|state| state.board.watchdog_bites());
    // SAFETY: the reason is one of QEMU's.
    unsafe { (qemu().qemu_system_reset_request)(GUEST_RESET) };
}

extern "C" fn tick(_opaque: Pointer) {
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

/// # Safety
/// `bytes` must point to `length` bytes that stay as they are while the result is used.
unsafe fn received<'a>(bytes: *const u8, length: c_int) -> &'a [u8] {
    let length = usize::try_from(length).unwrap_or(0);
    // SAFETY: the caller says so.
    if length == 0 { &[] } else { unsafe { std::slice::from_raw_parts(bytes, length) } }
}

fn forget(port: impl FnOnce(&'static Machine) -> Option<&'static Port>) {
    if let Some(port) = MACHINE.get().and_then(port) {
        port.forget();
    }
}

/// Sends more to a client that has made room; ends the watch, for a new one is set where needed.
fn resume(port: impl FnOnce(&'static Machine) -> Option<&'static Port>) -> c_int {
    if let Some(port) = MACHINE.get().and_then(port) {
        port.resume(qemu());
    }
    0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outside_qemu_its_functions_are_missed_by_name() {
        assert_eq!(Qemu::find().err(), Some(c"qmp_query_version"));
    }
}
