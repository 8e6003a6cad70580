//! The two flash sectors that hold the stored settings (RM0090, chapter 3), with a bound on every wait.
//!
//! While a sector is erased the processor can't fetch from the flash either: everything stands still for one to two
//! seconds. That happens once in some 290 saves, and the host waits for the answer to its save meanwhile.

use crate::constants::{FLASH_LIMIT_US, STORE_BASE, STORE_FIRST_SECTOR, STORE_SECTOR, STORE_SIZE};
use crate::time;
use embedded_storage_async::nor_flash::{
    ErrorType, MultiwriteNorFlash, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use stm32f4xx_hal::pac::FLASH;

const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

/// All error flags of SR: written back, they are cleared.
const ERRORS: u32 = 0xF2;

/// 32 bits are programmed at a time, which wants a supply of 2.7 V and more.
const WORD: u8 = 0b10;

/// The flash did not do as it was told.
#[derive(Debug, Clone, Copy)]
pub enum FlashError {
    /// Not within the two sectors, or not in whole words or sectors.
    Range,
    /// It reported an error.
    Failed,
    /// It was busy for too long.
    Busy,
}

impl NorFlashError for FlashError {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::Range => NorFlashErrorKind::OutOfBounds,
            Self::Failed | Self::Busy => NorFlashErrorKind::Other,
        }
    }
}

/// The two sectors; offsets count from the first.
pub struct Sectors(FLASH);

impl Sectors {
    /// Takes the flash's controller.
    pub fn new(flash: FLASH) -> Self {
        Self(flash)
    }

    /// Runs something with the controller unlocked.
    fn unlocked(&mut self, run: impl FnOnce(&FLASH) -> Result<(), FlashError>) -> Result<(), FlashError> {
        let flash = &self.0;
        wait(flash)?;
        if flash.cr().read().lock().bit_is_set() {
            for key in KEYS {
                // SAFETY: the sequence of RM0090, 3.6.1
                flash.keyr().write(|w| unsafe { w.key().bits(key) });
            }
        }
        // SAFETY: a 1 clears the flag it stands for
        flash.sr().write(|w| unsafe { w.bits(ERRORS) });
        let result = run(flash);
        flash.cr().modify(|_, w| w.pg().clear_bit().ser().clear_bit().lock().set_bit());
        forget_cached_data(flash);
        result
    }
}

/// Waits until the controller is idle and tells what it says.
fn wait(flash: &FLASH) -> Result<(), FlashError> {
    let start = time::micros();
    while flash.sr().read().bsy().bit_is_set() {
        if time::micros().wrapping_sub(start) > FLASH_LIMIT_US {
            return Err(FlashError::Busy);
        }
    }
    if flash.sr().read().bits() & ERRORS == 0 { Ok(()) } else { Err(FlashError::Failed) }
}

/// The data cache knows nothing of what was written or erased (3.5.2).
fn forget_cached_data(flash: &FLASH) {
    let was_on = flash.acr().read().dcen().bit_is_set();
    flash.acr().modify(|_, w| w.dcen().clear_bit());
    flash.acr().modify(|_, w| w.dcrst().set_bit());
    flash.acr().modify(|_, w| w.dcrst().clear_bit().dcen().bit(was_on));
}

/// Address of `length` bytes at an offset.
fn address(offset: u32, length: usize, unit: u32) -> Result<u32, FlashError> {
    let length = u32::try_from(length).map_err(|_| FlashError::Range)?;
    let end = offset.checked_add(length).ok_or(FlashError::Range)?;
    let fits = end <= STORE_SIZE && offset.is_multiple_of(unit) && length.is_multiple_of(unit);
    if fits { Ok(STORE_BASE + offset) } else { Err(FlashError::Range) }
}

impl ErrorType for Sectors {
    type Error = FlashError;
}

impl ReadNorFlash for Sectors {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
        let start = address(offset, bytes.len(), 1)? as *const u8;
        for (index, byte) in bytes.iter_mut().enumerate() {
            // SAFETY: `address` has checked that it lies in the two sectors, which are mapped and belong to this alone
            *byte = unsafe { start.add(index).read_volatile() };
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        STORE_SIZE as usize
    }
}

impl NorFlash for Sectors {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = STORE_SECTOR as usize;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashError> {
        address(from, (to.saturating_sub(from)) as usize, STORE_SECTOR)?;
        for sector in from / STORE_SECTOR..to / STORE_SECTOR {
            let number = STORE_FIRST_SECTOR + sector as u8;
            self.unlocked(|flash| {
                // SAFETY: a sector of this part's flash
                flash.cr().modify(|_, w| unsafe {
                    w.pg().clear_bit().ser().set_bit().snb().bits(number).psize().bits(WORD)
                });
                flash.cr().modify(|_, w| w.strt().set_bit());
                wait(flash)
            })?;
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
        let start = address(offset, bytes.len(), 4)? as *mut u32;
        self.unlocked(|flash| {
            // SAFETY: a width of this part's flash
            flash.cr().modify(|_, w| unsafe { w.ser().clear_bit().pg().set_bit().psize().bits(WORD) });
            for (index, word) in bytes.as_chunks::<4>().0.iter().enumerate() {
                // SAFETY: `address` has checked that it lies in the two sectors, in whole words
                unsafe { start.add(index).write_volatile(u32::from_le_bytes(*word)) };
                wait(flash)?;
            }
            Ok(())
        })
    }
}

// a bit that is 0 may be written as 0 again
impl MultiwriteNorFlash for Sectors {}
