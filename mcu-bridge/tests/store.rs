//! Power cuts while settings are saved: the former or the new ones are there afterwards, never others and never none.

use embedded_storage_async::nor_flash::{
    ErrorType, MultiwriteNorFlash, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use jointbus_mcu_bridge::boards::stm32f405::BOARD;
use jointbus_mcu_bridge::engine::Settings;
use jointbus_mcu_bridge::io::store::{Store, StoreError, Unreadable};

/// Room for four saves, so that sectors change often.
const SECTOR: usize = 2048;
const SIZE: usize = 2 * SECTOR;
const SHARE: usize = SECTOR / 4;

/// More where the optimiser helps, as in `cargo xtask soak`.
const CUTS: u32 = if cfg!(debug_assertions) { 3_000 } else { 1_000_000 };

/// A flash in memory whose power fails after so many steps: words written, or shares of a sector erased.
struct Flash<'a> {
    bytes: &'a mut [u8; SIZE],
    steps_left: u32,
    /// Decides what a word or a sector holds in whose middle the power fails.
    noise: &'a mut u64,
    /// A byte that is worn out: it stays 0.
    worn: Option<usize>,
}

impl Flash<'_> {
    fn wear(&mut self) {
        if let Some(byte) = self.worn {
            self.bytes[byte] = 0;
        }
    }
}

#[derive(Debug)]
struct NoPower;

impl NorFlashError for NoPower {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    *state >> 33
}

impl ErrorType for Flash<'_> {
    type Error = NoPower;
}

impl ReadNorFlash for Flash<'_> {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NoPower> {
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        SIZE
    }
}

impl NorFlash for Flash<'_> {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), NoPower> {
        assert_eq!(to - from, SECTOR as u32, "one at a time");
        // which end goes first is up to the part, and so is what becomes of the place where it stops
        let (backwards, kind) = (random(self.noise) & 1 == 1, random(self.noise) % 3);
        for share in 0..4 {
            let share = if backwards { 3 - share } else { share };
            let bytes = &mut self.bytes[from as usize + share * SHARE..][..SHARE];
            if self.steps_left == 0 {
                for byte in bytes {
                    let noise = random(self.noise) as u8;
                    *byte = match kind {
                        0 => noise,
                        1 => *byte | noise,
                        _ => *byte | noise | random(self.noise) as u8 | random(self.noise) as u8,
                    };
                }
                return Err(NoPower);
            }
            self.steps_left -= 1;
            bytes.fill(0xFF);
        }
        self.wear();
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NoPower> {
        for (place, word) in self.bytes[offset as usize..].chunks_mut(4).zip(bytes.chunks(4)) {
            let cut = self.steps_left == 0;
            let sets = place.iter().zip(word).any(|(old, new)| old & new != *new);
            assert!(!sets || self.worn.is_some(), "only an erase sets bits");
            for (old, new) in place.iter_mut().zip(word) {
                // of the bits that were to become 0 some do
                let spared = if cut { random(self.noise) as u8 } else { 0 };
                *old &= new | spared;
            }
            if cut {
                return Err(NoPower);
            }
            self.steps_left -= 1;
        }
        self.wear();
        Ok(())
    }
}

impl MultiwriteNorFlash for Flash<'_> {}

fn on<R>(
    bytes: &mut [u8; SIZE],
    noise: &mut u64,
    steps_left: u32,
    run: impl FnOnce(&mut Store<Flash<'_>>) -> R,
) -> R {
    run(&mut Store::new(Flash { bytes, steps_left, noise, worn: None }, 0).unwrap())
}

/// Without power cuts.
fn save(bytes: &mut [u8; SIZE], number: u16) -> Result<(), StoreError> {
    on(bytes, &mut 1, u32::MAX, |store| store.save(&settings(number).encode(BOARD)))
}

fn load(bytes: &mut [u8; SIZE]) -> Result<Option<Settings>, Unreadable> {
    on(bytes, &mut 1, u32::MAX, |store| store.load(BOARD))
}

fn settings(number: u16) -> Settings {
    let mut settings = Settings::of(BOARD);
    settings.limits.host_silence_ms = number;
    settings.slots[3] = (1, number);
    settings
}

#[test]
fn power_cuts_lose_and_mix_nothing() {
    let (mut bytes, mut noise) = ([0xFF; SIZE], 1);
    assert_eq!(load(&mut bytes), Ok(None));
    save(&mut bytes, 0).unwrap();
    let (mut last, mut cuts, mut number) = (0, 0, 0u16);
    while cuts < CUTS {
        number = number.wrapping_add(1);
        // a save writes some 120 words, and erases four shares where a sector is begun
        let steps = random(&mut noise) as u32 % 200;
        let saved = on(&mut bytes, &mut noise, steps, |store| store.save(&settings(number).encode(BOARD)));
        cuts += u32::from(saved.is_err());
        // and the power may fail again while the store is looked at
        let again = random(&mut noise) as u32 % 6;
        let _ = on(&mut bytes, &mut noise, again, |store| store.load(BOARD));
        last = match load(&mut bytes) {
            Ok(Some(loaded)) if loaded == settings(number) => number,
            Ok(Some(loaded)) if loaded == settings(last) && saved.is_err() => last,
            other => panic!("after cut {cuts}, save {number} {saved:?}: {other:?}"),
        };
    }
    println!("{cuts} power cuts while settings were saved: none lost, none mixed");
}

#[test]
fn a_sector_that_only_begins_blank_is_erased_before_it_is_used() {
    let mut bytes = [0xFF; SIZE];
    (0..4).for_each(|number| save(&mut bytes, number).unwrap());
    assert!(bytes[SECTOR..].iter().all(|byte| *byte == 0xFF), "the second sector comes next");
    // an erase that was cut in its last quarter: both ends look blank, and saves would be written into the rest
    let (_, rest) =
        bytes[SECTOR + 3 * SHARE..].split_last_chunk_mut::<4>().map(|(rest, last)| (last, rest)).unwrap();
    let mut noise = 3;
    rest.iter_mut().for_each(|byte| *byte = random(&mut noise) as u8);
    for number in 4..8 {
        save(&mut bytes, number).unwrap();
        assert_eq!(load(&mut bytes), Ok(Some(settings(number))));
    }
    assert!(bytes[SECTOR + 3 * SHARE..].ends_with(&[0xFF; 4]));
}

#[test]
fn the_sector_with_the_newest_settings_is_never_erased() {
    let mut bytes = [0xFF; SIZE];
    for number in 0..50 {
        save(&mut bytes, number).unwrap();
        // whatever becomes of the next save, this one stays
        for steps in 0..8 {
            let mut cut = bytes;
            let mut noise = steps.into();
            let saved =
                on(&mut cut, &mut noise, steps, |store| store.save(&settings(number + 1).encode(BOARD)));
            assert_eq!((saved, load(&mut cut)), (Err(StoreError), Ok(Some(settings(number)))));
        }
    }
}

#[test]
fn what_does_not_read_back_is_stored_in_the_other_sector_or_not_called_stored() {
    let mut bytes = [0xFF; SIZE];
    save(&mut bytes, 0).unwrap();
    let worn_save = |bytes: &mut [u8; SIZE], worn, number| {
        let flash = Flash { bytes, steps_left: u32::MAX, noise: &mut 1, worn: Some(worn) };
        Store::new(flash, 0).unwrap().save(&settings(number).encode(BOARD))
    };
    let (mut well, mut moved) = (bytes, bytes);
    save(&mut well, 1).unwrap();
    let worn = (0..SECTOR).rfind(|index| well[*index] != 0 && well[*index] != bytes[*index]).unwrap();
    assert_eq!(worn_save(&mut moved, worn, 1), Ok(()));
    assert!(moved[SECTOR..].iter().any(|byte| *byte != 0xFF));
    assert_eq!(load(&mut moved), Ok(Some(settings(1))));
    // now the sector that comes next is worn out, where the number of its first entry lies
    (1..4).for_each(|number| save(&mut bytes, number).unwrap());
    assert_eq!(worn_save(&mut bytes, SECTOR + 12, 4), Err(StoreError));
    assert_eq!(load(&mut bytes), Ok(Some(settings(3))));
}

#[test]
fn an_unreadable_store_says_so_and_can_be_written() {
    let (mut bytes, mut noise) = ([0; SIZE], 7);
    bytes.iter_mut().for_each(|byte| *byte = random(&mut noise) as u8);
    assert_eq!(load(&mut bytes), Err(Unreadable));
    assert_eq!(save(&mut bytes, 5), Ok(()));
    assert_eq!(load(&mut bytes), Ok(Some(settings(5))));
}
