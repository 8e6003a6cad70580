//! `can` and `slcan`.

use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::slcan::{self, Command, ENCODED_MAX, LINE_MAX, LineReader};

use crate::opaque::{any, byte, bytes, can_frame, flag, long, moment, sink, word};

pub(crate) fn all() {
    frames();
    commands();
    line_reader::<0>();
    line_reader::<LINE_MAX>();
}

#[inline(never)]
fn frames() {
    sink(Frame::data_frame(Id::Standard(word()), bytes()));
    sink(Frame::data_frame(Id::Extended(long()), bytes()));
    if let Some(frame) = can_frame() {
        sink((frame.id(), frame.is_remote(), frame.dlc()));
        sink(frame.data());
        sink(frame.payload());
    }
}

#[inline(never)]
fn commands() {
    let command = match any(0) {
        0 => Command::SetBitrate(byte()),
        1 => Command::SetBitTiming(word()),
        2 => Command::Timestamp(flag()),
        3 => Command::AcceptanceCode(long()),
        4 => Command::AcceptanceMask(long()),
        _ => can_frame().map_or(Command::Open, Command::Frame),
    };
    sink(command.encode(&mut [0; ENCODED_MAX]));
    if let Ok(command) = Command::decode(bytes()) {
        sink(command.encode(&mut [0; ENCODED_MAX]));
    }
    sink(slcan::bit_rate(byte()));
    sink(slcan::is_confirmation(bytes()));
}

#[inline(never)]
fn line_reader<const N: usize>() {
    let mut reader = LineReader::<N>::new();
    while flag() {
        let mut some = bytes();
        sink(reader.feed(&mut some, moment()));
        sink(some);
    }
    sink(LineReader::<N>::default());
}
