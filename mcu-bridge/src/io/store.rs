//! The stored settings on two flash sectors that are written in turn: a power cut at any moment leaves the former or
//! the new ones.
//!
//! Each sector is a log of its own, of settings with the number of their save and checksums; the highest number counts.
//! Saves are appended to the sector that holds it. Where one does not fit or can't be read back it goes to the other
//! sector, which is erased first and has to be blank to its last byte, because an erase that the power cut may leave
//! anything behind, blank ends among it. The sector with the newest settings is never erased.

use crate::board::Description;
use crate::engine::{STORED_LENGTH, Settings};
use core::ops::Range;
use embassy_futures::block_on;
use embedded_storage_async::nor_flash::MultiwriteNorFlash;
use sequential_storage::Error;
use sequential_storage::cache::{Cache, Uncached};
use sequential_storage::queue::{QueueConfig, QueueConfigError, QueueStorage};

/// Length of the number of a save.
const NUMBER: usize = size_of::<u32>();

/// Length of an entry.
const ENTRY: usize = NUMBER + STORED_LENGTH;

/// Room for an entry, in whole words of any flash.
const BUFFER: usize = ENTRY.next_multiple_of(32);

/// A log on one sector.
type Log<'a, F> = QueueStorage<&'a mut F, Cache<Uncached, Uncached, Uncached, ()>>;

/// The store can't be read, or what it holds is not of this version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unreadable;

/// The settings could not be stored; the former ones stay.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoreError;

/// A store on a flash, which does its work before it returns: nothing here ever waits for another task.
///
/// A save writes some hundred bytes. When a sector is full the other one is erased first, which on most parts holds up
/// everything that runs from flash.
#[derive(Debug)]
pub struct Store<F> {
    flash: F,
    start: u32,
}

/// One of the two sectors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sector {
    First,
    Second,
}

impl Sector {
    const fn other(self) -> Self {
        match self {
            Self::First => Self::Second,
            Self::Second => Self::First,
        }
    }
}

/// The newest entry: its number and its sector.
#[derive(Debug, Clone, Copy)]
struct Newest {
    number: u32,
    sector: Sector,
}

impl<F: MultiwriteNorFlash> Store<F> {
    /// A store on the two sectors of a flash from an offset on.
    ///
    /// # Errors
    /// [`QueueConfigError`] where no sector begins there, or one can't hold a log.
    pub fn new(mut flash: F, start: u32) -> Result<Self, QueueConfigError> {
        log(&mut flash, sector_range::<F>(start, Sector::Second)).map(drop)?;
        Ok(Self { flash, start })
    }

    /// What was stored last for a board; `None` where nothing ever was.
    ///
    /// # Errors
    /// [`Unreadable`]; it can be written all the same.
    #[inline(never)]
    pub fn load(&mut self, board: &Description) -> Result<Option<Settings>, Unreadable> {
        let mut buffer = [0; BUFFER];
        match self.newest(&mut buffer) {
            Some(Newest { number, sector }) if self.find(sector, Some(number), 0, &mut buffer).is_some() => {
                decode(&buffer, board)
            }
            None if self.is_blank(Sector::First) && self.is_blank(Sector::Second) => Ok(None),
            _ => Err(Unreadable),
        }
    }

    /// Stores settings in the form that the engine hands out, and reads them back.
    ///
    /// # Errors
    /// [`StoreError`] where the flash fails.
    // its buffer is to be on the stack while it saves, and not for as long as its caller runs
    #[inline(never)]
    pub fn save(&mut self, stored: &[u8; STORED_LENGTH]) -> Result<(), StoreError> {
        let mut buffer = [0; BUFFER];
        let (number, sectors) = match self.newest(&mut buffer) {
            Some(Newest { number, sector }) => {
                let number = number.checked_add(1).ok_or(StoreError)?;
                if self.append(sector, number, stored, &mut buffer)? {
                    return Ok(());
                }
                (number, [sector.other(), sector.other()])
            }
            None => (1, [Sector::First, Sector::Second]),
        };
        for sector in sectors {
            self.make_blank(sector)?;
            if self.append(sector, number, stored, &mut buffer)? {
                return Ok(());
            }
        }
        Err(StoreError)
    }

    /// The newest entry of both sectors, if there is one.
    fn newest(&mut self, buffer: &mut [u8; BUFFER]) -> Option<Newest> {
        let first = self.find(Sector::First, None, 0, buffer);
        let second = self.find(Sector::Second, None, 0, buffer);
        let sector = if first > second { Sector::First } else { Sector::Second };
        first.max(second).map(|number| Newest { number, sector })
    }

    /// Looks for an entry of a sector, and leaves it in `buffer`; without a number to look for, tells the highest there
    /// is. Entries before `keep_from` are marked as gone meanwhile, so that looking costs little the next time.
    #[inline(never)]
    fn find(
        &mut self,
        sector: Sector,
        wanted: Option<u32>,
        keep_from: u32,
        buffer: &mut [u8; BUFFER],
    ) -> Option<u32> {
        let mut log = self.log(sector).ok()?;
        let mut highest = None;
        let mut entries = block_on(log.iter()).ok()?;
        // a sector half erased may hold anything, and what can't be read ends the search
        while let Ok(Some(entry)) = block_on(entries.next(buffer)) {
            let Some(number) = entry.first_chunk().map(|number| u32::from_le_bytes(*number)) else {
                continue;
            };
            if wanted == Some(number) {
                return wanted;
            }
            highest = highest.max(Some(number));
            if number < keep_from {
                // what stays is slow, and no harm
                let _ = block_on(entry.pop());
            }
        }
        highest.filter(|_| wanted.is_none())
    }

    /// Appends an entry to a sector; tells whether it is there afterwards, or has no room.
    fn append(
        &mut self,
        sector: Sector,
        number: u32,
        stored: &[u8; STORED_LENGTH],
        buffer: &mut [u8; BUFFER],
    ) -> Result<bool, StoreError> {
        let entry = buffer.get_mut(..ENTRY).ok_or(StoreError)?;
        let (head, body) = entry.split_first_chunk_mut().ok_or(StoreError)?;
        *head = number.to_le_bytes();
        body.copy_from_slice(stored);
        // the one before it stays readable, should this one be damaged one day
        Ok(self.push(sector, entry)?
            && self.find(sector, Some(number), number.saturating_sub(1), buffer).is_some()
            && buffer.get(NUMBER..ENTRY) == Some(stored.as_slice()))
    }

    /// Writes an entry to a sector; tells whether there was room.
    #[inline(never)]
    fn push(&mut self, sector: Sector, entry: &[u8]) -> Result<bool, StoreError> {
        let mut log = self.log(sector).map_err(|_| StoreError)?;
        match block_on(log.push(entry, false)) {
            Ok(()) => Ok(true),
            Err(Error::Storage { .. }) => Err(StoreError),
            Err(_) => Ok(false),
        }
    }

    /// Erases a sector unless it is blank.
    fn make_blank(&mut self, sector: Sector) -> Result<(), StoreError> {
        if self.is_blank(sector) {
            return Ok(());
        }
        let Range { start, end } = sector_range::<F>(self.start, sector);
        block_on(self.flash.erase(start, end)).map_err(|_| StoreError)?;
        if self.is_blank(sector) { Ok(()) } else { Err(StoreError) }
    }

    /// Whether a sector is erased; one that can't be read is not.
    #[inline(never)]
    fn is_blank(&mut self, sector: Sector) -> bool {
        let mut chunk = [0; 64];
        sector_range::<F>(self.start, sector).step_by(chunk.len()).all(|offset| {
            block_on(self.flash.read(offset, &mut chunk)).is_ok() && chunk.iter().all(|byte| *byte == 0xFF)
        })
    }

    fn log(&mut self, sector: Sector) -> Result<Log<'_, F>, QueueConfigError> {
        log(&mut self.flash, sector_range::<F>(self.start, sector))
    }
}

/// The settings in an entry. What it needs of the stack is in use only while it runs.
#[inline(never)]
fn decode(entry: &[u8; BUFFER], board: &Description) -> Result<Option<Settings>, Unreadable> {
    let stored = entry.get(NUMBER..ENTRY).ok_or(Unreadable)?;
    Settings::decode(stored, board).map(Some).ok_or(Unreadable)
}

fn log<F: MultiwriteNorFlash>(flash: &mut F, range: Range<u32>) -> Result<Log<'_, F>, QueueConfigError> {
    Ok(QueueStorage::new(flash, QueueConfig::try_new(range)?, Cache::new_uncached()))
}

/// Where a sector lies.
fn sector_range<F: MultiwriteNorFlash>(start: u32, sector: Sector) -> Range<u32> {
    let size = F::ERASE_SIZE as u32;
    let first = start.saturating_add(if sector == Sector::Second { size } else { 0 });
    first..first.saturating_add(size)
}
