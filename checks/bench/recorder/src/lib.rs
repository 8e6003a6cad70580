//! A plugin for QEMU's own interface (versions 1 and 2): it writes to a Unix socket, whose path is its one argument, a word of
//! 32 bits for each instruction before it is executed, which is its address, and for each access to a data register of
//! the serial ports or an identifier register of the CAN controller's mailboxes, which is the register's address with bit 0
//! set, and bit 1 where it was written.
//!
//! An instruction that reaches a peripheral may be told of twice in a row: QEMU begins it anew on its own.

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::io::{BufWriter, Write};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Mutex, PoisonError};

/// `USART_DR` of USART1, USART2 and USART3, `CAN_TIxR` of CAN1 (RM0090, table 1).
const REGISTERS: [u64; 6] = [0x4001_1004, 0x4000_4404, 0x4000_4804, 0x4000_6580, 0x4000_6590, 0x4000_65A0];

/// `QEMU_PLUGIN_CB_NO_REGS`.
const NO_REGISTERS: c_int = 0;
/// `QEMU_PLUGIN_MEM_RW`.
const READS_AND_WRITES: c_int = 3;

/// Structures that only QEMU looks into.
type Opaque = *mut c_void;

unsafe extern "C" {
    fn qemu_plugin_register_vcpu_tb_trans_cb(id: u64, translated: extern "C" fn(u64, Opaque));
    fn qemu_plugin_register_atexit_cb(id: u64, ended: extern "C" fn(u64, Opaque), data: Opaque);
    fn qemu_plugin_tb_n_insns(block: Opaque) -> usize;
    fn qemu_plugin_tb_get_insn(block: Opaque, index: usize) -> Opaque;
    fn qemu_plugin_insn_vaddr(instruction: Opaque) -> u64;
    fn qemu_plugin_register_vcpu_insn_exec_cb(
        instruction: Opaque,
        executed: extern "C" fn(c_uint, Opaque),
        flags: c_int,
        data: Opaque,
    );
    fn qemu_plugin_register_vcpu_mem_cb(
        instruction: Opaque,
        accessed: extern "C" fn(c_uint, u32, u64, Opaque),
        flags: c_int,
        kinds: c_int,
        data: Opaque,
    );
    fn qemu_plugin_mem_is_store(info: u32) -> bool;
}

/// Version of QEMU's plugin interface, which QEMU reads before anything else. Releases up to 8.2 take version 1 at most,
/// later ones version 2 at least; what is used here is the same in both.
#[unsafe(no_mangle)]
#[allow(non_upper_case_globals)]
static qemu_plugin_version: AtomicI32 = AtomicI32::new(1);

/// Runs when the library is loaded.
#[used]
#[cfg_attr(target_os = "linux", unsafe(link_section = ".init_array"))]
static ON_LOAD: extern "C" fn() = choose_version;

/// Scoreboards came with version 2.
extern "C" fn choose_version() {
    // SAFETY: the name is a C string; dlsym has no other requirement.
    if !unsafe { libc::dlsym(libc::RTLD_DEFAULT, c"qemu_plugin_scoreboard_new".as_ptr()) }.is_null() {
        qemu_plugin_version.store(2, Ordering::Relaxed);
    }
}

static OUT: Mutex<Option<BufWriter<UnixStream>>> = Mutex::new(None);

/// QEMU's way in.
///
/// # Safety
/// To be called by QEMU only, with the arguments that its plugin interface documents.
#[unsafe(no_mangle)]
unsafe extern "C" fn qemu_plugin_install(
    id: u64,
    _info: *const c_void,
    argc: c_int,
    argv: *const *const c_char,
) -> c_int {
    if argc != 1 {
        eprintln!("the recorder takes the path of a socket");
        return 1;
    }
    // SAFETY: QEMU hands over as many C strings as it says.
    let argument = unsafe { CStr::from_ptr(*argv) }.to_string_lossy();
    // QEMU takes a word without a value for one that is switched on
    let path = argument.strip_prefix("socket=").unwrap_or(&argument);
    match UnixStream::connect(path) {
        Ok(stream) => *OUT.lock().unwrap_or_else(PoisonError::into_inner) = Some(BufWriter::new(stream)),
        Err(error) => {
            eprintln!("the recorder cannot connect to {path}: {error}");
            return 1;
        }
    }
    // SAFETY: as the interface documents it.
    unsafe {
        qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
        qemu_plugin_register_atexit_cb(id, ended, std::ptr::null_mut());
    }
    0
}

extern "C" fn translated(_: u64, block: Opaque) {
    // SAFETY: QEMU's own structures, for the time of this call.
    unsafe {
        for index in 0..qemu_plugin_tb_n_insns(block) {
            let instruction = qemu_plugin_tb_get_insn(block, index);
            let address = qemu_plugin_insn_vaddr(instruction) as Opaque;
            qemu_plugin_register_vcpu_insn_exec_cb(instruction, executed, NO_REGISTERS, address);
            qemu_plugin_register_vcpu_mem_cb(instruction, accessed, NO_REGISTERS, READS_AND_WRITES, address);
        }
    }
}

extern "C" fn executed(_: c_uint, address: Opaque) {
    tell(address as u32);
}

extern "C" fn accessed(_: c_uint, info: u32, address: u64, _: Opaque) {
    if REGISTERS.contains(&address) {
        // SAFETY: the word is QEMU's.
        let is_store = unsafe { qemu_plugin_mem_is_store(info) };
        tell(address as u32 | 1 | u32::from(is_store) << 1);
    }
}

extern "C" fn ended(_: u64, _: Opaque) {
    *OUT.lock().unwrap_or_else(PoisonError::into_inner) = None;
}

/// Whoever listens may leave before QEMU does.
fn tell(word: u32) {
    let mut out = OUT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(writer) = &mut *out
        && writer.write_all(&word.to_le_bytes()).is_err()
    {
        *out = None;
    }
}
