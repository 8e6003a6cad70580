//! Bounded reader and writer: the one place of this crate that touches raw offsets.

use crate::error::error_text;
use core::cell::Cell;

/// The input ended before the value did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Truncated;

/// The caller's buffer is too small for what was to be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoSpace;

/// Reads values from the front of a byte slice.
#[derive(Debug, Clone, Copy)]
pub struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    /// A reader over `bytes`.
    #[must_use]
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    /// What has not been read yet.
    #[must_use]
    pub const fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// The next `N` bytes.
    ///
    /// # Errors
    /// [`Truncated`] where fewer are left; nothing is consumed then. So for every method here.
    pub const fn array<const N: usize>(&mut self) -> Result<[u8; N], Truncated> {
        match self.rest.split_first_chunk::<N>() {
            Some((head, rest)) => {
                self.rest = rest;
                Ok(*head)
            }
            None => Err(Truncated),
        }
    }

    /// The next `length` bytes, borrowed.
    ///
    /// # Errors
    /// [`Truncated`] where fewer are left.
    pub const fn slice(&mut self, length: usize) -> Result<&'a [u8], Truncated> {
        match self.rest.split_at_checked(length) {
            Some((head, rest)) => {
                self.rest = rest;
                Ok(head)
            }
            None => Err(Truncated),
        }
    }

    /// One byte.
    ///
    /// # Errors
    /// [`Truncated`] at the end.
    pub const fn u8(&mut self) -> Result<u8, Truncated> {
        match self.rest.split_first() {
            Some((byte, rest)) => {
                self.rest = rest;
                Ok(*byte)
            }
            None => Err(Truncated),
        }
    }

    /// Two bytes, most significant first.
    ///
    /// # Errors
    /// [`Truncated`] where fewer are left.
    pub fn u16_be(&mut self) -> Result<u16, Truncated> {
        self.array().map(u16::from_be_bytes)
    }
}

/// Writes values into the caller's buffer.
#[derive(Debug)]
pub struct Writer<'a> {
    buffer: &'a mut [u8],
    used: usize,
}

impl<'a> Writer<'a> {
    /// A writer from the start of `buffer`; what was in there does not matter.
    #[must_use]
    pub const fn new(buffer: &'a mut [u8]) -> Self {
        Self { buffer, used: 0 }
    }

    /// The next `length` bytes of the buffer, to be filled by the caller.
    ///
    /// # Errors
    /// [`NoSpace`] where fewer are left; nothing is written then. So for every method here.
    pub fn reserve(&mut self, length: usize) -> Result<&mut [u8], NoSpace> {
        let end = self.used.checked_add(length).ok_or(NoSpace)?;
        let place = self.buffer.get_mut(self.used..end).ok_or(NoSpace)?;
        self.used = end;
        Ok(place)
    }

    /// Copies `bytes`.
    ///
    /// # Errors
    /// [`NoSpace`] where they don't fit.
    pub fn slice(&mut self, bytes: &[u8]) -> Result<(), NoSpace> {
        self.reserve(bytes.len())?.copy_from_slice(bytes);
        Ok(())
    }

    /// One byte.
    ///
    /// # Errors
    /// [`NoSpace`] where the buffer is full.
    pub fn u8(&mut self, value: u8) -> Result<(), NoSpace> {
        *self.buffer.get_mut(self.used).ok_or(NoSpace)? = value;
        self.used = self.used.wrapping_add(1);
        Ok(())
    }

    /// Two bytes, most significant first.
    ///
    /// # Errors
    /// [`NoSpace`] where they don't fit.
    pub fn u16_be(&mut self, value: u16) -> Result<(), NoSpace> {
        self.slice(&value.to_be_bytes())
    }

    /// Takes back all but the first `length` bytes written.
    pub(crate) fn truncate(&mut self, length: usize) {
        self.used = self.used.min(length);
    }

    /// Writes over bytes that were written from `at` on; what does not lie there changes nothing.
    pub(crate) fn patch(&mut self, at: usize, bytes: &[u8]) {
        let end = at.saturating_add(bytes.len());
        if let Some(place) = self.buffer.get_mut(..self.used).and_then(|written| written.get_mut(at..end)) {
            copy(bytes, place);
        }
    }

    /// What has been written so far.
    #[must_use]
    pub fn written(&self) -> &[u8] {
        self.buffer.get(..self.used).unwrap_or(&[])
    }

    /// The used part of the buffer.
    #[must_use]
    pub fn finish(self) -> &'a [u8] {
        self.buffer.get(..self.used).unwrap_or(&[])
    }
}

/// Copies as many bytes as there are in both: unlike `copy_from_slice` it cannot panic, so the optimiser need not
/// prove that the lengths are equal.
pub(crate) fn copy(from: &[u8], to: &mut [u8]) {
    let length = from.len().min(to.len());
    if let (Some(from), Some(to)) = (from.get(..length), to.get_mut(..length)) {
        to.copy_from_slice(from);
    }
}

/// Moves the bytes behind the first `gap` to the front; `gap` bytes of what they leave stay at the end.
///
/// A loop a byte: `copy_within` keeps a panic, and brings the whole `memmove` into the image for a move as rare as this.
pub(crate) fn close_gap(bytes: &mut [u8], gap: usize) {
    let cells = Cell::from_mut(bytes).as_slice_of_cells();
    cells.iter().zip(cells.iter().skip(gap)).for_each(|(to, from)| to.set(from.get()));
}

error_text! {
    Truncated {
        Truncated => ("the input ends before the value does"),
    }
}

error_text! {
    NoSpace {
        NoSpace => ("the buffer is too small"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_is_closed_whatever_its_length() {
        for gap in 0..6 {
            let mut bytes = [1, 2, 3, 4];
            close_gap(&mut bytes, gap);
            let mut expected = [1, 2, 3, 4];
            expected.copy_within(gap.min(4).., 0);
            assert_eq!(bytes, expected);
        }
    }

    #[test]
    fn reads_until_the_end_and_consumes_nothing_past_it() {
        let mut reader = Reader::new(&[1, 2, 3]);
        assert_eq!(reader.u16_be(), Ok(0x0102));
        assert_eq!(reader.u16_be(), Err(Truncated));
        assert_eq!(reader.slice(2), Err(Truncated));
        assert_eq!(reader.u8(), Ok(3));
        assert_eq!(reader.u8(), Err(Truncated));
        assert_eq!(reader.slice(0), Ok(&[][..]));
    }

    #[test]
    fn writes_into_a_dirty_buffer_and_refuses_what_does_not_fit() {
        let mut buffer = [0xEE; 4];
        let mut writer = Writer::new(&mut buffer);
        writer.u8(1).unwrap();
        writer.u16_be(0x0203).unwrap();
        assert_eq!(writer.u16_be(0x0405), Err(NoSpace));
        assert_eq!(writer.slice(&[4, 5]), Err(NoSpace));
        assert_eq!(writer.reserve(usize::MAX), Err(NoSpace));
        writer.u8(4).unwrap();
        assert_eq!(writer.u8(5), Err(NoSpace));
        assert_eq!(writer.finish(), &[1, 2, 3, 4]);
    }
}
