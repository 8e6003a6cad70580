//! `time`, `wire`, `checksum`.

use jointbus_protocol::checksum;
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::{Reader, Writer};

use crate::opaque::{any, buffer, byte, bytes, moment, sink, size, span, word};

pub(crate) fn all() {
    time();
    reader();
    writer();
    checksums();
}

#[inline(never)]
fn time() {
    sink(Instant::from_micros(any(0)).as_micros());
    sink(moment().saturating_add(span()));
    sink(moment().saturating_duration_since(moment()));
    sink(Duration::from_micros(any(0)).as_micros());
    sink(Duration::from_millis(any(0)));
    sink(span().saturating_add(span()));
    sink(span().saturating_mul(any(0)));
    sink(moment().cmp(&moment()));
    sink(span().cmp(&span()));
}

#[inline(never)]
fn reader() {
    let mut reader = Reader::new(bytes());
    sink(reader.array::<0>());
    sink(reader.array::<7>());
    sink(reader.slice(size()));
    sink(reader.u8());
    sink(reader.u16_be());
    sink(reader.rest());
}

#[inline(never)]
fn writer() {
    buffer::<300>(|space| {
        let mut writer = Writer::new(space);
        sink(writer.u8(byte()));
        sink(writer.u16_be(word()));
        sink(writer.slice(bytes()));
        sink(writer.reserve(size()));
        sink(checksum::append_crc(&mut writer));
        sink(writer.written());
        sink(writer.finish());
    });
}

#[inline(never)]
fn checksums() {
    sink(checksum::crc16(bytes()));
    sink(checksum::crc16_sliced(bytes()));
    sink(checksum::crc16_small(bytes()));
    sink(checksum::crc16_bitwise(bytes()));
    sink(checksum::lrc(bytes()));
    sink(checksum::strip_crc(bytes()));
}
