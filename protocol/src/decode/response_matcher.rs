use crate::wire;

/// What a master waits for: up to `L` kinds of frame, told apart by their place.
pub trait Match<const L: usize> {
    /// Length in bytes, checksum included, of each kind; 0 stands for none.
    fn lengths(&self) -> [usize; L];

    /// Whether bytes of that kind's length are such a frame: address, function code and checksum.
    fn accepts(&self, kind: usize, frame: &[u8]) -> bool;
}

/// The master's side of a line: finds the replies it waits for behind any noise.
///
/// Each position is tried once for each kind, so the work is linear and a false start delays nothing.
/// `N` must exceed the longest reply.
#[derive(Debug)]
pub struct ResponseMatcher<const N: usize, const L: usize> {
    buffer: [u8; N],
    used: usize,
    /// First position not yet tried, for each kind.
    next: [usize; L],
    delivered: bool,
}

impl<const N: usize, const L: usize> Default for ResponseMatcher<N, L> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize, const L: usize> ResponseMatcher<N, L> {
    /// A search that has received nothing.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; N], used: 0, next: [0; L], delivered: false }
    }

    /// Forgets what has been received: to be called before anything else is expected.
    pub const fn clear(&mut self) {
        self.used = 0;
        self.next = [0; L];
        self.delivered = false;
    }

    /// Tries all positions anew and keeps the bytes: to be called when the kinds that are waited for have changed.
    pub const fn rescan(&mut self) {
        self.next = [0; L];
    }

    /// Whether bytes came in that belong to no reply so far.
    #[must_use]
    pub const fn has_leftovers(&self) -> bool {
        self.used > 0 && !self.delivered
    }

    /// Takes bytes until a reply is found or none are left; tells its kind.
    pub fn feed(&mut self, wanted: &impl Match<L>, bytes: &mut &[u8]) -> Option<(usize, &[u8])> {
        if self.delivered {
            self.clear();
        }
        let lengths = wanted.lengths();
        while let Some((byte, rest)) = bytes.split_first() {
            *bytes = rest;
            if self.used >= N {
                self.slide(&lengths);
            }
            if let Some(place) = self.buffer.get_mut(self.used) {
                *place = *byte;
                self.used = self.used.wrapping_add(1);
            }
            if let Some((kind, found)) = self.try_positions(wanted, &lengths) {
                self.delivered = true;
                return self.buffer.get(found).map(|frame| (kind, frame));
            }
        }
        None
    }

    /// The line fell silent: a reply of unknown length, of which `accepts` tells, may end here.
    pub fn end_of_frame(&mut self, accepts: impl Fn(&[u8]) -> bool) -> Option<&[u8]> {
        let start = (0..self.used).find(|&start| self.buffer.get(start..self.used).is_some_and(&accepts))?;
        self.delivered = true;
        self.buffer.get(start..self.used)
    }

    fn try_positions(
        &mut self,
        wanted: &impl Match<L>,
        lengths: &[usize; L],
    ) -> Option<(usize, core::ops::Range<usize>)> {
        for (kind, (length, next)) in lengths.iter().zip(&mut self.next).enumerate() {
            while *length > 0 && next.saturating_add(*length) <= self.used {
                let range = *next..next.saturating_add(*length);
                *next = next.wrapping_add(1);
                if self.buffer.get(range.clone()).is_some_and(|frame| wanted.accepts(kind, frame)) {
                    return Some((kind, range));
                }
            }
        }
        None
    }

    /// Drops the bytes that can no longer start a reply; all, where no kind has a length.
    fn slide(&mut self, lengths: &[usize; L]) {
        let tried = lengths.iter().zip(self.next).filter(|(length, _)| **length > 0);
        let done = tried.map(|(_, next)| next).min().filter(|done| *done > 0).unwrap_or(self.used);
        wire::close_gap(self.buffer.get_mut(..self.used).unwrap_or_default(), done);
        self.used = self.used.saturating_sub(done);
        self.next = self.next.map(|next| next.saturating_sub(done));
    }
}
