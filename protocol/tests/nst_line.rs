//! An NST device on a line with others: what a master, devices alive and dead, and noise put on it, at 115200 baud.

mod common;

use common::Random;
use jointbus_protocol::checksum;
use jointbus_protocol::decode::DecodeError;
use jointbus_protocol::nst::line::{Event, MultidropDecoder};
use jointbus_protocol::nst::serial::{self, REQUEST_MAX, RESPONSE_MAX};
use jointbus_protocol::nst::{
    Daq, FunctionCode, NoResponse, RamHardware, Request, Response, SignEncoding, register,
};
use jointbus_protocol::time::{Duration, Instant};

const SILENCE: Duration = Duration::from_micros(1750);
const ADDRESS: u8 = 5;

/// Gaps between frames: shorter than the silence.
const GAPS: [Duration; 2] = [Duration::from_micros(300), Duration::from_millis(1)];

#[derive(Debug, PartialEq, Clone)]
enum Out {
    Frame(Vec<u8>),
    Foreign(Vec<u8>),
    Dropped(DecodeError),
}

/// The line and what was heard on it.
struct Rig {
    line: MultidropDecoder,
    gap: Duration,
    now: Instant,
    /// Microseconds times ten: a character takes 86.8 us.
    tenths: u64,
    heard: Vec<Out>,
}

impl Rig {
    fn new(gap: Duration) -> Self {
        let line = MultidropDecoder::new(ADDRESS..=ADDRESS, SILENCE);
        Self { line, gap, now: Instant::from_micros(7), tenths: 0, heard: Vec::new() }
    }

    fn pass(&mut self, span: Duration) {
        self.now = self.now.saturating_add(span);
        let event = self.line.poll(self.now).map(out);
        self.heard.extend(event);
    }

    /// A frame, or noise, and the gap behind it.
    fn send(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.tenths += 868;
            self.pass(Duration::from_micros(self.tenths / 10));
            self.tenths %= 10;
            let mut byte = &[*byte][..];
            while let Some(event) = self.line.feed(&mut byte, self.now) {
                self.heard.push(out(event));
            }
        }
        self.pass(self.gap);
    }

    /// We answer: our own bytes are not heard.
    fn answer(&mut self, length: u64) {
        self.now = self.now.saturating_add(Duration::from_micros(87 * length)).saturating_add(self.gap);
    }

    fn frames(&self) -> impl Iterator<Item = &Vec<u8>> {
        self.heard.iter().filter_map(|out| match out {
            Out::Frame(frame) => Some(frame),
            Out::Foreign(_) | Out::Dropped(_) => None,
        })
    }
}

fn out(event: Event<'_>) -> Out {
    let sealed_frame = |frame: serial::Frame<'_>| sealed([&[frame.address], frame.body].concat());
    match event {
        Event::Frame(frame) => Out::Frame(sealed_frame(frame)),
        Event::Foreign(frame) => Out::Foreign(sealed_frame(frame)),
        Event::Dropped(error) => Out::Dropped(error),
    }
}

fn sealed(mut content: Vec<u8>) -> Vec<u8> {
    content.extend(checksum::crc16(&content).to_le_bytes());
    content
}

fn request(address: u8, request: Request<'_>) -> Vec<u8> {
    serial::encode_request(address, &request, &mut [0; REQUEST_MAX]).unwrap().to_vec()
}

fn response(address: u8, response: Response<'_>) -> Vec<u8> {
    serial::encode_reply(address, &response, &mut [0; RESPONSE_MAX]).unwrap().to_vec()
}

fn read_axes(address: u8) -> Vec<u8> {
    request(address, Request::read(register::DATA.first, 18))
}

fn axes(address: u8, data: &[u8; 18]) -> Vec<u8> {
    response(address, Response::Data { function: FunctionCode::Read, data })
}

/// A write that would do harm.
fn harm() -> Vec<u8> {
    request(ADDRESS, Request::Write { register: register::ADDRESS.first, data: &[0x7E] })
}

#[test]
fn every_request_beside_the_exchanges_of_a_neighbour_is_answered() {
    for gap in GAPS {
        let mut rig = Rig::new(gap);
        let mut random = Random::new(1);
        let mut daq = Daq::new(RamHardware::new(ADDRESS), SignEncoding::TwosComplement);
        let (mine, mut out) = (read_axes(ADDRESS), [0; RESPONSE_MAX]);
        let mut answered = 0;
        for _ in 0..200 {
            rig.send(&read_axes(2));
            rig.send(&axes(2, &core::array::from_fn(|_| random.byte())));
            rig.send(&mine);
            let Some(Out::Frame(frame)) = rig.heard.last() else { continue };
            let answer = daq.serve_serial(frame, &mut out).unwrap().len();
            answered += 1;
            rig.answer(answer as u64);
        }
        assert_eq!(answered, 200, "{gap:?}");
        assert_eq!(rig.heard.iter().filter(|out| matches!(out, Out::Foreign(_))).count(), 400);
    }
}

#[test]
fn a_device_that_does_not_answer_is_not_waited_for() {
    for gap in GAPS {
        let mut rig = Rig::new(gap);
        for _ in 0..50 {
            rig.send(&read_axes(3));
            rig.send(&read_axes(3));
            rig.send(&read_axes(ADDRESS));
            rig.send(&request(3, Request::Write { register: 0x0193, data: &[4] }));
            rig.send(&request(0xFF, Request::Write { register: 0x01A5, data: &[4, 5] }));
            rig.send(&read_axes(ADDRESS));
        }
        assert_eq!(rig.frames().count(), 150, "{gap:?}");
    }
}

#[test]
fn every_kind_of_exchange_is_passed_over() {
    let command = |function, register, length| Request::Command { function, register, length };
    for gap in GAPS {
        for address in (1..=0x7F).filter(|address| *address != ADDRESS) {
            let mut rig = Rig::new(gap);
            let mut count = 0;
            for asked in [
                Request::read(0, 249),
                Request::read(register::UART1_BAUD.first, 1),
                Request::read(register::UART1_BAUD.first, 2),
                Request::read(register::UART1_BAUD.first, 3),
                Request::Write { register: 0, data: &[0x55; 249] },
                Request::Write { register: register::IP_PORT.first, data: &[1, 2] },
                command(FunctionCode::SetZero, 0x01A7, 24),
                command(FunctionCode::ClearZero, 0x01A7, 24),
                command(FunctionCode::Search, 0x01A1, 6),
                command(FunctionCode::Restart, 0, 1),
                command(FunctionCode::Connect, 0, 1),
            ] {
                let (function, length) = (asked.function(), asked.length());
                let data = vec![0xA5; length.into()];
                let answer = match function.is_read() {
                    true => Response::Data { function, data: &data },
                    false => Response::Acknowledge { function, length },
                };
                rig.send(&request(address, asked));
                rig.send(&response(address, answer));
                rig.send(&read_axes(ADDRESS));
                count += 1;
                assert_eq!(rig.frames().count(), count, "{address} {asked:x?} {:x?}", rig.heard);
            }
        }
    }
}

/// An acknowledgement that starts like a write of five bytes and more costs at most the request behind it.
#[test]
fn the_acknowledgement_of_one_byte_may_need_silence() {
    let mut needy = 0;
    for address in (1..=0x7F).filter(|address| *address != ADDRESS) {
        let mut rig = Rig::new(GAPS[0]);
        rig.send(&request(address, Request::Write { register: register::CHANNEL.first, data: &[1] }));
        rig.send(&response(address, Response::Acknowledge { function: FunctionCode::Write, length: 1 }));
        rig.send(&read_axes(ADDRESS));
        needy += u32::from(rig.frames().count() == 0);
        rig.pass(SILENCE);
        rig.send(&read_axes(ADDRESS));
        assert!(rig.frames().count() > 0);
    }
    assert!(needy < 50, "{needy}");
}

#[test]
fn a_frame_to_us_in_the_data_of_another_is_never_executed() {
    let harm = harm();
    for gap in GAPS {
        for place in 0..=249 - harm.len() {
            let mut data = vec![ADDRESS; 249];
            data[place..place + harm.len()].copy_from_slice(&harm);
            let mut rig = Rig::new(gap);
            rig.send(&request(2, Request::read(0, 249)));
            rig.send(&response(2, Response::Data { function: FunctionCode::Read, data: &data }));
            rig.send(&request(2, Request::Write { register: 0, data: &data }));
            rig.send(&response(2, Response::Acknowledge { function: FunctionCode::Write, length: 249 }));
            rig.send(&read_axes(ADDRESS));
            assert_eq!(rig.frames().collect::<Vec<_>>(), [&read_axes(ADDRESS)], "at {place}");
        }
    }
}

#[test]
fn nor_where_the_frame_around_it_is_spoilt_or_cut() {
    let harm = harm();
    let mut data = vec![0x03; 40];
    data[9..9 + harm.len()].copy_from_slice(&harm);
    let write = request(2, Request::Write { register: 0, data: &data });
    let read = request(2, Request::read(0, 40));
    let answer = response(2, Response::Data { function: FunctionCode::Read, data: &data });
    for gap in GAPS {
        for (before, frame) in [(&read, &answer), (&answer, &write), (&write, &write)] {
            for at in 0..frame.len() {
                for flip in (1..=255).step_by(7) {
                    let mut spoilt = frame.clone();
                    spoilt[at] ^= flip;
                    let mut rig = Rig::new(gap);
                    rig.send(before);
                    rig.send(&spoilt);
                    rig.pass(SILENCE);
                    rig.send(&read_axes(ADDRESS));
                    assert!(rig.frames().all(|frame| *frame != harm), "{at} ^ {flip:x}");
                    assert!(rig.frames().any(|frame| *frame == read_axes(ADDRESS)));
                }
                let mut rig = Rig::new(gap);
                rig.send(before);
                rig.send(&frame[..at]);
                rig.send(before);
                rig.send(&frame[at..]);
                assert!(rig.frames().all(|frame| *frame != harm), "cut at {at}");
            }
        }
    }
}

#[test]
fn a_spoilt_response_ends_where_its_length_says() {
    for gap in GAPS {
        for at in 3..23 {
            let mut rig = Rig::new(gap);
            let mut spoilt = axes(2, &[7; 18]);
            spoilt[at] ^= 0x10;
            rig.send(&read_axes(2));
            rig.send(&spoilt);
            rig.send(&read_axes(ADDRESS));
            let expected = [
                Out::Foreign(read_axes(2)),
                Out::Dropped(DecodeError::Checksum),
                Out::Frame(read_axes(ADDRESS)),
            ];
            assert_eq!(rig.heard, expected);
        }
    }
}

#[test]
fn an_exchange_of_others_brings_it_back_into_step() {
    for gap in GAPS {
        for noise in [&[0xFF][..], &[0x02, 0x03], &[0; 30], &[ADDRESS, 0x03, 0x02], &[0x02, 0x10, 0, 0, 9]] {
            let mut rig = Rig::new(gap);
            rig.send(&read_axes(ADDRESS));
            rig.send(noise);
            rig.send(&harm());
            rig.send(&read_axes(2));
            rig.send(&harm());
            assert_eq!(rig.frames().count(), 1, "not yet: {noise:x?}");
            // what noise can start is waited for
            for _ in 0..3 {
                rig.send(&read_axes(2));
                rig.send(&axes(2, &[9; 18]));
            }
            rig.send(&read_axes(ADDRESS));
            assert_eq!(rig.frames().count(), 2, "{noise:x?}: {:x?}", rig.heard);
            assert_eq!(rig.heard.iter().filter(|out| matches!(out, Out::Dropped(_))).count(), 1, "told once");
        }
    }
}

#[test]
fn silence_ends_what_is_no_frame() {
    let mut rig = Rig::new(GAPS[0]);
    rig.send(&read_axes(2)[..4]);
    assert_eq!(rig.heard, []);
    rig.pass(SILENCE);
    assert_eq!(rig.heard, [Out::Dropped(DecodeError::Incomplete)]);
    assert_eq!(rig.line.deadline(), None);
    rig.send(&[0xFF, 0xFF, 0xFF]);
    rig.pass(SILENCE);
    rig.send(&read_axes(ADDRESS));
    assert_eq!(rig.heard[1..], [Out::Dropped(DecodeError::Impossible), Out::Frame(read_axes(ADDRESS))]);
}

/// A master that asks us, two devices that answer and one that is dead, and waits for every answer.
fn traffic(seed: u64, gap: Duration, corrupt_once_in: Option<usize>) -> (Vec<Vec<u8>>, Rig, usize) {
    let mut random = Random::new(seed);
    let mut rig = Rig::new(gap);
    let (mut sent, mut corruptions) = (Vec::new(), 0);
    for _ in 0..400 {
        let mut data = Vec::new();
        while data.len() < 249 {
            let count = random.below(9);
            data.extend(if random.once_in(2) { harm() } else { random.bytes(count) });
        }
        let length = 1 + random.below(249);
        let asked = match random.below(4) {
            0 => Request::read(register::DATA.first, 18),
            1 => Request::read(0, length as u8),
            2 => Request::Write { register: random.below(64) as u16, data: &data[..length.min(180)] },
            _ => Request::Command { function: FunctionCode::SetZero, register: 0x01A7, length: 24 },
        };
        let address = [ADDRESS, ADDRESS, 2, 3, 4][random.below(5)];
        let mut spoil = |random: &mut Random, mut frame: Vec<u8>| {
            let broken = corrupt_once_in.is_some_and(|times| random.once_in(times));
            if broken {
                corruptions += 1;
                let at = random.below(frame.len());
                match random.below(4) {
                    0 => frame.truncate(at),
                    1 => frame.insert(at, random.byte()),
                    2 => drop(frame.remove(at)),
                    _ => frame[at] ^= 1 + random.byte() % 255,
                }
            }
            (frame, broken)
        };
        let frame = request(address, asked);
        let (bytes, broken) = spoil(&mut random, frame.clone());
        let before = rig.frames().count();
        rig.send(&bytes);
        match address {
            ADDRESS => {
                if !broken {
                    sent.push(frame);
                }
                // the master waits for what does not come
                if rig.frames().count() > before {
                    rig.answer(20)
                } else {
                    rig.pass(Duration::from_millis(20))
                }
            }
            // 2 and 3 heard it, whatever the noise was where we are
            2 | 3 => {
                let (function, length) = (asked.function(), asked.length());
                let answer = match function.is_read() {
                    true => Response::Data { function, data: &data[..length.into()] },
                    false => Response::Acknowledge { function, length },
                };
                let (bytes, _) = spoil(&mut random, response(address, answer));
                rig.send(&bytes);
            }
            _ => rig.pass(Duration::from_millis(20)),
        }
    }
    (sent, rig, corruptions)
}

#[test]
fn long_traffic_without_faults_loses_and_invents_nothing() {
    for seed in 0..20 {
        for gap in GAPS {
            let (sent, rig, _) = traffic(seed, gap, None);
            assert!(rig.frames().eq(&sent), "seed {seed}");
            assert!(sent.len() > 100);
        }
    }
}

#[test]
fn long_traffic_with_noise_executes_nothing_that_was_not_sent() {
    let (mut lost, mut faults) = (0, 0);
    for seed in 100..140 {
        for gap in GAPS {
            let (sent, rig, corruptions) = traffic(seed, gap, Some(10));
            let mut rest = sent.iter();
            for frame in rig.frames() {
                assert!(rest.any(|sent| sent == frame), "seed {seed}: {frame:x?} was never sent so");
            }
            lost += sent.len() - rig.frames().count();
            faults += corruptions;
        }
    }
    assert!(faults > 3000 && lost < faults / 4, "{lost} lost, {faults} faults");
}

#[test]
fn a_device_answers_from_the_line() {
    let mut daq = Daq::new(RamHardware::new(ADDRESS), SignEncoding::TwosComplement);
    let mut line = MultidropDecoder::new(daq.address()..=daq.address(), SILENCE);
    let (asked, mut answer) = (read_axes(ADDRESS), [0; RESPONSE_MAX]);
    let Some(Event::Frame(frame)) = line.feed(&mut &asked[..], Instant::from_micros(0)) else {
        panic!("a request")
    };
    assert_eq!(daq.serve_frame(&frame, &mut answer), Ok(&axes(ADDRESS, &[0; 18])[..]));
    let other = serial::Frame { address: 6, ..frame };
    assert_eq!(daq.serve_frame(&other, &mut answer), Err(NoResponse::OtherAddress));
}
