//! `modbus`: requests, responses, their framings, the shared line and the server.

mod framing;
mod server;

use jointbus_protocol::decode::Match;
use jointbus_protocol::modbus::identification::{ConformityLevel, Objects, ReadDeviceIdCode};
use jointbus_protocol::modbus::identification::{Identification, ObjectId};
use jointbus_protocol::modbus::{
    self, AddressRange, DiagnosticSubfunction, ExceptionCode, ExpectedResponse, FunctionCode, Request,
    Response,
};
use jointbus_protocol::wire::Writer;

use crate::opaque::{any, buffer, byte, bytes, flag, sink, size, word};

pub(crate) fn all() {
    values();
    identification();
    requests();
    responses();
    expected();
    framing::all();
    server::all();
}

fn function() -> FunctionCode {
    FunctionCode::from_code(byte())
}

fn exception() -> ExceptionCode {
    ExceptionCode::from_code(byte())
}

fn range() -> AddressRange {
    AddressRange::new(word(), word())
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
        8 => Request::ReadExceptionStatus,
        9 => Request::Diagnostics { subfunction: DiagnosticSubfunction::from_code(word()), data: bytes() },
        10 => Request::GetCommEventCounter,
        11 => Request::GetCommEventLog,
        12 => Request::ReportServerId,
        13 => Request::MaskWriteRegister { address: word(), and: word(), or: word() },
        14 => Request::ReadWriteMultipleRegisters { read: range(), write: range(), data: bytes() },
        15 => Request::ReadDeviceIdentification {
            category: ReadDeviceIdCode::from_code(byte()),
            object: ObjectId::from_code(byte()),
        },
        _ => Request::Other { function: function(), data: bytes() },
    }
}

fn response() -> Response<'static> {
    match any(0) {
        0 => Response::Read { function: function(), data: bytes() },
        1 => Response::WriteSingle { function: function(), address: word(), value: word() },
        2 => Response::WriteMultiple { function: function(), range: range() },
        3 => Response::exception(function(), exception()),
        4 => Response::ExceptionStatus(byte()),
        5 => Response::Diagnostics { subfunction: DiagnosticSubfunction::from_code(word()), data: bytes() },
        6 => Response::CommEventCounter { status: word(), events: word() },
        7 => Response::CommEventLog { status: word(), events: word(), messages: word(), log: bytes() },
        8 => Response::ServerId(bytes()),
        9 => Response::MaskWrite { address: word(), and: word(), or: word() },
        10 => Response::DeviceIdentification(Identification {
            category: ReadDeviceIdCode::from_code(byte()),
            conformity: ConformityLevel::from_code(byte()),
            next: flag().then(|| ObjectId::from_code(byte())),
            objects: Objects::new(bytes()).unwrap_or_default(),
        }),
        _ => Response::Other { function: function(), data: bytes() },
    }
}

#[inline(never)]
fn values() {
    let range = range();
    sink((range.last(), range.within(word(), word())));
    range.addresses().for_each(sink);
    modbus::registers(bytes()).for_each(sink);
    sink(modbus::bit(bytes(), word()));
    sink(modbus::packed_len(word()));
    sink(modbus::apply_mask(word(), word(), word()));
    sink((function().code(), function().is_read(), function().is_basic()));
    sink(exception().code());
    sink(DiagnosticSubfunction::from_code(word()).code());
}

#[inline(never)]
fn identification() {
    let conformity = ConformityLevel::from_code(byte());
    sink((conformity.code(), conformity.is_individual(), conformity.category()));
    let category = ReadDeviceIdCode::from_code(byte());
    sink((category.code(), category.last_object().map(ObjectId::code)));
    if let Ok(objects) = Objects::new(bytes()) {
        // `objects.count()` would be the iterator's
        sink(Objects::count(&objects));
        objects.for_each(sink);
    }
}

#[inline(never)]
fn requests() {
    let request = request();
    sink((request.function(), request.is_read()));
    buffer::<300>(|space| sink(request.encode(&mut Writer::new(space))));
    sink(Request::decode(bytes()));
}

#[inline(never)]
fn responses() {
    let response = response();
    sink(response.function());
    buffer::<300>(|space| sink(response.encode(&mut Writer::new(space))));
    sink(Response::decode(bytes()));
}

#[inline(never)]
fn expected() {
    let expected = ExpectedResponse::new(byte(), &request());
    sink((expected.unit(), expected.function(), expected.is_read(), expected.is_open()));
    sink(expected.lengths());
    sink(expected.accepts(bytes()));
    sink(expected.accepts_pdu(bytes()));
    sink(Match::accepts(&expected, size(), bytes()));
}
