//! Requests and responses of any kind, as strategies.

use jointbus_protocol::modbus::identification::{
    ConformityLevel, Identification, ObjectId, Objects, ReadDeviceIdCode,
};
use jointbus_protocol::modbus::{
    AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode, Request, Response,
};
use jointbus_protocol::nst;
use proptest::collection::vec;
use proptest::prelude::*;

/// A request with its data beside it.
#[derive(Debug, Clone)]
pub(crate) struct AnyRequest {
    kind: u8,
    words: [u16; 4],
    data: Vec<u8>,
}

impl AnyRequest {
    pub(crate) fn value(&self) -> Request<'_> {
        let [a, b, c, d] = self.words;
        let range = AddressRange::new(a, b);
        let data = &self.data[..];
        match self.kind {
            0 => Request::ReadCoils(range),
            1 => Request::ReadDiscreteInputs(range),
            2 => Request::ReadHoldingRegisters(range),
            3 => Request::ReadInputRegisters(range),
            4 => Request::WriteSingleCoil { address: a, value: b },
            5 => Request::WriteSingleRegister { address: a, value: b },
            6 => Request::ReadExceptionStatus,
            7 => Request::Diagnostics { subfunction: DiagnosticSubfunction::from_code(a), data },
            8 => Request::GetCommEventCounter,
            9 => Request::GetCommEventLog,
            10 => Request::WriteMultipleCoils { range, data },
            11 => Request::WriteMultipleRegisters { range, data },
            12 => Request::ReportServerId,
            13 => Request::MaskWriteRegister { address: a, and: b, or: c },
            14 => Request::ReadWriteMultipleRegisters { read: range, write: AddressRange::new(c, d), data },
            15 => Request::ReadDeviceIdentification {
                category: ReadDeviceIdCode::from_code(a as u8),
                object: ObjectId::from_code(b as u8),
            },
            _ => Request::Other { function: FunctionCode::Unknown(0x41 + (a % 8) as u8), data },
        }
    }
}

/// Any request that fits a frame; quantities and addresses are often small, so that many are right.
pub(crate) fn any_request() -> impl Strategy<Value = AnyRequest> {
    let word = || prop_oneof![0..20u16, any::<u16>()];
    (0..17u8, [word(), word(), word(), word()], vec(any::<u8>(), 0..=240))
        .prop_map(|(kind, words, data)| AnyRequest { kind, words, data })
}

/// A request whose byte count fits its quantity.
pub(crate) fn right_request() -> impl Strategy<Value = AnyRequest> {
    (any_request(), 1..=110u16, 1..=100u16, 0..250u16).prop_map(|(mut request, quantity, write, start)| {
        request.words = [start, quantity, start, write];
        let length = match request.kind {
            10 => usize::from(quantity).div_ceil(8),
            11 => 2 * usize::from(quantity),
            14 => 2 * usize::from(write),
            _ => request.data.len(),
        };
        request.data.resize(length, 0xA5);
        if request.kind == 4 {
            request.words[1] = 0xFF00;
        }
        request
    })
}

/// A response with its data beside it.
pub(crate) fn any_response() -> impl Strategy<Value = (u8, [u16; 3], Vec<u8>)> {
    (0..12u8, any::<[u16; 3]>(), vec(any::<u8>(), 0..=240))
}

pub(crate) fn response<'a>(
    (kind, [a, b, c], data): &'a (u8, [u16; 3], Vec<u8>),
    objects: &'a [u8],
) -> Response<'a> {
    let (a, b, c) = (*a, *b, *c);
    match kind {
        0..=3 => Response::Read { function: FunctionCode::from_code(kind + 1), data },
        4 => Response::WriteSingle { function: FunctionCode::WriteSingleCoil, address: a, value: b },
        5 => Response::ExceptionStatus(a as u8),
        6 => Response::CommEventLog { status: a, events: b, messages: c, log: data },
        7 => Response::WriteMultiple {
            function: FunctionCode::WriteMultipleCoils,
            range: AddressRange::new(a, b),
        },
        8 => Response::ServerId(data),
        9 => Response::MaskWrite { address: a, and: b, or: c },
        10 => Response::DeviceIdentification(Identification {
            category: ReadDeviceIdCode::from_code(a as u8),
            conformity: ConformityLevel::from_code(b as u8),
            next: (c > 99).then(|| ObjectId::from_code(c as u8)),
            objects: Objects::new(objects).unwrap(),
        }),
        _ => {
            Response::exception(FunctionCode::from_code((a & 0x7F) as u8), ExceptionCode::from_code(b as u8))
        }
    }
}

/// Objects as on the wire, of at most 200 bytes.
pub(crate) fn any_objects() -> impl Strategy<Value = Vec<u8>> {
    vec((any::<u8>(), vec(any::<u8>(), 0..18)), 0..10).prop_map(|objects| {
        let wire = |(id, value): (u8, Vec<u8>)| [&[id, value.len() as u8][..], &value].concat();
        objects.into_iter().flat_map(wire).collect()
    })
}

pub(crate) fn nst_request(kind: u8, register: u16, length: u8, data: &[u8]) -> nst::Request<'_> {
    let functions = [0x03, 0x12, 0x13, 0x15, 0x18, 0x19];
    match functions.get(usize::from(kind)) {
        Some(code) => {
            nst::Request::Command { function: nst::FunctionCode::from_code(*code), register, length }
        }
        None => nst::Request::Write { register, data },
    }
}
