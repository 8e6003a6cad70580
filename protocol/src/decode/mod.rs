//! Frames out of a byte stream, for both ends of a line.
//!
//! [`FrameDecoder`] is the slave's side: it takes a frame the moment it is complete and right, and after anything
//! wrong nothing until the line was silent, so that bytes inside a frame are never executed.
//! [`ResponseMatcher`] is the master's side: it slides over noise to the one reply it waits for.
//! Both are bounded and do work in proportion to the bytes they are fed.

mod frame_decoder;
mod response_matcher;
#[cfg(test)]
mod tests;

pub use frame_decoder::FrameDecoder;
pub use response_matcher::{Match, ResponseMatcher};

/// What the first bytes of a frame tell about its length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameLength {
    /// The frame has so many bytes, checksum included.
    Exactly(usize),
    /// So many bytes are needed before the length can be told.
    AtLeast(usize),
    /// Only silence ends the frame.
    UntilSilence,
    /// No frame starts like this.
    Impossible,
}

/// What a [`FrameDecoder`] must know of the frames on its line.
pub trait Framing {
    /// Length of the frame that starts with `prefix`, which is never empty.
    fn length(&self, prefix: &[u8]) -> FrameLength;

    /// Whether a frame of the right length has the right checksum.
    fn is_valid(&self, frame: &[u8]) -> bool;

    /// Whether the frame is a broadcast, which is not taken out of the middle of a burst.
    fn is_broadcast(&self, frame: &[u8]) -> bool;

    /// Whether a valid frame behind up to [`STRAY_MAX`] stray bytes is taken: not where the data of another frame can
    /// start there.
    fn forgives_stray_bytes(&self) -> bool {
        true
    }
}

/// Why a burst was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DecodeError {
    /// A frame was complete, its checksum wrong.
    Checksum,
    /// No frame starts with these bytes.
    Impossible,
    /// The line fell silent inside a frame.
    Incomplete,
}

/// What came out of a decoder: one shape for all of them, whatever the frame `F` and the reason `E` are.
///
/// Every decoder has `feed`, which takes bytes until there is an event or no byte is left and is called again while there
/// is one, and those that need the time have `poll` and `deadline`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Event<F, E> {
    /// A whole, valid frame.
    Frame(F),
    /// Bytes that are no frame, and why.
    Dropped(E),
}

/// [`Event`] of a decoder that follows a line with several devices, of which some are ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum MultidropEvent<F, E> {
    /// A request to one of ours, or to all.
    Frame(F),
    /// A request to another device, or its response: to be counted at most.
    Foreign(F),
    /// Bytes that are no frame, and why.
    Dropped(E),
}

/// A burst in which there was no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Dropped<'a> {
    /// What was wrong first.
    pub error: DecodeError,
    /// The burst, as far as it was kept.
    pub burst: &'a [u8],
}

/// What comes out of a [`FrameDecoder`].
pub type FrameEvent<'a> = Event<&'a [u8], Dropped<'a>>;

/// Stray bytes that may stand before a frame which then fills its burst to the end.
pub const STRAY_MAX: usize = 4;
