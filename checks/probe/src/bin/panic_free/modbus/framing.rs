//! RTU, ASCII, TCP, and the line that is shared with others.

use jointbus_protocol::decode::Framing;
use jointbus_protocol::modbus::line::MultidropDecoder;
use jointbus_protocol::modbus::{ascii, rtu, tcp};

use super::{request, response};
use crate::opaque::{any, buffer, byte, bytes, flag, moment, sink, size, span, word};

pub(crate) fn all() {
    rtu();
    ascii();
    tcp();
    shared_line();
}

#[inline(never)]
fn rtu() {
    sink(rtu::Frame::decode(bytes()));
    sink(rtu::request_length(bytes()));
    sink(rtu::RequestFraming.length(bytes()));
    sink(rtu::RequestFraming.is_valid(bytes()));
    sink(rtu::RequestFraming.is_broadcast(bytes()));
    sink(rtu::RequestFraming.forgives_stray_bytes());
    buffer::<300>(|space| sink(rtu::encode_request(byte(), &request(), space)));
    buffer::<300>(|space| sink(rtu::encode_response(byte(), &response(), space)));
}

#[inline(never)]
fn ascii() {
    buffer::<300>(|space| sink(ascii::Frame::decode(bytes(), space)));
    buffer::<600>(|space| sink(ascii::encode_request(byte(), &request(), space)));
    buffer::<600>(|space| sink(ascii::encode_response(byte(), &response(), space)));
    sink(ascii::character_at(bytes(), size()));
    sink(ascii::frame_length(size()));
    let mut decoder = if flag() { ascii::Decoder::new() } else { ascii::Decoder::default() };
    while flag() {
        let mut some = bytes();
        sink(decoder.feed(&mut some, moment()));
        sink(some);
        sink(decoder.is_inside());
        if flag() {
            decoder.clear();
        }
    }
}

#[inline(never)]
fn tcp() {
    if let Ok(header) = tcp::Header::of(word(), byte(), size()) {
        sink(header.to_bytes());
    }
    if let Ok(header) = tcp::Header::from_bytes(any([0; tcp::HEADER_LENGTH])) {
        sink(header.pdu_length());
    }
    buffer::<300>(|space| sink(tcp::encode_request(word(), byte(), &request(), space)));
    buffer::<300>(|space| sink(tcp::encode_response(word(), byte(), &response(), space)));
    let mut decoder = if flag() { tcp::Decoder::new() } else { tcp::Decoder::default() };
    while flag() {
        let mut some = bytes();
        sink(decoder.feed(&mut some, moment()));
        sink(some);
        if flag() {
            decoder.clear();
        }
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
            _ => line.set_silence(span()),
        }
        sink(some);
    }
}
