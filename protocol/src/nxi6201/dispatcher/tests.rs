use super::*;
use crate::modbus::{PDU_MAX, Response};
use std::vec::Vec;

fn ask<'b, H: Hardware>(card: &mut Card<H>, request: &Request<'_>, out: &'b mut [u8]) -> Response<'b> {
    Response::decode(card.dispatch(request, out).unwrap()).unwrap()
}

fn card() -> Card<RamHardware> {
    Card::power_up(RamHardware::default(), &Settings::default()).unwrap()
}

fn words(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|value| [*value as u16, (value >> 16) as u16]).flat_map(u16::to_be_bytes).collect()
}

fn write(card: &mut Card<RamHardware>, start: u16, values: &[u32]) -> Result<(), ExceptionCode> {
    let (range, data) = (AddressRange::new(start, values.len() as u16 * 2), words(values));
    match ask(card, &Request::WriteMultipleRegisters { range, data: &data }, &mut [0xEE; 5]) {
        Response::WriteMultiple { range: written, .. } if written == range => Ok(()),
        Response::Exception { exception, .. } => Err(exception),
        other => panic!("{other:?}"),
    }
}

fn read(card: &mut Card<RamHardware>, start: u16, quantity: u16) -> Result<Vec<u8>, ExceptionCode> {
    let mut data = [0xEE; PDU_MAX];
    match ask(card, &Request::ReadHoldingRegisters(AddressRange::new(start, quantity)), &mut data) {
        Response::Read { data, .. } => Ok(data.to_vec()),
        Response::Exception { exception, .. } => Err(exception),
        other => panic!("{other:?}"),
    }
}

const ADDRESS: ExceptionCode = ExceptionCode::IllegalDataAddress;
const VALUE: ExceptionCode = ExceptionCode::IllegalDataValue;

#[test]
fn the_printed_write_sets_the_range() {
    let mut card = card();
    let frame = [0x1F, 0x10, 0x00, 0x02, 0x00, 0x02, 0x04, 0x00, 0x02, 0x00, 0x00, 0xB3, 0x9E];
    let mut out = [0xEE; 8];
    let reply = card.serve(31, &frame, &mut out).unwrap();
    assert_eq!(reply[..6], frame[..6]);
    assert_eq!(card.settings().channels[0].range, OutputRange::Milliamperes200);
    assert_eq!(card.serve(30, &frame, &mut out), Err(NoResponse::OtherUnit));
}

#[test]
fn set_value_and_output_are_read_back_low_word_first() {
    let mut card = card();
    write(&mut card, 4, &[2.5f32.to_bits(), 1]).unwrap();
    assert_eq!(read(&mut card, 4, 4).unwrap(), [0, 0, 0x40, 0x20, 0, 1, 0, 0]);
    let settings = *card.settings();
    assert_eq!(card.hardware().committed, Some(settings));
}

#[test]
fn every_mapped_register_and_no_other_is_read() {
    let mapped: Vec<u16> = (0..4)
        .flat_map(|channel| (0..6).map(move |register| 2 + 20 * channel + 2 * register))
        .chain([80, 82, 84, 86, 422, 424, 428])
        .collect();
    for address in (0..=u16::MAX).step_by(crate::stride(211)) {
        let expected = if mapped.contains(&address) { Ok(4) } else { Err(ADDRESS) };
        assert_eq!(read(&mut card(), address, 2).map(|data| data.len()), expected, "{address}");
    }
}

#[test]
fn addresses_and_counts() {
    let mut card = card();
    assert_eq!(read(&mut card, 2, 12).unwrap().len(), 24);
    assert_eq!(read(&mut card, 2, 14), Err(ADDRESS), "runs into the gap");
    assert_eq!(read(&mut card, 2, 3), Err(ADDRESS));
    assert_eq!(read(&mut card, 2, 0), Err(VALUE));
    assert_eq!(read(&mut card, 2, 126), Err(VALUE));
    assert_eq!(read(&mut card, 0xFFFE, 4), Err(ADDRESS));
    assert_eq!(write(&mut card, 3, &[0]), Err(ADDRESS));
    assert_eq!(write(&mut card, 12, &[0, 0]), Err(ADDRESS));
    let short = Request::WriteMultipleRegisters { range: AddressRange::new(2, 2), data: &[0, 0] };
    assert!(matches!(ask(&mut card, &short, &mut [0; 5]), Response::Exception { exception: VALUE, .. }));
    let other = Request::ReadInputRegisters(AddressRange::new(2, 2));
    let illegal = ExceptionCode::IllegalFunction;
    assert!(
        matches!(ask(&mut card, &other, &mut [0; 5]), Response::Exception { exception, .. } if exception == illegal)
    );
}

#[test]
fn a_write_is_all_or_nothing_and_checked_by_what_it_leaves() {
    let mut card = card();
    let before = *card.settings();
    assert_eq!(write(&mut card, 2, &[2, 150f32.to_bits(), 2]), Err(VALUE), "output is 0 or 1");
    assert_eq!(*card.settings(), before);
    assert_eq!(write(&mut card, 4, &[150f32.to_bits()]), Err(VALUE), "beyond 5 V");
    assert_eq!(write(&mut card, 2, &[2, 150f32.to_bits()]), Ok(()), "150 mA");
    assert_eq!(write(&mut card, 2, &[1]), Ok(()));
    assert_eq!(card.settings().channels[0].set_value, 0.0, "150 does not fit 0.2 V");
    assert_eq!(write(&mut card, 4, &[0.1f32.to_bits()]), Ok(()));
    assert_eq!(write(&mut card, 2, &[0]), Ok(()));
    assert_eq!(card.settings().channels[0].set_value, 0.1, "0.1 V fits 5 V");
    for wrong in [f32::NAN, f32::INFINITY, -f32::INFINITY, 5.001, -5.001] {
        assert_eq!(write(&mut card, 4, &[wrong.to_bits()]), Err(VALUE));
        assert_eq!(write(&mut card, 12, &[wrong.to_bits()]), Err(VALUE));
    }
    assert_eq!(write(&mut card, 10, &[2, 200f32.to_bits()]), Ok(()));
    assert_eq!(write(&mut card, 10, &[0]), Ok(()));
    assert_eq!(card.settings().channels[0].start_value, 0.0);
}

#[test]
fn values_outside_their_set() {
    let mut card = card();
    for (address, value) in
        [(2, 3), (6, 2), (10, 3), (80, 3), (422, 4999), (422, 1_000_001), (424, 0), (424, 128)]
    {
        assert_eq!(write(&mut card, address, &[value]), Err(VALUE), "{address} = {value}");
    }
    assert_eq!(write(&mut card, 428, &[2]), Err(VALUE));
    assert_eq!(write(&mut card, 62436, &[0]), Err(VALUE));
    assert_eq!(write(&mut card, 8, &[7]), Ok(()), "anything but 1 is off");
}

#[test]
fn factory_reset_spares_what_has_no_default() {
    let mut card = card();
    write(&mut card, 2, &[2, 150f32.to_bits(), 1, 1, 2, 20f32.to_bits()]).unwrap();
    write(&mut card, 80, &[2]).unwrap();
    write(&mut card, 422, &[500_000, 7]).unwrap();
    write(&mut card, 428, &[1]).unwrap();
    write(&mut card, 62436, &[1]).unwrap();
    let channel = Channel { output: true, start_enable: 1, ..Channel::default() };
    let mut expected = Settings::default();
    expected.channels[0] = channel;
    assert_eq!(*card.settings(), expected);
}

#[test]
fn power_up() {
    let mut stored = Settings::default();
    stored.channels[0] = Channel {
        range: OutputRange::Milliamperes200,
        set_value: 100.0,
        output: true,
        external: External::Hold,
        ..Channel::default()
    };
    stored.channels[1] = Channel {
        output: false,
        start_enable: 1,
        start_range: OutputRange::Volts5,
        start_value: 3.0,
        ..stored.channels[0]
    };
    let forgotten = stored.after_power_up();
    assert_eq!(forgotten.channels[0], Channel::default());
    assert_eq!((forgotten.channels[1].set_value, forgotten.channels[1].output), (3.0, true));
    stored.keep = true;
    let kept = stored.after_power_up();
    assert_eq!(kept.channels[0], Channel { output: false, ..stored.channels[0] });
    assert_eq!((kept.channels[1].set_value, kept.channels[1].output), (3.0, true));
}

#[test]
fn external_control() {
    let mut card = card();
    write(&mut card, 80, &[1, 2]).unwrap();
    let mut seen = Vec::new();
    for active in [false, true, true, false, true] {
        card.external_input(0, active).unwrap();
        card.external_input(1, active).unwrap();
        card.external_input(2, active).unwrap();
        seen.push([0, 1, 2].map(|channel| card.settings().channels[channel].output));
    }
    assert_eq!(
        seen,
        [[false; 3], [true, true, false], [true, true, false], [true, false, false], [false, true, false]]
    );
    write(&mut card, 26, &[1]).unwrap();
    card.outputs_off().unwrap();
    assert!(card.settings().channels.iter().all(|channel| !channel.output));
}

#[test]
fn failing_hardware_leaves_the_registers() {
    #[derive(Default)]
    struct Broken(bool);
    impl Hardware for Broken {
        type Error = ();
        fn commit(&mut self, _: &Settings) -> Result<(), ()> {
            if self.0 { Err(()) } else { Ok(()) }
        }
    }
    let mut card = Card::power_up(Broken::default(), &Settings::default()).unwrap();
    card.hardware().0 = true;
    let data = words(&[1]);
    let request = Request::WriteMultipleRegisters { range: AddressRange::new(6, 2), data: &data };
    let failure = ExceptionCode::ServerDeviceFailure;
    let mut out = [0; 5];
    let response = ask(&mut card, &request, &mut out);
    assert!(matches!(response, Response::Exception { exception, .. } if exception == failure));
    card.hardware().0 = false;
    assert_eq!(card.dispatch(&request, &mut [0; 4]), Err(NoSpace));
    assert!(!card.settings().channels[0].output);
}
