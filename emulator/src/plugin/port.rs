//! A character device and whoever is connected to it. It never waits: what a client does not take is kept up to a
//! bound and dropped beyond it.

use super::qemu::{Pointer, Qemu, WRITABLE, opaque_structure};
use std::collections::VecDeque;
use std::ffi::{CStr, c_int, c_uint};
use std::ptr;
use std::sync::Mutex;

/// Bytes kept for a client that does not read.
const KEPT: usize = 1 << 20;

/// What QEMU calls.
pub(super) struct Handlers {
    /// Bytes that may be handed over now.
    pub(super) room: extern "C" fn(Pointer) -> c_int,
    /// The client has sent bytes.
    pub(super) read: extern "C" fn(Pointer, *const u8, c_int),
    /// A client comes or goes.
    pub(super) event: extern "C" fn(Pointer, c_int),
    /// The client takes bytes again.
    pub(super) writable: extern "C" fn(Pointer, c_uint, Pointer) -> c_int,
}

/// One character device.
pub(super) struct Port {
    frontend: Pointer,
    writable: extern "C" fn(Pointer, c_uint, Pointer) -> c_int,
    /// Handed to every handler.
    opaque: Pointer,
    output: Mutex<Output>,
}

// SAFETY: the front end is only used by QEMU's functions, which its big lock serialises.
unsafe impl Send for Port {}
// SAFETY: as above.
unsafe impl Sync for Port {}

#[derive(Default)]
struct Output {
    waiting: VecDeque<u8>,
    watched: bool,
}

impl Port {
    /// Takes the character device with this id. Nothing if there is none.
    pub(super) fn open(qemu: &Qemu, id: &CStr, handlers: &Handlers, opaque: Pointer) -> Option<Self> {
        // SAFETY: the id is a C string; called while the machine is being completed, with the big lock held.
        let device = unsafe { (qemu.qemu_chr_find)(id.as_ptr()) };
        if device.is_null() {
            return None;
        }
        let frontend = opaque_structure();
        // SAFETY: the device exists, and the front end has room for any version's structure. No error is asked for.
        if !unsafe { (qemu.qemu_chr_fe_init)(frontend, device, ptr::null_mut()) } {
            return None;
        }
        Some(Self { frontend, writable: handlers.writable, opaque, output: Mutex::default() })
    }

    /// From here on QEMU calls the handlers.
    pub(super) fn start(&self, qemu: &Qemu, handlers: &Handlers) {
        let none = ptr::null_mut();
        // SAFETY: the front end was initialised; the handlers live as long as the process and never follow the opaque.
        unsafe {
            (qemu.qemu_chr_fe_set_handlers)(
                self.frontend,
                handlers.room,
                handlers.read,
                handlers.event,
                None,
                self.opaque,
                none,
                true,
            );
        }
    }

    /// Has bytes offered again after there was no room.
    pub(super) fn accept_input(&self, qemu: &Qemu) {
        // SAFETY: the front end was initialised.
        unsafe { (qemu.qemu_chr_fe_accept_input)(self.frontend) };
    }

    /// Forgets what was meant for a client that is gone.
    pub(super) fn forget(&self) {
        *self.output() = Output::default();
    }

    /// Sends bytes, and keeps those that the client does not take at once.
    pub(super) fn send(&self, qemu: &Qemu, bytes: &[u8]) {
        {
            let waiting = &mut self.output().waiting;
            if waiting.len() + bytes.len() <= KEPT {
                waiting.extend(bytes);
            }
        }
        self.flush(qemu);
    }

    /// The watch has fired, which also ends it.
    pub(super) fn resume(&self, qemu: &Qemu) {
        self.output().watched = false;
        self.flush(qemu);
    }

    fn flush(&self, qemu: &Qemu) {
        loop {
            // QEMU may find while writing that the client is gone, and say so at once: no lock may be held then.
            let chunk: Vec<u8> = self.output().waiting.iter().copied().take(4096).collect();
            if chunk.is_empty() {
                return;
            }
            // SAFETY: the front end was initialised, and the bytes are there.
            let sent =
                unsafe { (qemu.qemu_chr_fe_write)(self.frontend, chunk.as_ptr(), chunk.len() as c_int) };
            let Ok(sent @ 1..) = usize::try_from(sent) else { break };
            let mut output = self.output();
            let gone = sent.min(output.waiting.len());
            output.waiting.drain(..gone);
        }
        self.watch(qemu);
    }

    fn watch(&self, qemu: &Qemu) {
        if self.output().watched {
            return;
        }
        // SAFETY: the front end was initialised; the function lives as long as the process and never follows the opaque.
        let id = unsafe { (qemu.qemu_chr_fe_add_watch)(self.frontend, WRITABLE, self.writable, self.opaque) };
        self.output().watched = id != 0;
    }

    fn output(&self) -> std::sync::MutexGuard<'_, Output> {
        self.output.lock().expect("no panic is survived")
    }
}

/// # Safety
/// `bytes` must point to `length` bytes that stay as they are while the result is used.
pub(super) unsafe fn received<'a>(bytes: *const u8, length: c_int) -> &'a [u8] {
    let length = usize::try_from(length).unwrap_or(0);
    // SAFETY: the caller says so.
    if length == 0 { &[] } else { unsafe { std::slice::from_raw_parts(bytes, length) } }
}
