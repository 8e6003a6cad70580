//! Power cuts while settings are saved: the former or the new ones are there afterwards, never others and never none.

use embedded_storage_async::nor_flash::{
    ErrorType, MultiwriteNorFlash, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use jointbus_mcu_bridge::engine::Settings;
use jointbus_mcu_bridge::io::store::{Store, StoreError, Unreadable};

const SECTOR: usize = 4096;
const SIZE: usize = 2 * SECTOR;

/// A flash in memory whose power fails after so many steps: words written, or shares of a sector erased.
struct Flash<'a> {
    bytes: &'a mut [u8; SIZE],
    steps_left: u32,
    /// Decides what a word or a sector holds in whose middle the power fails.
    noise: &'a mut u64,
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
        for share in self.bytes[from as usize..to as usize].chunks_mut(SECTOR / 4) {
            if self.steps_left == 0 {
                share.iter_mut().for_each(|byte| *byte = random(self.noise) as u8);
                return Err(NoPower);
            }
            self.steps_left -= 1;
            share.fill(0xFF);
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NoPower> {
        for (place, word) in self.bytes[offset as usize..].chunks_mut(4).zip(bytes.chunks(4)) {
            let cut = self.steps_left == 0;
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
    let flash = Flash { bytes, steps_left, noise };
    run(&mut Store::new(flash, 0..SIZE as u32).unwrap())
}

fn settings(number: u16) -> Settings {
    let mut settings = Settings::default();
    settings.limits.host_silence_ms = number;
    settings.slots[3] = (1, number);
    settings
}

#[test]
fn a_thousand_power_cuts_lose_and_mix_nothing() {
    let (mut bytes, mut noise) = ([0xFF; SIZE], 1);
    assert_eq!(on(&mut bytes, &mut noise, 0, |store| store.load()), Ok(None));
    on(&mut bytes, &mut noise, u32::MAX, |store| store.save(&settings(0).encode())).unwrap();
    let (mut last, mut cuts, mut number) = (0, 0, 0u16);
    while cuts < 1000 {
        number = number.wrapping_add(1);
        // a save writes some 120 words, more where a sector is begun
        let steps = random(&mut noise) as u32 % 260;
        let saved = on(&mut bytes, &mut noise, steps, |store| store.save(&settings(number).encode()));
        cuts += u32::from(saved.is_err());
        // and the power may fail again while the store is repaired
        let again = random(&mut noise) as u32 % 40;
        let _ = on(&mut bytes, &mut noise, again, |store| store.load());
        let loaded = on(&mut bytes, &mut noise, u32::MAX, |store| store.load());
        let now = match loaded {
            Ok(Some(loaded)) if loaded == settings(number) => number,
            Ok(Some(loaded)) if loaded == settings(last) && saved.is_err() => last,
            other => panic!("after cut {cuts}, save {number} {saved:?}: {other:?}"),
        };
        last = now;
    }
}

#[test]
fn an_unreadable_store_says_so_and_can_be_written() {
    let (mut bytes, mut noise) = ([0; SIZE], 7);
    bytes.iter_mut().for_each(|byte| *byte = random(&mut noise) as u8);
    assert_eq!(on(&mut bytes, &mut noise, u32::MAX, |store| store.load()), Err(Unreadable));
    let saved = on(&mut bytes, &mut noise, u32::MAX, |store| store.save(&settings(5).encode()));
    assert_eq!(saved, Ok::<(), StoreError>(()));
    assert_eq!(on(&mut bytes, &mut noise, u32::MAX, |store| store.load()), Ok(Some(settings(5))));
}
