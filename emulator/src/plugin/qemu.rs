//! The functions of QEMU that the plugin calls, found in the running process.
//!
//! They are not part of QEMU's plugin interface. A QEMU built with loadable modules (Debian's is) exports them for
//! those. Types that only QEMU looks into are pointers here.

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::fmt;

/// A pointer to something of QEMU's.
pub(super) type Pointer = *mut c_void;

/// `SHUTDOWN_CAUSE_GUEST_RESET`.
pub(super) const GUEST_RESET: c_int = 7;

/// `QEMU_CLOCK_VIRTUAL`: stands still while the machine does.
pub(super) const CLOCK_VIRTUAL: c_int = 1;
/// Timers that count nanoseconds.
pub(super) const SCALE_NS: c_int = 1;
/// `DEVICE_LITTLE_ENDIAN`.
pub(super) const LITTLE_ENDIAN: c_int = 2;
/// `CHR_EVENT_OPENED`: a client has connected.
pub(super) const CHARDEV_OPENED: c_int = 1;
/// `CHR_EVENT_CLOSED`: the client is gone.
pub(super) const CHARDEV_CLOSED: c_int = 4;
/// `G_IO_OUT`: the client takes bytes again.
pub(super) const WRITABLE: c_uint = 4;

/// `qemu_info_t`: what QEMU tells a plugin about itself.
#[repr(C)]
pub(super) struct Info {
    pub(super) target_name: *const c_char,
    pub(super) min_api_version: c_int,
    pub(super) api_version: c_int,
    pub(super) system_emulation: bool,
}

/// `VersionTriple`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct VersionTriple {
    pub(super) major: i64,
    pub(super) minor: i64,
    pub(super) micro: i64,
}

impl fmt::Display for VersionTriple {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}.{}.{}", self.major, self.minor, self.micro)
    }
}

/// `VersionInfo`.
#[repr(C)]
pub(super) struct VersionInfo {
    pub(super) version: *const VersionTriple,
    pub(super) package: *const c_char,
}

/// `Notifier`.
#[repr(C)]
pub(super) struct Notifier {
    pub(super) notify: extern "C" fn(*mut Notifier, Pointer),
    pub(super) next: Pointer,
    pub(super) previous: Pointer,
}

pub(super) type Read = extern "C" fn(Pointer, u64, c_uint) -> u64;
pub(super) type Write = extern "C" fn(Pointer, u64, u64, c_uint);

/// `MemoryRegionOps.valid`: what the guest may do.
#[repr(C)]
struct ValidAccess {
    smallest: c_uint,
    largest: c_uint,
    unaligned: bool,
    accepts: Option<extern "C" fn()>,
}

/// `MemoryRegionOps.impl`: what the functions can do.
#[repr(C)]
struct ImplementedAccess {
    smallest: c_uint,
    largest: c_uint,
    unaligned: bool,
}

/// `MemoryRegionOps`.
#[repr(C)]
pub(super) struct RegionOps {
    read: Read,
    write: Write,
    read_with_attributes: Option<Read>,
    write_with_attributes: Option<Write>,
    endianness: c_int,
    valid: ValidAccess,
    implemented: ImplementedAccess,
}

impl RegionOps {
    /// A little-endian region whose accesses are not below `smallest` bytes.
    pub(super) const fn new(read: Read, write: Write, smallest: c_uint) -> Self {
        Self {
            read,
            write,
            read_with_attributes: None,
            write_with_attributes: None,
            endianness: LITTLE_ENDIAN,
            valid: ValidAccess { smallest, largest: 4, unaligned: false, accepts: None },
            implemented: ImplementedAccess { smallest: 1, largest: 4, unaligned: false },
        }
    }
}

/// Memory for a structure of QEMU's whose size is not known here: more than any version needs, zeroed, never freed.
pub(super) fn opaque_structure() -> Pointer {
    Box::leak(Box::new([0_u128; 256])).as_mut_ptr().cast()
}

/// Returns true if the running process exports a symbol.
pub(super) fn exports(name: &CStr) -> bool {
    // SAFETY: the name is a C string; dlsym has no other requirement.
    !unsafe { libc::dlsym(libc::RTLD_DEFAULT, name.as_ptr()) }.is_null()
}

/// Declares a table of functions and how to find each of them by its name.
macro_rules! functions {
    (
        $(#[$table_doc:meta])* struct $table:ident;
        $($(#[$doc:meta])* fn $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)?;)*
    ) => {
        $(#[$table_doc])*
        pub(super) struct $table {
            $($(#[$doc])* pub(super) $name: unsafe extern "C" fn($($argument: $type),*) $(-> $result)?,)*
        }

        impl $table {
            /// Finds all functions, or names the first that the running process does not have.
            pub(super) fn find() -> Result<Self, &'static CStr> {
                $(
                    let name = concat!(stringify!($name), "\0").as_bytes();
                    let name = CStr::from_bytes_with_nul(name).expect("the name ends with its 0");
                    // SAFETY: the name is a C string; dlsym has no other requirement.
                    let $name = unsafe { libc::dlsym(libc::RTLD_DEFAULT, name.as_ptr()) };
                    if $name.is_null() {
                        return Err(name);
                    }
                )*
                Ok(Self {
                    $(
                        // SAFETY: QEMU's symbol of this name is a function with this signature.
                        $name: unsafe {
                            std::mem::transmute::<
                                Pointer,
                                unsafe extern "C" fn($($argument: $type),*) $(-> $result)?
                            >($name)
                        },
                    )*
                })
            }
        }
    };
}

functions! {
    /// QEMU's functions. All are to be called with QEMU's big lock held, as it is in every callback.
    struct Qemu;

    /// QEMU's version.
    fn qmp_query_version(error: *mut Pointer) -> *const VersionInfo;
    /// Has a notifier called once the machine is complete.
    fn qemu_add_machine_init_done_notifier(notifier: *mut Notifier);
    /// Has a function called whenever the machine is reset, and once before it starts.
    fn qemu_register_reset(function: extern "C" fn(Pointer), opaque: Pointer);

    /// The one object of a type at a path, or anywhere with the empty path; null if there is none.
    fn object_resolve_path_type(path: *const c_char, kind: *const c_char, ambiguous: *mut bool) -> Pointer;
    /// The address space of the processor.
    fn get_system_memory() -> Pointer;
    /// Makes a region whose accesses call functions.
    fn memory_region_init_io(
        region: Pointer, owner: Pointer, ops: *const RegionOps, opaque: Pointer, name: *const c_char, size: u64
    );
    /// Lays a region over others of lower priority.
    fn memory_region_add_subregion_overlap(region: Pointer, offset: u64, part: Pointer, priority: c_int);

    /// An unnamed input line of a device.
    fn qdev_get_gpio_in(device: Pointer, number: c_int) -> Pointer;
    /// Drives a line.
    fn qemu_set_irq(line: Pointer, level: c_int);
    /// Sets the period of a clock, in units of 2^-32 ns; whether that changed it.
    fn clock_set(clock: Pointer, period: u64) -> bool;
    /// Tells those that a clock feeds.
    fn clock_propagate(clock: Pointer);

    /// Makes a timer.
    fn timer_init_full(
        timer: Pointer, group: Pointer, clock: c_int, scale: c_int, attributes: c_int,
        callback: extern "C" fn(Pointer), opaque: Pointer
    );
    /// Sets a timer to a time, in nanoseconds.
    fn timer_mod_ns(timer: Pointer, time: i64);
    /// Stops a timer.
    fn timer_del(timer: Pointer);
    /// Has the machine reset, for a reason of QEMU's list.
    fn qemu_system_reset_request(reason: c_int);
    /// The time of a clock, in nanoseconds.
    fn qemu_clock_get_ns(clock: c_int) -> i64;

    /// The character device with this id, or null.
    fn qemu_chr_find(id: *const c_char) -> Pointer;
    /// Takes a character device for a front end.
    fn qemu_chr_fe_init(frontend: Pointer, device: Pointer, error: *mut Pointer) -> bool;
    /// Sets who takes what the client sends.
    fn qemu_chr_fe_set_handlers(
        frontend: Pointer, room: extern "C" fn(Pointer) -> c_int,
        read: extern "C" fn(Pointer, *const u8, c_int), event: extern "C" fn(Pointer, c_int),
        changed: Option<extern "C" fn(Pointer) -> c_int>, opaque: Pointer, context: Pointer, set_open: bool
    );
    /// Has the client's bytes offered again after there was no room for them.
    fn qemu_chr_fe_accept_input(frontend: Pointer);
    /// Sends what the client takes now; the number of bytes, or negative. Without a client everything is taken.
    fn qemu_chr_fe_write(frontend: Pointer, bytes: *const u8, length: c_int) -> c_int;
    /// Has a function called when a condition holds; 0 if there is nothing to wait for.
    fn qemu_chr_fe_add_watch(
        frontend: Pointer, condition: c_uint,
        callback: extern "C" fn(Pointer, c_uint, Pointer) -> c_int, opaque: Pointer
    ) -> c_uint;
}

functions! {
    /// The functions that the self-test needs beside those of [`Qemu`], to be called in the same way. The machine runs
    /// without them.
    struct Inspection;

    /// The processor with this index, or null.
    fn qemu_get_cpu(index: c_int) -> Pointer;
    /// An address space of a processor; 0 is the one that it reaches memory and its own registers by.
    fn cpu_get_address_space(processor: Pointer, index: c_int) -> Pointer;
    /// Reads or writes an address space; 0 where that succeeded. The attributes are a structure of up to 64 bits.
    fn address_space_rw(
        space: Pointer, address: u64, attributes: u64, buffer: *mut c_void, length: u64, is_write: bool
    ) -> c_uint;
    /// A clock input of a device, or null.
    fn qdev_get_clock_in(device: Pointer, name: *const c_char) -> Pointer;
    /// The frequency of a clock as text, such as `168 MHz`; to be freed by the caller.
    fn clock_display_freq(clock: Pointer) -> *mut c_char;
    /// Returns true while a timer is set.
    fn timer_pending(timer: Pointer) -> bool;
}
