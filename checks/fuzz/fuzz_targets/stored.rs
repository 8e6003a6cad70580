//! Settings as they are kept over power-off: what is accepted is complete and correct, the rest is refused whole.
#![no_main]

use jointbus_fuzz::sealed;
use jointbus_protocol::ndam9010::settings::{self, RamStorage, Start, Text};
use jointbus_protocol::nxi6201;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let (dip, data) = data.split_first().map_or((0, data), |(dip, rest)| (*dip, rest));
    if let Some(station) = framed::<{ settings::STORED_LENGTH }>(data)
        && let Ok(settings) = settings::Settings::decode(&station)
    {
        assert_eq!(settings.check(), Ok(()));
        let again = settings::Settings::decode(&settings.encode().unwrap());
        assert_eq!(again, Ok(settings));
        let start = settings::power_up(dip, &mut RamStorage(Some(station)));
        match start {
            Ok(Start::Run { start_id, settings: running }) => {
                assert_eq!((start_id, running), (dip, settings));
                assert!(dip > 0 && dip.checked_add(settings.modules - 1).is_some_and(|last| last <= 247));
            }
            Ok(Start::FactoryReset) => assert_eq!(dip, settings::DIP_FACTORY_RESET),
            Err(error) => assert_eq!(error, settings::SettingsError::StartId),
        }
    }
    if let Some(card) = framed::<{ nxi6201::STORED_LENGTH }>(data)
        && let Some(settings) = nxi6201::Settings::decode(&card)
    {
        for channel in settings.channels {
            assert!(channel.range.contains(channel.set_value) && !channel.output);
            assert!(channel.start_range.contains(channel.start_value));
        }
        assert_eq!(nxi6201::Settings::decode(&settings.encode()), Some(settings));
    }
    if let Ok(text) = Text::new(data) {
        assert_eq!(text.as_bytes(), data);
    }
});

/// `N` bytes whose last two are a right CRC: the fuzzer need not find it.
fn framed<const N: usize>(data: &[u8]) -> Option<[u8; N]> {
    sealed(data.get(..N - 2)?).try_into().ok()
}
