//! Where a bus keeps the bytes of its requests.

use super::host::FRAME_MAX;
use heapless::Vec;

/// The bytes of a request: on a serial bus the whole frame, for Modbus ASCII address and data unit, on CAN the body.
pub(super) type Content = Vec<u8, FRAME_MAX, u16>;

/// Where a [`Slab`] keeps the bytes of a request until it is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ContentIndex(pub(super) u8);

#[derive(Debug)]
struct Entry {
    is_taken: bool,
    content: Content,
}

/// Room for the bytes of `N` requests.
#[derive(Debug)]
pub(super) struct Slab<const N: usize>([Entry; N]);

impl<const N: usize> Slab<N> {
    pub(super) const fn new() -> Self {
        Self([const { Entry { is_taken: false, content: Vec::new() } }; N])
    }

    /// Keeps what `write` writes.
    pub(super) fn insert(&mut self, write: impl FnOnce(&mut Content)) -> Option<ContentIndex> {
        let (index, entry) = (0..).zip(&mut self.0).find(|(_, entry)| !entry.is_taken)?;
        entry.is_taken = true;
        entry.content.clear();
        write(&mut entry.content);
        Some(ContentIndex(index))
    }

    /// The bytes of a request.
    pub(super) fn get(&self, index: ContentIndex) -> &[u8] {
        self.0.get(usize::from(index.0)).map_or(&[], |entry| &entry.content)
    }

    /// The same, for data that is to be kept behind them.
    pub(super) fn get_mut(&mut self, index: ContentIndex) -> Option<&mut Content> {
        self.0.get_mut(usize::from(index.0)).map(|entry| &mut entry.content)
    }

    /// A request is done.
    pub(super) fn remove(&mut self, index: ContentIndex) {
        if let Some(entry) = self.0.get_mut(usize::from(index.0)) {
            entry.is_taken = false;
        }
    }

    /// All are done.
    pub(super) fn clear(&mut self) {
        self.0.iter_mut().for_each(|entry| entry.is_taken = false);
    }
}
