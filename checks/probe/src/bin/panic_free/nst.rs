//! `nst`: bodies, registers, the forms on serial lines, streams and CAN, and the dispatcher.

use jointbus_protocol::decode::{Framing, Match};
use jointbus_protocol::nst::can::{FrameType, Identifier, Reassembler, TRANSFER_MAX, next_fragment, segment};
use jointbus_protocol::nst::line::MultidropDecoder;
use jointbus_protocol::nst::register::{self, SETTINGS_LENGTH};
use jointbus_protocol::nst::{
    AXES, ActiveSettings, Channel, Daq, EthernetMode, FunctionCode, Hardware, RamHardware, Request, Response,
    SAMPLE_LENGTH, Sample, Settings, SignEncoding, StoreError, serial, stream,
};
use jointbus_protocol::wire::Writer;

use crate::opaque::{any, buffer, byte, bytes, can_frame, flag, long, moment, sink, size, span, word};

pub(crate) fn all() {
    requests();
    replies();
    samples();
    registers();
    settings_by_name(settings());
    serial();
    shared_line();
    stream();
    identifiers();
    segments();
    reassembler::<0>();
    reassembler::<4>();
    let sign = sign();
    daq(Daq::new(RamHardware::new(byte()), sign));
    daq(Daq::new(Anything { settings: settings() }, sign));
}

fn sign() -> SignEncoding {
    if flag() { SignEncoding::TwosComplement } else { SignEncoding::SignMagnitude }
}

fn function() -> FunctionCode {
    FunctionCode::from_code(byte())
}

fn request() -> Request<'static> {
    match any(0) {
        0 => Request::Write { register: word(), data: bytes() },
        1 => Request::read(word(), byte()),
        _ => Request::Command { function: function(), register: word(), length: byte() },
    }
}

fn reply() -> Response<'static> {
    match flag() {
        true => Response::Data { function: function(), data: bytes() },
        false => Response::Acknowledge { function: function(), length: byte() },
    }
}

#[inline(never)]
fn requests() {
    let request = request();
    sink((request.function().code(), request.function().is_read(), request.register(), request.length()));
    buffer::<300>(|space| sink(request.encode(&mut Writer::new(space))));
    sink(Request::decode(bytes()));
    sink(next_fragment(&request, byte()));
}

#[inline(never)]
fn replies() {
    let reply = reply();
    buffer::<300>(|space| sink(reply.encode(&mut Writer::new(space))));
    sink(Response::decode(bytes()));
}

#[inline(never)]
fn samples() {
    let sign = sign();
    sink(sign.decode_i24(any([0; 3])));
    sink(sign.encode_i24(any(0)));
    sink(sign.decode_i32(any([0; 4])));
    sink(sign.encode_i32(any(0)));
    let sample = Sample::decode(&any([0; SAMPLE_LENGTH]), sign);
    sink(sample.newtons());
    sink(sample.volts());
    sink(Sample(any([0; AXES])).encode(sign));
}

#[inline(never)]
fn registers() {
    for register in any(register::TABLE) {
        sink(register.last());
        sink(register.meets(word(), word()));
    }
}

fn settings() -> Settings {
    let stored = any([0; SETTINGS_LENGTH]);
    Settings::decode(&stored).unwrap_or(Settings::FACTORY)
}

#[inline(never)]
fn settings_by_name(mut settings: Settings) {
    while flag() {
        match any(0) {
            0 => sink(settings.write(word(), bytes())),
            1 => settings.set_serial_number(any([0; 16])),
            2 => settings.set_model(any([0; 16])),
            3 => sink(settings.set_address(byte())),
            4 => sink(settings.set_uart1_baud(long())),
            5 => sink(settings.set_can_rate(long())),
            6 => sink(settings.set_uart2_baud(long())),
            7 => settings.set_ip_address(any([0; 4])),
            8 => settings.set_ip_port(word()),
            9 => settings.set_zero_points(Sample(any([0; AXES])), sign()),
            10 => settings.set_channel(if flag() { Channel::Can } else { Channel::Rs485 }),
            _ => settings.set_ethernet_mode(if flag() { EthernetMode::Udp } else { EthernetMode::TcpServer }),
        }
    }
    sink((settings.serial_number(), settings.model(), settings.address(), settings.ip_address()));
    sink((settings.uart1_baud(), settings.can_rate(), settings.uart2_baud(), settings.ip_port()));
    sink((settings.zero_points(sign()), settings.channel(), settings.ethernet_mode()));
    sink(ActiveSettings::new(&settings, sign()));
    sink(*settings.as_bytes());
    for register in any(register::TABLE) {
        sink(settings.bytes(register));
    }
}

#[inline(never)]
fn shared_line() {
    let mut line = MultidropDecoder::new(byte()..=byte(), span());
    while flag() {
        let mut some = bytes();
        match any(0) {
            0 => sink(line.feed(&mut some, moment())),
            1 => sink(line.poll(moment())),
            2 => sink(line.deadline()),
            3 => line.set_addresses(byte()..=byte()),
            _ => line.set_silence(span()),
        }
        sink(some);
    }
}

#[inline(never)]
fn serial() {
    buffer::<300>(|space| sink(serial::encode_request(byte(), &request(), space)));
    buffer::<300>(|space| sink(serial::encode_reply(byte(), &reply(), space)));
    sink(serial::Frame::decode(bytes()));
    sink(serial::request_length(bytes()));
    sink(serial::response_length(bytes()));
    sink(serial::RequestFraming.length(bytes()));
    sink(serial::RequestFraming.is_valid(bytes()));
    sink(serial::RequestFraming.is_broadcast(bytes()));
    let expected = serial::ExpectedResponse::new(byte(), &request());
    sink((expected.address(), expected.function(), expected.body_length()));
    sink(expected.lengths());
    sink(expected.accepts_body(bytes()));
    sink(expected.accepts_legacy_code(bytes()));
    sink(expected.accepts(bytes()));
    sink(Match::accepts(&expected, size(), bytes()));
}

#[inline(never)]
fn stream() {
    sink(stream::split(bytes()));
    sink(stream::request_length(bytes()));
    sink(stream::RequestFraming.length(bytes()));
    sink(stream::RequestFraming.is_valid(bytes()));
    sink(stream::RequestFraming.is_broadcast(bytes()));
    sink(stream::RequestFraming.forgives_stray_bytes());
    let expected = stream::ExpectedResponse::new(byte(), &request());
    sink(expected.lengths());
    sink(Match::accepts(&expected, size(), bytes()));
    buffer::<300>(|space| sink(stream::encode_request(byte(), &request(), space)));
    buffer::<300>(|space| sink(stream::encode_reply(byte(), &reply(), space)));
}

#[inline(never)]
fn identifiers() {
    sink(Identifier::from_raw(long()).map(Identifier::to_raw));
    let identifier = Identifier {
        source: byte(),
        destination: byte(),
        frame_type: FrameType::from_code(byte()),
        counter: byte(),
    };
    sink(identifier.to_raw());
}

#[inline(never)]
fn segments() {
    if let Ok(frames) = segment(byte(), byte(), bytes()) {
        for frame in frames {
            sink(frame);
        }
    }
}

#[inline(never)]
fn reassembler<const CONTEXTS: usize>() {
    let mut reassembler = Reassembler::<CONTEXTS>::new(byte(), span());
    while flag() {
        match any(0) {
            0 => reassembler.set_node(byte()),
            1 => reassembler.clear(),
            2 => reassembler.forget(byte()),
            _ => {
                if let Some(frame) = can_frame() {
                    sink(reassembler.push(&frame, moment()));
                }
            }
        }
    }
}

/// Hardware with any content.
struct Anything {
    settings: Settings,
}

impl Hardware for Anything {
    fn sample(&mut self) -> Sample {
        Sample(any([0; AXES]))
    }

    fn settings(&self) -> &Settings {
        &self.settings
    }

    fn store(&mut self, settings: &Settings) -> Result<(), StoreError> {
        self.settings = any(*settings);
        if flag() { Ok(()) } else { Err(StoreError) }
    }

    fn restart(&mut self, active: &ActiveSettings) {
        sink(*active);
    }
}

#[inline(never)]
fn daq<H: Hardware>(mut daq: Daq<H>) {
    while flag() {
        match any(0) {
            0 => daq.restart(),
            1 => sink(daq.address()),
            2 => sink(daq.hardware().sample()),
            3 => sink(daq.sample()),
            4 => sink(*daq.active()),
            5 => sink(daq.needs_restart()),
            6 => buffer::<300>(|out| {
                sink(daq.serve_frame(&serial::Frame { address: byte(), body: bytes() }, out))
            }),
            7 => buffer::<300>(|out| sink(daq.serve_serial(bytes(), out))),
            8 => buffer::<300>(|out| sink(daq.serve_stream(bytes(), out))),
            9 => daq
                .serve_can(byte(), byte(), bytes(), &mut [0; TRANSFER_MAX])
                .into_iter()
                .flatten()
                .for_each(sink),
            10 => buffer::<300>(|out| sink(daq.serve(byte(), bytes(), out))),
            _ => buffer::<300>(|out| sink(daq.dispatch(&request(), out))),
        }
    }
}
