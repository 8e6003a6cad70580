//! The NDAM station with three modules of any layout: an answer fits its request, who is refused has changed nothing,
//! and only channels that exist are ever switched.
#![no_main]

use jointbus_fuzz::{Script, check_response, sealed};
use jointbus_protocol::modbus::server::NoResponse;
use jointbus_protocol::modbus::{BROADCAST, ascii};
use jointbus_protocol::ndam9010::{ChannelError, Layout, RamModule, Station};
use libfuzzer_sys::fuzz_target;

const START: u8 = 2;

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let modules: [RamModule; 3] = core::array::from_fn(|_| {
        let [digital_inputs, digital_outputs, analog_inputs, analog_outputs] =
            script.array().map(|it| it % 18);
        RamModule::new(Layout { digital_inputs, digital_outputs, analog_inputs, analog_outputs })
    });
    let mut station = Station::new(modules, START).unwrap();
    while !script.is_empty() {
        let way = script.byte();
        let content = script.record();
        for module in station.modules() {
            module.fault = match way & 0x0F {
                0 => Some(ChannelError::Failed),
                1 => Some(ChannelError::Busy),
                _ => None,
            };
        }
        let before = outputs(&mut station);
        let mut out = [0; 300];
        let outcome = match (way & 0x0F, content) {
            (2, _) => station.serve(content, &mut out).map(<[u8]>::to_vec),
            (3, [unit, pdu @ ..]) => serve_ascii(&mut station, *unit, pdu),
            _ => station.serve(&sealed(content), &mut out).map(<[u8]>::to_vec),
        };
        match outcome {
            Ok(reply) => {
                let content = if way & 0x0F == 2 { &content[..content.len() - 2] } else { content };
                assert!((START..START + 3).contains(&content[0]));
                let refused = check_response(content[0], &content[1..], &reply);
                if refused || content[1] <= 4 {
                    assert_eq!(before, outputs(&mut station));
                }
            }
            Err(NoResponse::Broadcast(_)) => assert_eq!(content[0], BROADCAST),
            Err(_) => assert_eq!(before, outputs(&mut station)),
        }
        for module in station.modules() {
            let present = (1u32 << module.layout.digital_outputs.min(16)) - 1;
            assert_eq!(u32::from(module.outputs) & !present, 0, "a channel that there is not");
            let analog = usize::from(module.layout.analog_outputs.min(16));
            assert!(module.analog_outputs[analog..].iter().all(|value| *value == 0));
        }
    }
    station.modules()[0] = RamModule::new(Layout { digital_inputs: 1, ..Layout::default() });
    let mut out = [0; 300];
    let reply = station.serve(&sealed(&[START, 2, 0, 0, 0, 1]), &mut out).unwrap();
    assert_eq!(reply[..4], [START, 2, 1, 1]);
});

fn outputs(station: &mut Station<RamModule, 3>) -> [(u16, [u16; 16]); 3] {
    station.modules().each_ref().map(|module| (module.outputs, module.analog_outputs))
}

/// The answer to a frame of Modbus ASCII, in the form of RTU.
fn serve_ascii(station: &mut Station<RamModule, 3>, unit: u8, pdu: &[u8]) -> Result<Vec<u8>, NoResponse> {
    let (mut out, mut bytes) = ([0; ascii::FRAME_MAX], [0; 300]);
    let answer = station.serve_ascii(&ascii::Frame { unit, pdu }, &mut out)?;
    let answer = ascii::Frame::decode(answer, &mut bytes).unwrap();
    Ok(sealed(&[&[answer.unit][..], answer.pdu].concat()))
}
