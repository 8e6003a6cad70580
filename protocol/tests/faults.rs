//! What breaks other Modbus and CAN stacks, each with a name.

use jointbus_protocol::can::{Frame as CanFrame, Id};
use jointbus_protocol::checksum;
use jointbus_protocol::decode::{
    DecodeError, Dropped, Event, FrameDecoder, FrameEvent, ResponseMatcher, STRAY_MAX,
};
use jointbus_protocol::modbus::rtu::{self, ExpectedResponse, FRAME_MAX, FrameError};
use jointbus_protocol::modbus::server::{self, NoResponse, RamTables};
use jointbus_protocol::modbus::{
    AddressRange, FunctionCode, Request, RequestError, Response, ResponseError, ascii, tcp,
};
use jointbus_protocol::nst::can::{BROADCAST, FrameType, Identifier, Outcome, Reassembler, TRANSFER_MAX};
use jointbus_protocol::time::{Duration, Instant};

const UNIT: u8 = 7;
const SILENCE: Duration = Duration::from_millis(5);
const START: Instant = Instant::from_micros(0);

/// 80 coils, 80 inputs, 125 registers of each kind.
type Tables = RamTables<10, 10, 125, 125>;

fn sealed(content: &[u8]) -> Vec<u8> {
    [content, &checksum::crc16(content).to_le_bytes()].concat()
}

/// A frame to [`UNIT`].
fn frame(pdu: &[u8]) -> Vec<u8> {
    sealed(&[&[UNIT], pdu].concat())
}

/// A slave as a firmware builds it: decoder and general server.
struct Slave {
    decoder: FrameDecoder<{ FRAME_MAX + STRAY_MAX }>,
    tables: Tables,
    now: Instant,
    errors: Vec<DecodeError>,
}

impl Slave {
    fn new() -> Self {
        let decoder = FrameDecoder::new(SILENCE);
        Self { decoder, tables: Tables::new(), now: START, errors: Vec::new() }
    }

    /// Sends a burst and the silence after it; returns the answers.
    fn hear(&mut self, mut burst: &[u8]) -> Vec<Vec<u8>> {
        let (mut out, mut answers) = ([0; FRAME_MAX], Vec::new());
        let (tables, errors) = (&mut self.tables, &mut self.errors);
        let mut serve = |event: FrameEvent<'_>| match event {
            Event::Frame(frame) => {
                let answer = server::rtu(tables, UNIT, frame, &mut out);
                answers.extend(answer.ok().map(<[u8]>::to_vec));
            }
            Event::Dropped(Dropped { error, .. }) => errors.push(error),
        };
        while let Some(event) = self.decoder.feed(&rtu::RequestFraming, &mut burst, self.now) {
            serve(event);
        }
        self.now = self.now.saturating_add(SILENCE);
        if let Some(event) = self.decoder.poll(&rtu::RequestFraming, self.now) {
            serve(event);
        }
        answers
    }

    fn still_answers(&mut self) {
        assert_eq!(self.hear(&frame(&[3, 0, 0, 0, 1])), [frame(&[3, 2, 0, 0])]);
    }
}

/// The request is answered with this exception, nothing is written, and the slave lives on.
fn refused(pdu: &[u8], exception: u8) {
    let mut slave = Slave::new();
    assert_eq!(slave.hear(&frame(pdu)), [frame(&[pdu[0] | 0x80, exception])], "{pdu:x?}");
    assert_eq!(slave.tables, Tables::new(), "{pdu:x?} changed something");
    slave.still_answers();
}

#[test]
fn a_coil_written_with_0x1234() {
    refused(&[5, 0, 1, 0x12, 0x34], 3);
    // a bridge forwards it as it came
    let request = Request::decode(&[5, 0, 1, 0x12, 0x34]).unwrap();
    assert_eq!(request, Request::WriteSingleCoil { address: 1, value: 0x1234 });
    let mut buffer = [0; FRAME_MAX];
    assert_eq!(rtu::encode_request(UNIT, &request, &mut buffer).unwrap(), frame(&[5, 0, 1, 0x12, 0x34]));
}

#[test]
fn an_exception_of_one_byte() {
    for code in 0x80..=0xFF {
        let function = FunctionCode::from_code(code & 0x7F);
        assert_eq!(Response::decode(&[code]), Err(ResponseError::Length(function)));
        assert!(Response::decode(&[code, 2]).is_ok());
        assert_eq!(Response::decode(&[code, 2, 3]), Err(ResponseError::Length(function)));
    }
    let expected = ExpectedResponse::new(UNIT, &Request::ReadCoils(AddressRange::new(0, 1)));
    assert!(!expected.accepts(&frame(&[0x81])));
    assert!(!expected.accepts_pdu(&[0x81]));
    let mut search = ResponseMatcher::<300, 2>::default();
    assert_eq!(search.feed(&expected, &mut &frame(&[0x81])[..]), None);
    let refusal = frame(&[0x81, 2]);
    assert_eq!(search.feed(&expected, &mut &refusal[..]), Some((1, &refusal[..])));
}

#[test]
fn a_byte_count_larger_than_the_frame() {
    for pdu in [&[16, 0, 0, 0, 2, 4, 0, 1][..], &[15, 0, 0, 0, 10, 2, 0xFF], &[16, 0, 0, 0, 1, 255, 0, 1]] {
        let function = FunctionCode::from_code(pdu[0]);
        assert_eq!(Request::decode(pdu), Err(RequestError::Length(function)));
        // the decoder waits in vain for the rest, and the slave lives on
        let mut slave = Slave::new();
        assert!(slave.hear(&frame(pdu)).is_empty());
        assert_eq!(slave.errors.len(), 1);
        slave.still_answers();
        // whole frames handed to the server directly, as from TCP, get the exception
        let mut out = [0; 8];
        let answer = server::respond(&mut Tables::new(), pdu, &mut out).unwrap();
        assert_eq!(answer, [pdu[0] | 0x80, 3]);
    }
    let function = FunctionCode::ReadHoldingRegisters;
    assert_eq!(Response::decode(&[3, 4, 1, 2]), Err(ResponseError::Length(function)));
}

#[test]
fn a_byte_count_of_0_with_a_quantity_of_10() {
    refused(&[15, 0, 0, 0, 10, 0], 3);
    refused(&[16, 0, 0, 0, 10, 0], 3);
}

#[test]
fn a_byte_count_other_than_the_quantity_needs() {
    refused(&[15, 0, 0, 0, 10, 1, 0xFF], 3);
    refused(&[15, 0, 0, 0, 10, 3, 0xFF, 0xFF, 0xFF], 3);
    refused(&[16, 0, 0, 0, 2, 2, 0, 1], 3);
    refused(&[16, 0, 0, 0, 1, 3, 0, 1, 2], 3);
}

#[test]
fn a_quantity_of_0() {
    for code in 1..=4 {
        refused(&[code, 0, 0, 0, 0], 3);
    }
    refused(&[15, 0, 0, 0, 0, 0], 3);
    refused(&[16, 0, 0, 0, 0, 0], 3);
}

#[test]
fn a_run_that_passes_0xffff() {
    for code in 1..=4 {
        refused(&[code, 0xFF, 0xFF, 0, 2], 2);
    }
    refused(&[16, 0xFF, 0xFF, 0, 2, 4, 0, 0, 0, 0], 2);
}

#[test]
fn an_unknown_function_code_with_a_wrong_crc_is_not_answered() {
    for code in 0..=u8::MAX {
        let mut wrong = frame(&[code, 1, 2, 3]);
        wrong[5] ^= 0x10;
        let mut slave = Slave::new();
        assert!(slave.hear(&wrong).is_empty(), "{code:x}");
        slave.still_answers();
        let mut out = [0; FRAME_MAX];
        let direct = server::rtu(&mut Tables::new(), UNIT, &wrong, &mut out);
        assert_eq!(direct, Err(NoResponse::Frame(FrameError::Checksum)));
    }
    refused(&[0x41, 1, 2, 3], 1);
}

#[test]
fn one_bad_crc_and_then_good_requests() {
    let good = frame(&[6, 0, 1, 0xAB, 0xCD]);
    for at in 0..good.len() {
        for bit in 0..8 {
            let mut bad = good.clone();
            bad[at] ^= 1 << bit;
            // a master that waits: silence after the bad one
            let mut slave = Slave::new();
            assert!(slave.hear(&bad).is_empty(), "byte {at} bit {bit}");
            assert_eq!(slave.tables, Tables::new());
            slave.still_answers();
            // one that does not: at most what came with the bad one is lost
            let mut slave = Slave::new();
            slave.hear(&[&bad[..], &good].concat());
            slave.tables = Tables::new();
            slave.still_answers();
        }
    }
}

#[test]
fn three_hundred_bytes_of_0x55() {
    let mut slave = Slave::new();
    assert!(slave.hear(&[0x55; 300]).is_empty());
    assert_eq!(slave.errors.len(), 1);
    slave.still_answers();
    let request = Request::ReadHoldingRegisters(AddressRange::new(0, 1));
    let expected = ExpectedResponse::new(UNIT, &request);
    let mut search = ResponseMatcher::<300, 2>::default();
    assert_eq!(search.feed(&expected, &mut &[0x55; 300][..]), None);
    let reply = frame(&[3, 2, 0, 0]);
    assert_eq!(search.feed(&expected, &mut &reply[..]), Some((0, &reply[..])));
    assert_eq!(ascii::Decoder::new().feed(&mut &[0x55; 300][..], START), None);
    assert_eq!(
        tcp::Decoder::new().feed(&mut &[0x55; 300][..], START),
        Some(Event::Dropped(tcp::FrameError::Protocol(0x5555)))
    );
}

#[test]
fn ascii_without_end() {
    let mut decoder = ascii::Decoder::new();
    let mut endless = &[&b":"[..], &[b'0'; 5000]].concat()[..];
    assert_eq!(decoder.feed(&mut endless, START), Some(ascii::Event::Dropped(ascii::FrameError::Endless)));
    assert_eq!(decoder.feed(&mut endless, START), None);
    assert!(!decoder.is_inside());
    let mut buffer = [0; ascii::FRAME_MAX];
    let request = Request::ReadCoils(AddressRange::new(0, 1));
    let mut good = ascii::encode_request(UNIT, &request, &mut buffer).unwrap();
    let Some(ascii::Event::Frame(frame)) = decoder.feed(&mut good, START) else {
        panic!("the next frame is taken")
    };
    let mut out = [0; ascii::FRAME_MAX];
    assert_eq!(server::ascii(&mut Tables::new(), UNIT, &frame, &mut out), Ok(&b":07010100F7\r\n"[..]));
}

#[test]
fn mbap_lengths_of_255_and_0() {
    for length in [255u16, 0, 1, 0xFFFF] {
        let [high, low] = length.to_be_bytes();
        let mut decoder = tcp::Decoder::new();
        let header = [0, 1, 0, 0, high, low, 1];
        let mut stream = &[&header[..], &[3; 300]].concat()[..];
        let dropped = Some(Event::Dropped(tcp::FrameError::Length(length)));
        assert_eq!(decoder.feed(&mut stream, START), dropped);
        assert!(stream.is_empty());
        // and it stays closed
        assert_eq!(decoder.feed(&mut &[1, 2, 3][..], START), dropped);
    }
    let mut longest = &[&[0, 1, 0, 0, 0, 254, 1][..], &[3; 253]].concat()[..];
    let mut decoder = tcp::Decoder::new();
    let Some(Event::Frame(frame)) = decoder.feed(&mut longest, START) else { panic!("a frame") };
    assert_eq!(frame.pdu, [3; 253]);
}

#[test]
fn broadcasts_are_never_answered() {
    let mut slave = Slave::new();
    for pdu in [&[6, 0, 1, 0, 5][..], &[6, 0xFF, 0, 0, 5], &[3, 0, 0, 0, 1], &[0x41, 1]] {
        assert!(slave.hear(&sealed(&[&[0], pdu].concat())).is_empty(), "{pdu:x?}");
    }
    assert_eq!(slave.tables.holding_registers[..3], [0, 5, 0]);
}

/// The single, first, middle and last frames of a source with each counter of a short transfer, and an unknown type.
fn can_alphabet(counters: u8) -> Vec<(FrameType, u8)> {
    let types =
        [FrameType::Single, FrameType::First, FrameType::Middle, FrameType::Last, FrameType::Unknown(0)];
    types.into_iter().flat_map(|kind| (0..counters).map(move |counter| (kind, counter))).collect()
}

/// What a sequence must deliver: the numbers of its frames that form a transfer, as a reader of the manual would say.
fn transfers(sequence: &[(FrameType, u8)]) -> Vec<Vec<usize>> {
    let (mut found, mut open) = (Vec::new(), Vec::new());
    for (number, (kind, counter)) in sequence.iter().enumerate() {
        let next = usize::from(*counter) == open.len();
        match kind {
            FrameType::Single if *counter == 0 => {
                found.push(vec![number]);
                open.clear();
            }
            FrameType::First if *counter == 0 => open = vec![number],
            FrameType::Middle if next && !open.is_empty() => open.push(number),
            FrameType::Last if next && !open.is_empty() => {
                open.push(number);
                found.push(core::mem::take(&mut open));
            }
            _ => open.clear(),
        }
    }
    found
}

#[test]
fn can_frames_in_every_order_of_types_and_counters() {
    let alphabet = can_alphabet(4);
    let mut sequence = [0; 4];
    let mut tried = 0;
    loop {
        let frames: Vec<_> = sequence.iter().map(|index| alphabet[*index]).collect();
        let mut reassembler = Reassembler::<1>::new(2, SILENCE);
        let mut delivered = Vec::new();
        for (number, (frame_type, counter)) in frames.iter().enumerate() {
            let identifier =
                Identifier { source: 1, destination: 2, frame_type: *frame_type, counter: *counter };
            let frame = CanFrame::data_frame(Id::Extended(identifier.to_raw()), &[number as u8; 8]).unwrap();
            let report = reassembler.push(&frame, START);
            match report.outcome {
                Some(Outcome::Complete { source, body, .. }) => {
                    assert_eq!(source, 1);
                    delivered.push(body.chunks(8).map(|chunk| usize::from(chunk[0])).collect::<Vec<_>>());
                }
                Some(Outcome::More) => {}
                None => assert!(report.error.is_some(), "{frames:?}: dropped without a reason"),
            }
        }
        assert_eq!(delivered, transfers(&frames), "{frames:?}");
        tried += 1;
        // the next sequence, like a number of four digits
        let Some(digit) = sequence.iter().rposition(|index| *index + 1 < alphabet.len()) else { break };
        sequence[digit] += 1;
        sequence[digit + 1..].fill(0);
    }
    assert_eq!(tried, 160_000);
}

#[test]
fn can_frames_of_every_identifier_never_deliver_more_than_a_transfer() {
    for raw in (0..1 << 16).map(|low| 0x0001_0000 | low) {
        let mut reassembler = Reassembler::<1>::new(2, SILENCE);
        let frame = CanFrame::data_frame(Id::Extended(raw), &[raw as u8; 8]).unwrap();
        let [_, _, destination, format] = raw.to_be_bytes();
        for _ in 0..3 {
            let complete = match reassembler.push(&frame, START).outcome {
                Some(Outcome::Complete { body, .. }) => {
                    assert!(body.len() <= TRANSFER_MAX);
                    true
                }
                _ => false,
            };
            let meant = destination == 2 || destination == BROADCAST;
            assert_eq!(complete, meant && format == 0x10, "{raw:x}");
        }
    }
}
