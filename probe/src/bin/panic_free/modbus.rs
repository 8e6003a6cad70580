//! `modbus`: requests, responses and their framing.

use jointbus_protocol::deframe::{Expectation, Format};
use jointbus_protocol::modbus::rtu::{self, ExpectedResponse};
use jointbus_protocol::modbus::server::{Audience, malformed, serve_rtu};
use jointbus_protocol::modbus::{self, ExceptionCode, FunctionCode, Range, Request, RequestError, Response};
use jointbus_protocol::wire::Writer;

use crate::opaque::{any, buffer, byte, bytes, flag, sink, size, word};

pub(crate) fn all() {
    values();
    requests();
    responses();
    rtu();
    expected();
    serve();
}

fn function() -> FunctionCode {
    FunctionCode::from_code(byte())
}

fn range() -> Range {
    Range::new(word(), word())
}

/// Any request, also such that no frame can hold.
pub(crate) fn request() -> Request<'static> {
    match any(0) {
        0 => Request::ReadCoils(range()),
        1 => Request::ReadDiscreteInputs(range()),
        2 => Request::ReadHoldingRegisters(range()),
        3 => Request::ReadInputRegisters(range()),
        4 => Request::WriteSingleCoil { address: word(), value: word() },
        5 => Request::WriteSingleRegister { address: word(), value: word() },
        6 => Request::WriteMultipleCoils { range: range(), data: bytes() },
        7 => Request::WriteMultipleRegisters { range: range(), data: bytes() },
        _ => Request::Other { function: function(), data: bytes() },
    }
}

fn response() -> Response<'static> {
    match any(0) {
        0 => Response::Read { function: function(), data: bytes() },
        1 => Response::WriteSingle { function: function(), address: word(), value: word() },
        2 => Response::WriteMultiple { function: function(), range: range() },
        3 => Response::exception(function(), ExceptionCode::from_code(byte())),
        _ => Response::Other { function: function(), data: bytes() },
    }
}

#[inline(never)]
fn values() {
    let range = range();
    sink((range.last(), range.within(word(), word())));
    for address in range.addresses() {
        sink(address);
    }
    for register in modbus::registers(bytes()) {
        sink(register);
    }
    sink(modbus::bit(bytes(), word()));
    sink(modbus::bytes_of_bits(word()));
    sink((function().code(), function().is_read()));
    sink(ExceptionCode::from_code(byte()).code());
}

#[inline(never)]
fn requests() {
    let request = request();
    sink(request.function());
    buffer::<300>(|space| sink(request.encode(&mut Writer::new(space))));
    sink(Request::decode(bytes()));
}

#[inline(never)]
fn responses() {
    let response = response();
    buffer::<300>(|space| sink(response.encode(&mut Writer::new(space))));
    sink(Response::decode(bytes()));
}

#[inline(never)]
fn rtu() {
    sink(rtu::Frame::decode(bytes()));
    sink(rtu::request_length(bytes()));
    sink(rtu::Requests.length(bytes()));
    sink(rtu::Requests.is_valid(bytes()));
    sink(rtu::Requests.is_broadcast(bytes()));
    buffer::<300>(|space| sink(rtu::encode_request(byte(), &request(), space)));
    buffer::<300>(|space| sink(rtu::encode_response(byte(), &response(), space)));
}

#[inline(never)]
fn expected() {
    let expected = ExpectedResponse::new(byte(), &request());
    sink((expected.unit(), expected.function(), expected.is_open()));
    sink(expected.lengths());
    sink(expected.accepts(bytes()));
    sink(Expectation::accepts(&expected, size(), bytes()));
}

#[inline(never)]
fn serve() {
    let audience = |_| match any(0) {
        0 => Audience::Unit,
        1 => Audience::Broadcast,
        _ => Audience::Other,
    };
    buffer::<300>(|out| sink(serve_rtu(bytes(), audience, |_, _, _| response(), out)));
    sink(malformed(if flag() { RequestError::Empty } else { RequestError::Length(function()) }));
}
