use super::*;
use crate::wire::Writer;
use std::vec::Vec;

fn daq() -> Daq<RamHardware> {
    let mut hardware = RamHardware::new(1);
    hardware.sample = Sample([1000, -2000, 3000, -4, 5, -6]);
    Daq::new(hardware, SignEncoding::TwosComplement)
}

fn ask(daq: &mut Daq<RamHardware>, body: &[u8]) -> Result<Vec<u8>, NoResponse> {
    let (mut data, mut out) = ([0xEE; REPLY_DATA_MAX], [0xEE; REPLY_DATA_MAX + RESPONSE_HEADER]);
    let reply = daq.serve(daq.address(), body, &mut data)?;
    let mut writer = Writer::new(&mut out);
    reply.encode(&mut writer).unwrap();
    Ok(writer.finish().to_vec())
}

fn refused(reason: Refusal) -> Result<Vec<u8>, NoResponse> {
    Err(NoResponse::Refused(reason))
}

#[test]
fn data_is_big_endian_and_followed_by_zeros() {
    let reply = ask(&mut daq(), &[3, 2, 0, 20]).unwrap();
    assert_eq!(reply[..8], [3, 20, 0, 0x03, 0xE8, 0xFF, 0xF8, 0x30]);
    assert_eq!(reply[20..], [0, 0]);
}

#[test]
fn a_read_may_cross_from_settings_into_data() {
    let reply = ask(&mut daq(), &[3, 0x01, 0xFE, 5]).unwrap();
    assert_eq!(reply, [3, 5, 0, 0, 0, 0x03, 0xE8]);
}

#[test]
fn limits_of_reads() {
    let mut daq = daq();
    assert_eq!(ask(&mut daq, &[3, 0, 0, 0]), refused(Refusal::Length));
    assert_eq!(ask(&mut daq, &[3, 0, 0, 249]).unwrap().len(), 251);
    assert_eq!(ask(&mut daq, &[3, 0, 0, 250]), refused(Refusal::Length));
    assert_eq!(ask(&mut daq, &[3, 2, 0xFF, 1]).unwrap(), [3, 1, 0]);
    assert_eq!(ask(&mut daq, &[3, 2, 0xFF, 2]), refused(Refusal::Register));
    assert_eq!(ask(&mut daq, &[3, 0xFF, 0xFF, 2]), refused(Refusal::Register));
}

#[test]
fn settings_act_after_a_restart() {
    let mut daq = daq();
    assert_eq!(ask(&mut daq, &[0x10, 0x01, 0x93, 1, 9]).unwrap(), [0x10, 1]);
    assert_eq!(ask(&mut daq, &[3, 0x01, 0x93, 1]).unwrap(), [3, 1, 9], "a read gives the new value");
    assert_eq!(daq.address(), 1);
    assert_eq!(ask(&mut daq, &[0x12, 0x01, 0xA7, 24]).unwrap(), [0x12, 24]);
    assert_eq!(daq.sample().0[0], 1000, "zero points wait as well");
    assert_eq!(ask(&mut daq, &[0x18, 0, 0, 1]).unwrap(), [0x18, 1]);
    assert_eq!(daq.address(), 9);
    assert_eq!(daq.sample(), Sample::default());
    assert_eq!(ask(&mut daq, &[0x19, 0x01, 0xA7, 24]).unwrap(), [0x19, 24]);
    daq.restart();
    assert_eq!(daq.sample().0[0], 1000);
}

#[test]
fn values_outside_their_set() {
    let mut daq = daq();
    let mut set = |register: u16, data: &[u8]| {
        let [high, low] = register.to_be_bytes();
        let mut body = std::vec![0x10, high, low, data.len() as u8];
        body.extend_from_slice(data);
        ask(&mut daq, &body)
    };
    assert_eq!(set(0x0193, &[0]), refused(Refusal::Value));
    assert_eq!(set(0x0193, &[0x80]), refused(Refusal::Value));
    assert!(set(0x0193, &[0x7F]).is_ok());
    assert_eq!(set(0x01C2, &[2]), refused(Refusal::Value));
    assert_eq!(set(0x01C7, &[2]), refused(Refusal::Value));
    assert_eq!(set(0x0198, &999u32.to_le_bytes()), refused(Refusal::Value));
    assert!(set(0x0198, &500u32.to_le_bytes()).is_ok());
    assert!(set(0x0194, &57_600u32.to_le_bytes()).is_ok());
    assert!(set(0x019C, &460_800u32.to_le_bytes()).is_ok());
    assert!(set(0x019C, &[1]).is_ok(), "a single byte makes the rate unknown");
    assert_eq!(set(0x0173, &[1]), refused(Refusal::ReadOnly));
    assert_eq!(set(0x0172, &[1, 1]), refused(Refusal::ReadOnly));
    assert_eq!(set(0x0200, &[1]), refused(Refusal::ReadOnly));
    assert_eq!(set(0x0300, &[1]), refused(Refusal::Register));
    assert_eq!(set(0x0000, &[]), refused(Refusal::Length));
    assert_eq!(set(0xFFFF, &[1, 1]), refused(Refusal::Register));
    assert_eq!(ask(&mut daq, &[3, 0x01, 0x94, 4]).unwrap(), [3, 4, 0, 0xC2, 1, 0], "115200");
    assert_eq!(ask(&mut daq, &[3, 0x01, 0x98, 4]).unwrap(), [3, 4, 0xF4, 1, 0, 0], "500");
    assert_eq!(ask(&mut daq, &[3, 0x01, 0x9C, 4]).unwrap(), [3, 4, 0, 0xC2, 1, 0], "115200");
}

#[test]
fn commands_have_one_form() {
    let mut daq = daq();
    for body in
        [[0x12, 1, 0xA7, 23], [0x19, 1, 0xA6, 24], [0x18, 0, 0, 2], [0x18, 0, 1, 1], [0x15, 1, 0xA1, 5]]
    {
        assert_eq!(ask(&mut daq, &body), refused(Refusal::CommandForm));
    }
    assert_eq!(ask(&mut daq, &[0x13, 0, 0, 1]).unwrap(), [0x13, 1]);
    assert_eq!(ask(&mut daq, &[0x15, 1, 0xA1, 6]).unwrap(), [0x15, 6, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn a_broadcast_is_carried_out_and_never_answered() {
    let mut daq = daq();
    let mut data = [0; REPLY_DATA_MAX];
    let write = [0x10, 0x01, 0x93, 1, 9];
    assert_eq!(daq.serve(0xFF, &write, &mut data), Err(NoResponse::Broadcast(None)));
    assert_eq!(daq.serve(0xFF, &[3, 1, 0x93, 1], &mut data), Err(NoResponse::BroadcastRead));
    assert_eq!(daq.serve(2, &write, &mut data), Err(NoResponse::OtherAddress));
    daq.restart();
    assert_eq!(daq.address(), 9);
}

#[test]
fn who_cannot_be_answered_is_not_served() {
    let (mut daq, mut frame, mut out) = (daq(), [0; 16], [0; 16]);
    let before = daq.hardware().settings;
    let request = Request::Write { register: register::IP_ADDRESS.first, data: &[10, 0, 0, 1] };
    let frame = serial::encode_request(1, &request, &mut frame).unwrap();
    assert_eq!(daq.serve_serial(frame, &mut out[..4]), Err(NoResponse::NoSpace));
    assert_eq!(daq.serve_stream(&frame[..frame.len() - 2], &mut out[..2]), Err(NoResponse::NoSpace));
    assert_eq!(daq.hardware().settings, before);
    assert_eq!(daq.serve_serial(frame, &mut out[..5]).map(<[u8]>::len), Ok(5));
}

#[test]
fn transfers_on_can_are_answered_up_to_their_longest() {
    let mut daq = daq();
    let mut buffer = [0xEE; can::TRANSFER_MAX];
    let frames = |daq: &mut Daq<RamHardware>, body: &[u8], buffer: &mut _| {
        daq.serve_can(2, 1, body, buffer).map(Iterator::count)
    };
    assert_eq!(frames(&mut daq, &[3, 2, 0, 18], &mut buffer), Ok(3));
    assert_eq!(frames(&mut daq, &[3, 0, 0, 126], &mut buffer), Ok(16));
    assert_eq!(frames(&mut daq, &[3, 0, 0, 127], &mut buffer), Err(NoResponse::Refused(Refusal::Length)));
    assert_eq!(frames(&mut daq, &[0x18, 0, 0, 1], &mut buffer), Ok(1));
    assert_eq!(daq.serve_can(2, 9, &[3, 2, 0, 18], &mut buffer).err(), Some(NoResponse::OtherAddress));
}

#[test]
fn the_printed_serial_frames_are_answered_as_printed() {
    let mut out = [0xEE; serial::RESPONSE_MAX];
    let request = [0x01, 0x12, 0x01, 0xA7, 0x18, 0x37, 0x42];
    assert_eq!(daq().serve_serial(&request, &mut out), Ok(&[0x01, 0x12, 0x18, 0x2C, 0xAA][..]));
    let mut wrong = request;
    wrong[6] ^= 1;
    assert_eq!(daq().serve_serial(&wrong, &mut out), Err(NoResponse::Checksum));
    assert_eq!(daq().serve_stream(&request[..5], &mut out), Ok(&[0x01, 0x12, 0x18][..]));
}

#[test]
fn the_hardware_is_told_of_a_restart_once() {
    let mut daq = daq();
    assert_eq!((daq.needs_restart(), daq.hardware().restarts), (false, 0));
    ask(&mut daq, &[0x10, 0x01, 0x94, 4, 0x80, 0x25, 0, 0]).unwrap();
    ask(&mut daq, &[0x10, 0x01, 0x98, 4, 0xFA, 0, 0, 0]).unwrap();
    assert_eq!((daq.active().uart1_baud, daq.active().can_rate), (115_200, 1000));
    assert_eq!(daq.hardware().settings.uart1_baud(), 9600, "written");
    assert_eq!((daq.needs_restart(), daq.hardware().restarts), (true, 0));
    assert_eq!(ask(&mut daq, &[0x18, 0, 0, 1]).unwrap(), [0x18, 1]);
    assert_eq!((daq.active().uart1_baud, daq.active().can_rate), (9600, 250));
    assert_eq!((daq.needs_restart(), daq.hardware().restarts), (false, 1));
    let restart = [0x18, 0, 0, 1];
    assert_eq!(daq.serve(0xFF, &restart, &mut []), Err(NoResponse::Broadcast(None)));
    assert_eq!(daq.hardware().restarts, 2, "by broadcast as well");
    assert_eq!(ask(&mut daq, &[0x18, 0, 0, 2]), refused(Refusal::CommandForm));
    assert_eq!(daq.hardware().restarts, 2);
}

#[test]
fn no_address_makes_a_device_mute() {
    for address in 0..=u8::MAX {
        let mut daq = Daq::new(RamHardware::new(address), SignEncoding::TwosComplement);
        assert_eq!(daq.address(), if (0x01..=0x7F).contains(&address) { address } else { 0x01 });
        assert!(ask(&mut daq, &[3, 2, 0, 18]).is_ok());
    }
}
