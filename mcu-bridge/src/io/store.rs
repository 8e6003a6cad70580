//! The stored settings on two or more flash sectors that are written in turn: a power cut at any moment leaves the
//! former or the new ones.

use crate::engine::{STORED_LENGTH, Settings};
use core::ops::Range;
use embassy_futures::block_on;
use embedded_storage_async::nor_flash::MultiwriteNorFlash;
use sequential_storage::cache::{Cache, Uncached};
use sequential_storage::map::{MapConfig, MapConfigError, MapStorage};

/// The one thing that is stored.
const SETTINGS: u8 = 1;

/// Room for key and value, in whole words of any flash.
const BUFFER: usize = (1 + STORED_LENGTH).next_multiple_of(32);

/// The store can't be read, or what it holds is not of this version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unreadable;

/// The settings could not be stored; the former ones stay.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreError;

/// A store on a flash, which does its work before it returns: nothing here ever waits for another task.
///
/// A save writes some hundred bytes. When a sector is full the next one is erased first, which on most parts holds up
/// everything that runs from flash.
pub struct Store<F: MultiwriteNorFlash> {
    map: MapStorage<u8, F, Cache<Uncached, Uncached, Uncached, u8>>,
    /// Nothing was ever written: finding nothing is then as it should be.
    was_blank: bool,
}

impl<F: MultiwriteNorFlash> Store<F> {
    /// A store on a range of a flash: at least two whole sectors.
    ///
    /// # Errors
    /// [`MapConfigError`] where the range is not that.
    pub fn new(mut flash: F, range: Range<u32>) -> Result<Self, MapConfigError> {
        let config = MapConfig::try_new(range.clone())?;
        // looked at before repairs, which erase what they can't use
        let was_blank = block_on(is_blank(&mut flash, range));
        Ok(Self { map: MapStorage::new(flash, config, Cache::new_uncached()), was_blank })
    }

    /// What was stored last; `None` where nothing ever was. Traces of a power cut are repaired.
    ///
    /// # Errors
    /// [`Unreadable`]; it can be written all the same.
    #[inline(never)]
    pub fn load(&mut self) -> Result<Option<Settings>, Unreadable> {
        let mut buffer = [0; BUFFER];
        match block_on(self.map.fetch_item::<&[u8]>(&mut buffer, &SETTINGS)) {
            Ok(None) if self.was_blank => Ok(None),
            Ok(Some(stored)) => Settings::decode(stored).map(Some).ok_or(Unreadable),
            Ok(None) | Err(_) => Err(Unreadable),
        }
    }

    /// Stores settings in the form that the engine hands out. A store that can't be read is erased first.
    ///
    /// # Errors
    /// [`StoreError`] where the flash fails.
    // its buffers are to be on the stack while it saves, and not for as long as its caller runs
    #[inline(never)]
    pub fn save(&mut self, stored: &[u8; STORED_LENGTH]) -> Result<(), StoreError> {
        let mut buffer = [0; BUFFER];
        let item = stored.as_slice();
        match block_on(self.map.store_item(&mut buffer, &SETTINGS, &item)) {
            Ok(()) => Ok(()),
            Err(sequential_storage::Error::Storage { .. }) => Err(StoreError),
            // what the store holds can't be read, so there is nothing to lose
            Err(_) => block_on(async {
                self.map.erase_all().await.map_err(|_| StoreError)?;
                self.map.store_item(&mut buffer, &SETTINGS, &item).await.map_err(|_| StoreError)
            }),
        }
    }
}

/// Whether a range of a flash is erased; one that can't be read is not.
async fn is_blank(flash: &mut impl MultiwriteNorFlash, range: Range<u32>) -> bool {
    let mut chunk = [0; 64];
    for offset in range.step_by(chunk.len()) {
        if flash.read(offset, &mut chunk).await.is_err() || chunk.iter().any(|byte| *byte != 0xFF) {
            return false;
        }
    }
    true
}
