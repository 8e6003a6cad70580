//! Hangs a [`Board`] into QEMU's STM32F405 machine: registers over the regions that QEMU leaves unimplemented,
//! interrupt lines, the processor's clock, timers, and character devices: `can0`, `canctl`, `usart2` and `usart3`.
//!
//! QEMU calls everything here with its big lock held, so calls never overlap; the mutexes are there because the
//! language wants to see that, and none is held while QEMU is called.

mod machine;
mod options;
mod part;
mod peripherals;
mod port;
mod qemu;
mod self_test;
mod state;
mod system;

use crate::board::Board;
use crate::control::Control;
use machine::{MACHINE, Machine, QEMU, qemu};
use options::Options;
use qemu::{Info, Notifier, Pointer, Qemu};
use state::{State, lock, with};
use std::ffi::{CStr, c_char, c_int};
use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::ptr;
use std::sync::atomic::{AtomicI32, Ordering};

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outside_qemu_its_functions_are_missed_by_name() {
        assert_eq!(Qemu::find().err(), Some(c"qmp_query_version"));
    }
}
