//! The texts of errors, written to a place that fails when it likes.

use core::fmt::{self, Display, Write};

use jointbus_protocol::can::{self, Id};
use jointbus_protocol::modbus::server::{self, RamTables};
use jointbus_protocol::modbus::{ExceptionCode, Request, Response, ascii, rtu, tcp};
use jointbus_protocol::ndam9010::settings::{self, Text};
use jointbus_protocol::ndam9010::{ChannelError, RamModule, Station, StationError};
use jointbus_protocol::nst::{self, Refusal};
use jointbus_protocol::slcan;
use jointbus_protocol::wire::{NoSpace, Truncated};

use crate::opaque::{any, buffer, byte, bytes, flag, long, sink};

pub(crate) fn all() {
    write(Some(Truncated));
    write(Some(NoSpace));
    write(can::Frame::data_frame(Id::Extended(long()), bytes()).err());
    write(slcan::Command::decode(bytes()).err());
    write(Some(ExceptionCode::from_code(byte())));
    write(Request::decode(bytes()).err());
    write(Response::decode(bytes()).err());
    write(rtu::Frame::decode(bytes()).err());
    buffer::<40>(|space| write(ascii::Frame::decode(bytes(), space).err()));
    write(tcp::Header::from_bytes(any([0; tcp::HEADER_LENGTH])).err());
    buffer::<300>(|out| write(server::rtu(&mut RamTables::<1, 1, 1, 1>::new(), byte(), bytes(), out).err()));
    write(Some(if flag() { ChannelError::Failed } else { ChannelError::Busy }));
    write(Station::<RamModule, 0>::new([], byte()).err());
    write(Some(if flag() { StationError::Modules } else { StationError::StartId }));
    write(Text::new(bytes()).err());
    write(settings::Settings::decode(&any([0; settings::STORED_LENGTH])).err());
    write(Some(settings::StoreError));
    write(Some(nst::StoreError));
    write(nst::Settings::decode(&any([0; nst::register::SETTINGS_LENGTH])).err());
    write(nst::Request::decode(bytes()).err());
    write(nst::can::segment(byte(), byte(), bytes()).err());
    write(Some(refusal()));
    let mut daq = nst::Daq::new(nst::RamHardware::new(byte()), nst::SignEncoding::TwosComplement);
    buffer::<300>(|out| write(daq.serve_serial(bytes(), out).err()));
}

fn refusal() -> Refusal {
    match any(0) {
        0 => Refusal::Register,
        1 => Refusal::Length,
        2 => Refusal::ReadOnly,
        3 => Refusal::Value,
        4 => Refusal::CommandForm,
        _ => Refusal::Store,
    }
}

struct Anywhere;

impl Write for Anywhere {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        sink(text);
        if flag() { Ok(()) } else { Err(fmt::Error) }
    }
}

#[inline(never)]
fn write(error: Option<impl Display>) {
    if let Some(error) = error {
        sink(write!(Anywhere, "{error}"));
    }
}
