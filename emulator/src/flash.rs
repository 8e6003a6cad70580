//! The flash controller and the two sectors that a firmware writes (RM0090, chapter 3). Knows nothing of time: an
//! operation is done as soon as it is started.
//!
//! Modelled: locking, programming by words, half words and bytes as the width register says, sector erase, the error
//! flags for a locked controller, a wrong width and a sector that is not here. Not modelled: option bytes, interrupts,
//! the busy flag, mass erase, caches.

/// Size of the controller's registers.
pub const SIZE: u32 = 0x400;

/// Where the modelled sectors lie: 10 and 11.
pub const SECTORS_BASE: u32 = 0x080C_0000;

/// Size of a sector.
pub const SECTOR_SIZE: u32 = 128 * 1024;

/// Size of both.
pub const SECTORS_SIZE: u32 = 2 * SECTOR_SIZE;

const FIRST_SECTOR: u32 = 10;
const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

const EOP: u32 = 1;
const WRPERR: u32 = 1 << 4;
const PGPERR: u32 = 1 << 6;
const PGSERR: u32 = 1 << 7;
const FLAGS: u32 = EOP | 1 << 1 | WRPERR | 1 << 5 | PGPERR | PGSERR;

const PG: u32 = 1;
const SER: u32 = 1 << 1;
const STRT: u32 = 1 << 16;
const LOCK: u32 = 1 << 31;

/// Bytes that an operation has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Change {
    /// First byte, counted from [`SECTORS_BASE`].
    pub offset: u32,
    /// How many.
    pub length: u32,
}

/// The controller and its sectors.
#[derive(Debug, Clone)]
pub struct Flash {
    acr: u32,
    sr: u32,
    cr: u32,
    /// How many keys of the sequence have been seen; a wrong one locks until the next reset.
    keys: Option<usize>,
    bytes: Vec<u8>,
}

impl Default for Flash {
    fn default() -> Self {
        Self { acr: 0, sr: 0, cr: LOCK, keys: Some(0), bytes: vec![0xFF; SECTORS_SIZE as usize] }
    }
}

impl Flash {
    /// Erased sectors behind a locked controller.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Resets the controller; the sectors keep what they hold.
    pub fn reset(&mut self) {
        let bytes = std::mem::take(&mut self.bytes);
        *self = Self { bytes, ..Self { acr: 0, sr: 0, cr: LOCK, keys: Some(0), bytes: Vec::new() } };
    }

    /// What the sectors hold.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Puts something into the sectors, from their start.
    pub fn load(&mut self, content: &[u8]) {
        self.bytes.iter_mut().zip(content).for_each(|(byte, new)| *byte = *new);
    }

    /// Reads a register.
    #[must_use]
    pub fn read_register(&self, offset: u32) -> u32 {
        match offset {
            0x00 => self.acr,
            0x0C => self.sr,
            0x10 => self.cr,
            _ => 0,
        }
    }

    /// Writes a register; tells what has changed in the sectors.
    pub fn write_register(&mut self, offset: u32, value: u32) -> Option<Change> {
        match offset {
            0x00 => self.acr = value,
            0x04 => self.key(value),
            0x0C => self.sr &= !(value & FLAGS),
            0x10 if self.cr & LOCK == 0 => {
                self.cr = value & !STRT;
                if value & (SER | STRT) == SER | STRT && value & LOCK == 0 {
                    return self.erase(value >> 3 & 0xF);
                }
                if value & LOCK != 0 {
                    self.keys = Some(0);
                }
            }
            _ => {}
        }
        None
    }

    fn key(&mut self, value: u32) {
        self.keys = match self.keys {
            Some(seen) if KEYS.get(seen) == Some(&value) => Some(seen + 1),
            _ => None,
        };
        if self.keys == Some(KEYS.len()) {
            self.cr &= !LOCK;
        }
    }

    fn erase(&mut self, sector: u32) -> Option<Change> {
        let offset = sector.checked_sub(FIRST_SECTOR)? * SECTOR_SIZE;
        let Some(bytes) = self.bytes.get_mut(offset as usize..(offset + SECTOR_SIZE) as usize) else {
            self.sr |= WRPERR;
            return None;
        };
        bytes.fill(0xFF);
        self.sr |= EOP;
        Some(Change { offset, length: SECTOR_SIZE })
    }

    /// Reads `size` bytes of the sectors, least significant first.
    #[must_use]
    pub fn read(&self, offset: u32, size: u32) -> u32 {
        let bytes = self.bytes.iter().skip(offset as usize).take(size as usize);
        bytes.rev().fold(0, |value, byte| value << 8 | u32::from(*byte))
    }

    /// Programs `size` bytes: bits become 0 and never 1. Tells what has changed.
    pub fn program(&mut self, offset: u32, value: u32, size: u32) -> Option<Change> {
        if self.cr & (LOCK | PG) != PG {
            self.sr |= PGSERR;
            return None;
        }
        if 1 << (self.cr >> 8 & 0b11) != size {
            self.sr |= PGPERR;
            return None;
        }
        let place = self.bytes.iter_mut().skip(offset as usize);
        place.zip(&value.to_le_bytes()[..size as usize]).for_each(|(byte, new)| *byte &= new);
        self.sr |= EOP;
        Some(Change { offset, length: size })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORD: u32 = 0b10 << 8;

    fn unlocked() -> Flash {
        let mut flash = Flash::new();
        KEYS.iter().for_each(|key| {
            flash.write_register(0x04, *key);
        });
        flash
    }

    #[test]
    fn only_the_right_keys_unlock() {
        assert_eq!(unlocked().read_register(0x10), 0);
        let mut flash = Flash::new();
        flash.write_register(0x04, KEYS[1]);
        KEYS.iter().for_each(|key| {
            flash.write_register(0x04, *key);
        });
        assert_eq!(flash.read_register(0x10), LOCK, "locked until the next reset");
        flash.reset();
        KEYS.iter().for_each(|key| {
            flash.write_register(0x04, *key);
        });
        assert_eq!(flash.read_register(0x10), 0);
    }

    #[test]
    fn bits_are_programmed_to_0_and_erased_to_1() {
        let mut flash = unlocked();
        flash.write_register(0x10, PG | WORD);
        assert_eq!(flash.program(8, 0x1234_5678, 4), Some(Change { offset: 8, length: 4 }));
        flash.program(8, 0xFFFF_0000, 4);
        assert_eq!((flash.read(8, 4), flash.read(10, 2), flash.read(11, 1)), (0x1234_0000, 0x1234, 0x12));
        flash.program(SECTOR_SIZE, 0, 4);
        flash.write_register(0x10, SER | 10 << 3 | WORD);
        let erased = flash.write_register(0x10, SER | STRT | 10 << 3 | WORD);
        assert_eq!(erased, Some(Change { offset: 0, length: SECTOR_SIZE }));
        assert_eq!(
            (flash.read(8, 4), flash.read(SECTOR_SIZE, 4)),
            (0xFFFF_FFFF, 0),
            "the other sector stays"
        );
        assert_eq!(flash.read_register(0x0C), EOP);
        flash.write_register(0x0C, EOP);
        assert_eq!(flash.read_register(0x0C), 0);
    }

    #[test]
    fn what_is_not_allowed_changes_nothing_and_is_flagged() {
        let mut flash = Flash::new();
        assert_eq!(flash.program(0, 0, 4), None);
        assert_eq!(flash.read_register(0x0C), PGSERR, "locked");
        let mut flash = unlocked();
        flash.write_register(0x10, PG | WORD);
        assert_eq!(flash.program(0, 0, 2), None);
        assert_eq!(flash.read_register(0x0C), PGPERR, "another width");
        flash.write_register(0x10, SER | STRT | 12 << 3);
        assert_eq!(flash.read_register(0x0C), PGPERR | WRPERR, "no such sector");
        assert!(flash.bytes().iter().all(|byte| *byte == 0xFF));
    }
}
