//! The NXI-6201: any frames. An answer fits its request, who is refused has changed nothing, and no output is ever
//! told a value outside its range.
#![no_main]

use jointbus_fuzz::{Script, check_response, sealed};
use jointbus_protocol::modbus::server::NoResponse;
use jointbus_protocol::nxi6201::{BROADCAST, CHANNELS, Card, DEFAULT_ID, RamHardware, Settings};
use libfuzzer_sys::fuzz_target;

fn check(settings: &Settings) {
    for channel in &settings.channels {
        assert!(channel.range.contains(channel.set_value));
        assert!(channel.start_range.contains(channel.start_value));
    }
    assert!((5_000..=1_000_000).contains(&settings.can_bit_rate) && (1..=127).contains(&settings.can_id));
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let Ok(mut card) = Card::power_up(RamHardware::default(), &Settings::default());
    while !script.is_empty() {
        let way = script.byte();
        let content = script.record();
        let before = *card.settings();
        match way & 0x0F {
            0 => {
                let Ok(()) = card.external_input(usize::from(way >> 4) % (CHANNELS + 1), way & 0x80 != 0);
            }
            1 => {
                let Ok(()) = card.outputs_off();
                assert!(card.settings().channels.iter().all(|channel| !channel.output));
            }
            2 => {
                let Ok(again) = Card::power_up(RamHardware::default(), &before);
                card = again;
            }
            3 => {
                let mut out = [0; 300];
                let _ = card.serve(DEFAULT_ID, content, &mut out);
            }
            _ => {
                let mut out = [0; 300];
                let frame = sealed(content);
                match card.serve(DEFAULT_ID, &frame, &mut out) {
                    Ok(reply) => {
                        assert_eq!(content[0], DEFAULT_ID);
                        let refused = check_response(DEFAULT_ID, &content[1..], reply);
                        if refused || content[1] == 0x03 {
                            assert_eq!(*card.settings(), before);
                        }
                    }
                    Err(NoResponse::Broadcast(None)) => assert_eq!(content[0], BROADCAST),
                    Err(_) => assert_eq!(*card.settings(), before),
                }
            }
        }
        let settings = *card.settings();
        check(&settings);
        assert_eq!(card.hardware().committed, Some(settings), "what drives the outputs");
    }
    let mut out = [0; 300];
    let reply = card.serve(DEFAULT_ID, &sealed(&[DEFAULT_ID, 3, 0, 2, 0, 2]), &mut out).unwrap();
    assert_eq!(reply.len(), 9);
});
