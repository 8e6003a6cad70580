//! A server on a line with others: what a master, servers alive and dead, and noise put on it.

mod common;

use common::Random;
use jointbus_protocol::checksum;
use jointbus_protocol::decode::DecodeError;
use jointbus_protocol::modbus::line::{Event, MultidropDecoder};
use jointbus_protocol::modbus::rtu::{FRAME_MAX, Frame, encode_request, encode_response};
use jointbus_protocol::modbus::server::{RamTables, rtu_frame};
use jointbus_protocol::modbus::{AddressRange, BROADCAST, ExceptionCode, FunctionCode, Request, Response};
use jointbus_protocol::time::{Duration, Instant};

const SILENCE: Duration = Duration::from_micros(1750);
const MINE: std::ops::RangeInclusive<u8> = 4..=5;

#[derive(Debug, PartialEq, Clone)]
enum Out {
    Request(Vec<u8>),
    Passed(Vec<u8>),
    Dropped(DecodeError),
}

/// The line and what was heard on it.
struct Rig {
    line: MultidropDecoder,
    now: Instant,
    heard: Vec<Out>,
}

impl Rig {
    fn new() -> Self {
        Self { line: MultidropDecoder::new(MINE, SILENCE), now: Instant::from_micros(7), heard: Vec::new() }
    }

    fn send(&mut self, bytes: &[u8], piece: usize) {
        for mut chunk in bytes.chunks(piece) {
            while let Some(heard) = self.line.feed(&mut chunk, self.now) {
                self.heard.push(out(heard));
            }
            assert!(chunk.is_empty());
            self.now = self.now.saturating_add(Duration::from_micros(90));
        }
    }

    fn wait(&mut self, span: Duration) {
        self.now = self.now.saturating_add(span);
        let heard = self.line.poll(self.now).map(out);
        self.heard.extend(heard);
    }
}

fn out(heard: Event<'_>) -> Out {
    match heard {
        Event::Frame(frame) => Out::Request(whole(frame)),
        Event::Foreign(frame) => Out::Passed(whole(frame)),
        Event::Dropped(error) => Out::Dropped(error),
    }
}

/// The bytes of a frame, its checksum included.
fn whole(frame: Frame<'_>) -> Vec<u8> {
    sealed([&[frame.unit], frame.pdu].concat())
}

/// Hears `frames` one after the other without any silence, in pieces of every size.
fn hear(frames: &[&[u8]]) -> Vec<Out> {
    let stream = frames.concat();
    let mut results = Vec::new();
    for piece in 1..=stream.len() {
        let mut rig = Rig::new();
        rig.send(&stream, piece);
        rig.wait(SILENCE);
        results.push(rig.heard);
    }
    assert!(results.iter().all(|heard| *heard == results[0]), "pieces change the outcome");
    results.remove(0)
}

fn request(unit: u8, request: Request<'_>) -> Vec<u8> {
    encode_request(unit, &request, &mut [0; FRAME_MAX]).unwrap().to_vec()
}

fn response(unit: u8, response: Response<'_>) -> Vec<u8> {
    encode_response(unit, &response, &mut [0; FRAME_MAX]).unwrap().to_vec()
}

fn sealed(mut content: Vec<u8>) -> Vec<u8> {
    content.extend(checksum::crc16(&content).to_le_bytes());
    content
}

const READ: fn(u16) -> Request<'static> =
    |quantity| Request::ReadHoldingRegisters(AddressRange::new(0, quantity));

#[test]
fn requests_and_responses_of_others_are_passed_over_without_silence() {
    let (asked, answer) = (request(9, READ(2)), [3, 4, 1, 2, 3, 4]);
    let answer = sealed([&[9][..], &answer].concat());
    let refusal =
        response(9, Response::exception(FunctionCode::ReadHoldingRegisters, ExceptionCode::ServerDeviceBusy));
    let mine = request(4, READ(1));
    let passed = |frame: &[u8]| Out::Passed(frame.into());
    assert_eq!(
        hear(&[&asked, &answer, &asked, &refusal, &mine]),
        [passed(&asked), passed(&answer), passed(&asked), passed(&refusal), Out::Request(mine)]
    );
}

#[test]
fn a_server_that_does_not_answer_is_not_waited_for() {
    let (dead, mine, all) = (
        request(9, READ(2)),
        request(5, READ(1)),
        request(BROADCAST, Request::WriteSingleRegister { address: 1, value: 2 }),
    );
    assert_eq!(
        hear(&[&dead, &mine, &dead, &dead, &all, &mine]),
        [
            Out::Passed(dead.clone()),
            Out::Request(mine.clone()),
            Out::Passed(dead.clone()),
            Out::Passed(dead),
            Out::Request(all),
            Out::Request(mine)
        ]
    );
}

#[test]
fn a_response_full_of_requests_to_me_is_passed_over() {
    // at every place in the data of a response and of a write to another one
    let to_me = request(4, Request::WriteSingleRegister { address: 0, value: 0xDEAD });
    let mine = request(4, READ(1));
    for place in 0..=242 {
        let mut data = vec![4; 250];
        data[place..place + 8].copy_from_slice(&to_me);
        let asked = request(9, READ(125));
        let answer =
            response(9, Response::Read { function: FunctionCode::ReadHoldingRegisters, data: &data });
        let write = Request::WriteMultipleRegisters { range: AddressRange::new(0, 123), data: &data[..246] };
        let (write, written) = (
            request(9, write),
            response(
                9,
                Response::WriteMultiple {
                    function: FunctionCode::WriteMultipleRegisters,
                    range: AddressRange::new(0, 123),
                },
            ),
        );
        let mut rig = Rig::new();
        rig.send(&[&asked[..], &answer, &write, &written, &mine].concat(), 7);
        let expected =
            [asked, answer, write, written].map(Out::Passed).into_iter().chain([Out::Request(mine.clone())]);
        assert_eq!(rig.heard, expected.collect::<Vec<_>>(), "at {place}");
    }
}

/// Data such that a response starts with what is a whole, valid request to the same server, and goes on with one to me.
fn two_faced() -> (Vec<u8>, Vec<u8>) {
    let asked = request(9, READ(8));
    let mut answer = vec![9, 3, 16, 0, 0, 1];
    answer.extend(checksum::crc16(&answer).to_le_bytes());
    answer.extend(request(4, Request::WriteSingleRegister { address: 0, value: 0xDEAD }));
    answer.extend([0; 3]);
    (asked, sealed(answer))
}

#[test]
fn a_response_that_starts_as_a_request_is_still_a_response() {
    let (asked, answer) = two_faced();
    let mine = request(4, READ(1));
    assert_eq!(
        hear(&[&asked, &answer, &mine]),
        [Out::Passed(asked), Out::Passed(answer), Out::Request(mine)]
    );
}

#[test]
fn and_spoilt_it_executes_nothing_either() {
    let (asked, answer) = two_faced();
    for at in 0..answer.len() {
        for flip in 1..=255 {
            let mut rig = Rig::new();
            rig.send(&asked, 8);
            let mut spoilt = answer.clone();
            spoilt[at] ^= flip;
            if spoilt[0] == 4 || spoilt[0] == 5 || spoilt[0] == BROADCAST {
                continue;
            }
            rig.send(&spoilt, 5);
            rig.wait(SILENCE);
            assert!(!rig.heard.iter().any(|out| matches!(out, Out::Request(_))), "{at} ^ {flip:x}");
        }
    }
}

#[test]
fn nor_when_its_request_was_not_heard() {
    let (asked, answer) = two_faced();
    let mine = request(4, READ(1));
    // the first frame after power-up
    let mut rig = Rig::new();
    rig.send(&answer, 5);
    rig.send(&mine, 5);
    assert_eq!(rig.heard, [Out::Passed(answer.clone()), Out::Request(mine.clone())]);
    // noise on the request, but only where we are
    for at in 0..asked.len() {
        let mut spoilt = asked.clone();
        spoilt[at] ^= 0x40;
        let mut rig = Rig::new();
        rig.send(&mine, 8);
        rig.send(&spoilt, 8);
        rig.wait(SILENCE);
        rig.send(&answer, 8);
        rig.wait(SILENCE);
        rig.send(&mine, 8);
        assert_eq!(rig.heard.len(), 4, "{at}: {:?}", rig.heard);
        assert_eq!(rig.heard[2..], [Out::Passed(answer.clone()), Out::Request(mine.clone())]);
    }
}

#[test]
fn a_repeated_request_that_could_start_a_response_ends_by_silence() {
    // address 0x1000: its high byte is the byte count of eight registers
    let asked = request(9, Request::ReadHoldingRegisters(AddressRange::new(0x1000, 8)));
    let mine = request(4, READ(1));
    let mut rig = Rig::new();
    rig.send(&asked, 3);
    rig.wait(SILENCE);
    rig.send(&asked, 3);
    rig.wait(SILENCE);
    rig.send(&mine, 3);
    assert_eq!(rig.heard, [Out::Passed(asked.clone()), Out::Passed(asked), Out::Request(mine)]);
}

#[test]
fn after_anything_wrong_nothing_until_silence() {
    let mine = request(4, Request::WriteSingleRegister { address: 1, value: 2 });
    let mut wrong = request(9, READ(2));
    wrong[7] ^= 1;
    assert_eq!(hear(&[&wrong, &mine]), [Out::Dropped(DecodeError::Checksum)]);
    let done = request(5, READ(1));
    assert_eq!(
        hear(&[&done, &[9, 0x83], &mine]),
        [Out::Request(done), Out::Dropped(DecodeError::Impossible)],
        "a response nobody asked for"
    );
    assert_eq!(
        hear(&[&[0xAA], &mine]),
        [Out::Dropped(DecodeError::Incomplete)],
        "stray bytes are not forgiven"
    );
    let mut rig = Rig::new();
    rig.send(&wrong, 8);
    rig.wait(SILENCE);
    rig.send(&mine, 8);
    assert_eq!(rig.heard, [Out::Dropped(DecodeError::Checksum), Out::Request(mine)]);
}

#[test]
fn an_unknown_function_code_ends_by_silence_for_me_and_for_others() {
    let other = Request::Other { function: FunctionCode::Unknown(0x41), data: &[1, 2, 3] };
    let (mine, theirs, next) = (request(4, other), request(9, other), request(4, READ(1)));
    let mut rig = Rig::new();
    for frame in [&theirs, &theirs, &mine, &next] {
        rig.send(frame, 4);
        rig.wait(SILENCE);
    }
    assert_eq!(
        rig.heard,
        [Out::Passed(theirs.clone()), Out::Passed(theirs), Out::Request(mine), Out::Request(next)]
    );
}

/// Requests of every kind that has a length of its own.
fn any_request<'a>(random: &mut Random, data: &'a [u8]) -> Request<'a> {
    let address = random.next() as u16;
    let quantity = 1 + random.below(60) as u16;
    let range = AddressRange::new(address, quantity);
    match random.below(11) {
        0 => Request::ReadCoils(range),
        1 => Request::ReadDiscreteInputs(range),
        2 | 3 => Request::ReadHoldingRegisters(range),
        4 => Request::ReadInputRegisters(range),
        5 => Request::WriteSingleCoil { address, value: 0xFF00 },
        6 => Request::WriteSingleRegister { address, value: random.next() as u16 },
        7 => Request::WriteMultipleCoils { range, data: &data[..usize::from(quantity).div_ceil(8)] },
        8 => Request::WriteMultipleRegisters { range, data: &data[..2 * usize::from(quantity)] },
        9 => Request::MaskWriteRegister { address, and: 1, or: 2 },
        _ => Request::ReadWriteMultipleRegisters {
            read: range,
            write: AddressRange::new(address, 2),
            data: &data[..4],
        },
    }
}

fn any_response(random: &mut Random, unit: u8, request: &Request<'_>, data: &[u8]) -> Vec<u8> {
    let function = request.function();
    if random.once_in(10) {
        return response(unit, Response::exception(function, ExceptionCode::ServerDeviceFailure));
    }
    let read = |bytes: usize| Response::Read { function, data: &data[..bytes] };
    response(
        unit,
        match *request {
            Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
                read(usize::from(range.quantity).div_ceil(8))
            }
            Request::ReadHoldingRegisters(range)
            | Request::ReadInputRegisters(range)
            | Request::ReadWriteMultipleRegisters { read: range, .. } => {
                read(2 * usize::from(range.quantity))
            }
            Request::WriteSingleCoil { address, value } | Request::WriteSingleRegister { address, value } => {
                Response::WriteSingle { function, address, value }
            }
            Request::MaskWriteRegister { address, and, or } => Response::MaskWrite { address, and, or },
            Request::WriteMultipleCoils { range, .. } | Request::WriteMultipleRegisters { range, .. } => {
                Response::WriteMultiple { function, range }
            }
            _ => unreachable!(),
        },
    )
}

/// Data that is half noise and half requests to me.
fn any_data(random: &mut Random) -> Vec<u8> {
    let mut data = Vec::new();
    while data.len() < 260 {
        if random.once_in(2) {
            let address = random.next() as u16;
            data.extend(request(4, Request::WriteSingleRegister { address, value: 0xDEAD }));
        } else {
            let count = random.below(9);
            data.extend(random.bytes(count));
        }
    }
    data
}

/// A master that asks me, two servers that answer and one that is dead, and waits for every answer.
/// Returns the requests to me that were sent, and those that were heard.
fn traffic(
    seed: u64,
    exchanges: usize,
    corrupt_once_in: Option<usize>,
) -> (Vec<Vec<u8>>, Vec<Vec<u8>>, usize) {
    let mut random = Random::new(seed);
    let mut rig = Rig::new();
    let (mut sent, mut corruptions) = (Vec::new(), 0);
    let mut send = |rig: &mut Rig, random: &mut Random, frame: &[u8]| {
        let mut frame = frame.to_vec();
        let broken = corrupt_once_in.is_some_and(|times| random.once_in(times));
        if broken {
            corruptions += 1;
            match random.below(4) {
                0 => frame.truncate(random.below(frame.len())),
                1 => frame.insert(random.below(frame.len()), random.byte()),
                2 => drop(frame.remove(random.below(frame.len()))),
                _ => {
                    let at = random.below(frame.len());
                    frame[at] ^= 1 + random.byte() % 255;
                }
            }
        }
        let piece = 1 + random.below(20);
        rig.send(&frame, piece);
        rig.wait(SILENCE);
        !broken
    };
    for _ in 0..exchanges {
        let data = any_data(&mut random);
        let asked = any_request(&mut random, &data);
        let unit = [4, 5, 9, 10, 11, BROADCAST][random.below(6)];
        if unit == BROADCAST && asked.is_read() {
            continue;
        }
        let frame = request(unit, asked);
        let arrived = send(&mut rig, &mut random, &frame);
        match unit {
            4 | 5 | BROADCAST if arrived => sent.push(frame),
            // 9 and 10 heard it, whatever the noise was where we are
            9 | 10 => {
                let answer = any_response(&mut random, unit, &asked, &data);
                send(&mut rig, &mut random, &answer);
            }
            _ => rig.wait(Duration::from_millis(100)),
        }
    }
    let heard = rig.heard.into_iter().filter_map(|out| match out {
        Out::Request(frame) => Some(frame),
        Out::Passed(_) | Out::Dropped(_) => None,
    });
    (sent, heard.collect(), corruptions)
}

#[test]
fn long_traffic_without_faults_loses_and_invents_nothing() {
    for seed in 0..20 {
        let (sent, heard, _) = traffic(seed, 500, None);
        assert_eq!(sent, heard, "seed {seed}");
        assert!(sent.len() > 100);
    }
}

#[test]
fn long_traffic_with_faults_loses_at_most_one_frame_a_fault_and_executes_none_that_was_not_sent() {
    for seed in 100..120 {
        let (sent, heard, corruptions) = traffic(seed, 500, Some(10));
        let mut rest = sent.iter();
        for frame in &heard {
            assert!(rest.any(|sent| sent == frame), "seed {seed}: {frame:x?} was never sent so");
        }
        let lost = sent.len() - heard.len();
        assert!(lost <= corruptions, "seed {seed}: {lost} lost, {corruptions} faults");
        // silence after every frame: what was not hit itself arrives
        assert_eq!(lost, 0, "seed {seed}");
        assert!(corruptions > 20);
    }
}

#[test]
fn a_write_of_others_and_its_response_need_no_silence_unless_the_crc_counts_right() {
    let mine = request(4, READ(1));
    let mut waited = 0;
    for address in 0..1000 {
        let range = AddressRange::new(address, 3);
        let function = FunctionCode::WriteMultipleRegisters;
        let asked = request(9, Request::WriteMultipleRegisters { range, data: &[1, 2, 3, 4, 5, 6] });
        let answer = response(9, Response::WriteMultiple { function, range });
        let mut rig = Rig::new();
        rig.send(&[&asked[..], &answer].concat(), 6);
        rig.send(&mine, 8);
        let heard = rig.heard.contains(&Out::Request(mine.clone()));
        // the CRC's low byte stands where the byte count of a repeated request would
        assert_eq!(heard, answer[6] != 6, "{address}");
        waited += u32::from(!heard);
    }
    assert!(waited < 10, "{waited}");
}

#[test]
fn a_server_answers_from_the_line() {
    let mut tables = RamTables::<0, 0, 4, 0>::new();
    tables.holding_registers = [1, 2, 3, 4];
    let mut line = MultidropDecoder::new(MINE, SILENCE);
    let (asked, mut answer) = (request(4, READ(2)), [0; FRAME_MAX]);
    let Some(Event::Frame(frame)) = line.feed(&mut &asked[..], Instant::from_micros(0)) else {
        panic!("a request")
    };
    assert_eq!(rtu_frame(&mut tables, 4, &frame, &mut answer), Ok(&sealed(vec![4, 3, 4, 0, 1, 0, 2])[..]));
}
