//! Values that the compiler cannot know, and a place for results that it cannot leave out.

use core::hint::black_box;
use core::ptr;

use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::time::{Duration, Instant};

static INPUT: &[u8] = &[0; 1024];

/// The value, of which the compiler knows nothing any more.
pub(crate) fn any<T: Copy>(value: T) -> T {
    // a long array would be read byte by byte in a thousand instructions
    if size_of::<T>() > 64 {
        return black_box(value);
    }
    // SAFETY: a reference is valid, aligned and initialised, and the value is `Copy`.
    unsafe { ptr::read_volatile(&raw const value) }
}

/// Bytes of any content and number.
pub(crate) fn bytes() -> &'static [u8] {
    // SAFETY: as in `any`; the slice itself is read, so that neither its place nor its length is known.
    unsafe { ptr::read_volatile(&raw const INPUT) }
}

/// Any byte.
pub(crate) fn byte() -> u8 {
    any(0)
}

/// Any two bytes.
pub(crate) fn word() -> u16 {
    any(0)
}

/// Any four bytes.
pub(crate) fn long() -> u32 {
    any(0)
}

/// Any length or index.
pub(crate) fn size() -> usize {
    any(0)
}

/// Yes or no.
pub(crate) fn flag() -> bool {
    any(false)
}

/// Any moment.
pub(crate) fn moment() -> Instant {
    Instant::from_micros(any(0))
}

/// Any length of time.
pub(crate) fn span() -> Duration {
    Duration::from_micros(any(0))
}

/// Any CAN frame that can be made.
pub(crate) fn can_frame() -> Option<Frame> {
    let id = if flag() { Id::Standard(word()) } else { Id::Extended(long()) };
    Frame::from_parts(id, flag(), byte(), any([0; 8])).ok()
}

/// Hands any part of a buffer of `N` bytes to `user`.
pub(crate) fn buffer<const N: usize>(user: impl FnOnce(&mut [u8])) {
    let mut all = any([0; N]);
    if let Some(part) = all.get_mut(..size()) {
        user(part);
    }
    sink(all);
}

/// Uses a result.
pub(crate) fn sink<T>(result: T) {
    black_box(&result);
}
