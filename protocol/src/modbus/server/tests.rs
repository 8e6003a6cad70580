//! What every function code answers, whoever owns what is behind it.

use super::{BitWriter, Bits, NoResponse, RegisterWriter, Registers, Server, respond};
use crate::modbus::identification::{ConformityLevel, ObjectId};
use crate::modbus::{
    AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode, PDU_MAX, Request, Response, apply_mask,
    packed_len,
};
use std::string::String;
use std::vec::Vec;

/// Remembers what it was called with, supports everything, and can be made to fail.
#[derive(Default)]
struct Owner {
    calls: Vec<String>,
    fails: Option<ExceptionCode>,
    objects: Vec<(u8, Vec<u8>)>,
    /// Values that a read does not hand over.
    withheld: u16,
}

impl Owner {
    fn call(&mut self, what: String) -> Result<(), ExceptionCode> {
        self.calls.push(what);
        self.fails.map_or(Ok(()), Err)
    }
}

impl Server for Owner {
    fn supports(&self, function: FunctionCode) -> bool {
        !matches!(function, FunctionCode::Unknown(_) | FunctionCode::GetCommEventLog)
    }
    fn read_coils(&mut self, range: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        bits.extend(core::iter::repeat(true));
        self.call(std::format!("coils {}+{}", range.start, range.quantity))
    }
    fn read_discrete_inputs(
        &mut self,
        range: AddressRange,
        bits: &mut BitWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        bits.extend(core::iter::repeat_n(false, usize::from(range.quantity - self.withheld)));
        self.call(std::format!("inputs {}+{}", range.start, range.quantity))
    }
    fn read_holding_registers(
        &mut self,
        range: AddressRange,
        to: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        to.extend(range.addresses().skip(self.withheld.into()));
        self.call(std::format!("holding {}+{}", range.start, range.quantity))
    }
    fn read_input_registers(
        &mut self,
        range: AddressRange,
        to: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        to.extend(range.addresses().map(|_| 0).skip(self.withheld.into()));
        self.call(std::format!("input {}+{}", range.start, range.quantity))
    }
    fn write_coils(&mut self, range: AddressRange, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        let on = bits.iter().filter(|bit| *bit).count();
        self.call(std::format!("write coils {}+{}, {on} on", range.start, bits.len()))
    }
    fn write_registers(&mut self, range: AddressRange, from: Registers<'_>) -> Result<(), ExceptionCode> {
        self.call(std::format!("write {}: {:?}", range.start, from.iter().collect::<Vec<_>>()))
    }
    fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
        self.call(std::format!("mask {address}: {:#x}", apply_mask(0x12, and, or)))
    }
    fn read_write_registers(
        &mut self,
        write: AddressRange,
        values: Registers<'_>,
        read: AddressRange,
        to: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        to.extend(read.addresses().skip(self.withheld.into()));
        self.call(std::format!(
            "write {}+{}, read {}+{}",
            write.start,
            values.len(),
            read.start,
            read.quantity
        ))
    }
    fn exception_status(&mut self) -> Result<u8, ExceptionCode> {
        self.call("status".into()).map(|()| 0x6D)
    }
    fn diagnostics(
        &mut self,
        subfunction: DiagnosticSubfunction,
        _: Registers<'_>,
    ) -> Result<Option<u16>, ExceptionCode> {
        let answer = match subfunction {
            DiagnosticSubfunction::BusMessageCount => Some(0x0102),
            DiagnosticSubfunction::ReturnQueryData => None,
            _ => return Err(ExceptionCode::IllegalFunction),
        };
        self.call(std::format!("{subfunction:?}")).map(|()| answer)
    }
    fn comm_event_counter(&mut self) -> Result<(u16, u16), ExceptionCode> {
        self.call("events".into()).map(|()| (0xFFFF, 0x0108))
    }
    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        self.call("id".into()).map(|()| &b"\x42\xFFbus"[..])
    }
    fn conformity(&self) -> ConformityLevel {
        ConformityLevel::ExtendedIndividual
    }
    fn identification(&self, object: ObjectId) -> Option<&[u8]> {
        let (_, value) = self.objects.iter().find(|(id, _)| *id == object.code())?;
        Some(value)
    }
}

fn ask(owner: &mut Owner, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0xEE; PDU_MAX];
    let response = respond(owner, pdu, &mut out).unwrap().to_vec();
    // whatever the answer, it is one that a master takes
    if let Ok(request) = Request::decode(pdu) {
        let expected = crate::modbus::ExpectedResponse::new(1, &request);
        assert!(expected.accepts_pdu(&response), "{pdu:x?} -> {response:x?}");
    }
    assert!(Response::decode(&response).is_ok());
    // with less room there is no answer, and nothing was written
    for space in 0..response.len() {
        let mut owner = Owner { objects: owner.objects.clone(), fails: owner.fails, ..Owner::default() };
        assert_eq!(respond(&mut owner, pdu, &mut out[..space]), Err(NoResponse::NoSpace), "{pdu:x?}");
        if response[0] < 0x80 {
            assert!(owner.calls.iter().all(|call| call == "id"), "{:?}", owner.calls);
        }
    }
    response
}

#[test]
fn every_function_code_makes_one_call() {
    for (pdu, call, response) in [
        (&[1, 0, 9, 0, 10][..], "coils 9+10", &[1, 2, 0xFF, 3][..]),
        (&[2, 0, 9, 0, 1], "inputs 9+1", &[2, 1, 0]),
        (&[3, 1, 2, 0, 2], "holding 258+2", &[3, 4, 1, 2, 1, 3]),
        (&[4, 0, 9, 0, 1], "input 9+1", &[4, 2, 0, 0]),
        (&[5, 0, 9, 0xFF, 0], "write coils 9+1, 1 on", &[5, 0, 9, 0xFF, 0]),
        (&[5, 0, 9, 0, 0], "write coils 9+1, 0 on", &[5, 0, 9, 0, 0]),
        (&[6, 0, 9, 1, 2], "write 9: [258]", &[6, 0, 9, 1, 2]),
        (&[7], "status", &[7, 0x6D]),
        (&[8, 0, 0, 7, 8], "ReturnQueryData", &[8, 0, 0, 7, 8]),
        (&[8, 0, 0, 7, 8, 9, 10], "ReturnQueryData", &[8, 0, 0, 7, 8, 9, 10]),
        (&[8, 0, 0x0B, 0, 0], "BusMessageCount", &[8, 0, 0x0B, 1, 2]),
        (&[0x0B], "events", &[0x0B, 0xFF, 0xFF, 1, 8]),
        (&[15, 0, 9, 0, 10, 2, 0xFF, 0xFF], "write coils 9+10, 10 on", &[15, 0, 9, 0, 10]),
        (&[16, 0, 9, 0, 2, 4, 0, 1, 0, 2], "write 9: [1, 2]", &[16, 0, 9, 0, 2]),
        (&[17], "id", &[17, 5, 0x42, 0xFF, b'b', b'u', b's']),
        (&[0x16, 0, 4, 0, 0xF2, 0, 0x25], "mask 4: 0x17", &[0x16, 0, 4, 0, 0xF2, 0, 0x25]),
        (&[0x17, 0, 3, 0, 1, 0, 9, 0, 1, 2, 7, 7], "write 9+1, read 3+1", &[0x17, 2, 0, 3]),
    ] {
        let mut owner = Owner::default();
        assert_eq!(ask(&mut owner, pdu), response, "{pdu:x?}");
        assert_eq!(owner.calls, [call]);
        for exception in [ExceptionCode::ServerDeviceFailure, ExceptionCode::IllegalDataAddress] {
            let mut owner = Owner { fails: Some(exception), ..Owner::default() };
            assert_eq!(ask(&mut owner, pdu), [pdu[0] | 0x80, exception.code()], "{pdu:x?}");
        }
    }
}

#[test]
fn values_that_are_not_handed_over_are_not_made_up() {
    for pdu in
        [&[2, 0, 9, 0, 9][..], &[3, 1, 2, 0, 2], &[4, 0, 9, 0, 1], &[0x17, 0, 3, 0, 1, 0, 9, 0, 1, 2, 7, 7]]
    {
        let mut owner = Owner { withheld: 1, ..Owner::default() };
        assert_eq!(ask(&mut owner, pdu), [pdu[0] | 0x80, 4], "{pdu:x?}");
    }
}

#[test]
fn limits_of_every_quantity() {
    let words = |count: u16| std::vec![0; usize::from(count) * 2];
    for (code, max) in [(1, 2000), (2, 2000), (3, 125), (4, 125), (0x0F, 1968), (0x10, 123), (0x17, 121)] {
        for quantity in [0, 1, max - 1, max, max + 1, 0x7FFF, 0xFFFF] {
            let [high, low] = u16::to_be_bytes(quantity);
            let mut pdu = std::vec![code, 0, 0, high, low];
            let data = match code {
                0x0F => std::vec![0; packed_len(quantity)],
                0x10 | 0x17 => words(quantity),
                _ => Vec::new(),
            };
            if code == 0x17 {
                pdu = std::vec![code, 0, 0, 0, 1, 0, 0, high, low];
            }
            if code > 6 {
                let Ok(count) = u8::try_from(data.len()) else { continue };
                pdu.push(count);
                pdu.extend(data);
            }
            let (mut owner, good) = (Owner::default(), (1..=max).contains(&quantity));
            let response = ask(&mut owner, &pdu);
            assert_eq!(response[0], if good { code } else { code | 0x80 }, "{code} {quantity}");
            assert_eq!(owner.calls.len(), usize::from(good));
            if !good {
                assert_eq!(response, [code | 0x80, 3]);
            }
        }
    }
    for read in [0, 126] {
        let pdu = [0x17, 0, 0, 0, read, 0, 0, 0, 1, 2, 0, 0];
        assert_eq!(ask(&mut Owner::default(), &pdu), [0x97, 3]);
    }
}

#[test]
fn exceptions_come_in_the_order_of_the_state_diagrams() {
    for (pdu, exception, why) in [
        (&[0x41, 1, 2][..], 1, "unknown"),
        (&[0x0C], 1, "not supported"),
        (&[0x0C, 1], 1, "not supported, whatever follows"),
        (&[0x2B, 0x0D, 1, 2], 1, "another MEI type"),
        (&[0x03, 0, 0, 0], 3, "too short"),
        (&[0x03, 0, 0, 0, 1, 0], 3, "too long"),
        (&[0x03, 0xFF, 0xFF, 0, 126], 3, "the quantity before the address"),
        (&[0x03, 0xFF, 0xFF, 0, 2], 2, "past 0xFFFF"),
        (&[0x05, 0, 0, 0x12, 0x34], 3, "coil value"),
        (&[0x0F, 0, 0, 0, 10, 1, 0], 3, "byte count below the quantity"),
        (&[0x0F, 0, 0, 0, 10, 0], 3, "no data"),
        (&[0x10, 0, 0, 0, 1, 1, 0], 3, "half a register"),
        (&[0x10, 0, 0, 0, 1, 4, 0, 0], 3, "byte count past the frame"),
        (&[0x10, 0, 0, 0, 1, 1, 0, 0], 3, "byte count below the values"),
        (&[0x10, 0, 0, 0, 1, 2, 0, 0, 0], 3, "a byte behind the values"),
        (&[0x10, 0, 0, 0, 1], 3, "no byte count"),
        (&[0x10, 0xFF, 0xFF, 0, 2, 4, 0, 0, 0, 0], 2, "values past 0xFFFF"),
        (&[0x05, 0, 0, 0xFF, 0, 0], 3, "a byte behind the coil"),
        (&[0x06, 0, 0, 0], 3, "half a value"),
        (&[0x06, 0, 0, 0, 0, 0], 3, "a byte behind the value"),
        (&[0x07, 0], 3, "data behind 07"),
        (&[0x08, 0, 0], 3, "loopback of nothing"),
        (&[0x08, 0, 0, 1], 3, "loopback of an odd byte"),
        (&[0x08, 0, 0x0B, 0, 0, 0, 0], 3, "a counter of two registers"),
        (&[0x08, 0, 4, 0, 0], 1, "listen only"),
        (&[0x08, 0, 0x13, 0, 0], 1, "reserved sub-function"),
        (&[0x2B, 0x0E, 5, 0], 3, "read device ID code"),
        (&[0x2B, 0x0E, 4, 9], 2, "no such object"),
    ] {
        let mut owner = Owner::default();
        assert_eq!(ask(&mut owner, pdu), [pdu[0] | 0x80, exception], "{why}");
        assert!(owner.calls.is_empty(), "{why}");
    }
}

#[test]
fn function_codes_that_ask_nothing_are_not_answered() {
    let mut out = [0; PDU_MAX];
    for code in [0, 0x80, 0x83, 0xFF] {
        assert_eq!(respond(&mut Owner::default(), &[code, 1], &mut out), Err(NoResponse::NoRequest));
    }
    assert_eq!(respond(&mut Owner::default(), &[], &mut out), Err(NoResponse::NoRequest));
}

fn identified(objects: &[(u8, usize)]) -> Owner {
    let objects = objects.iter().map(|(id, length)| (*id, std::vec![b'x'; *length])).collect();
    Owner { objects, ..Owner::default() }
}

#[test]
fn a_stream_of_objects_goes_on_where_it_stopped() {
    let mut owner = identified(&[(0, 100), (1, 100), (2, 100), (4, 3), (0x80, 244), (0x81, 300), (0xFF, 1)]);
    for (category, last) in [(1, 2), (2, 4), (3, 0xFF)] {
        let (mut seen, mut next) = (Vec::new(), 0);
        loop {
            let response = ask(&mut owner, &[0x2B, 0x0E, category, next]);
            let Ok(Response::DeviceIdentification(part)) = Response::decode(&response) else { panic!() };
            assert_eq!(part.conformity, ConformityLevel::ExtendedIndividual);
            assert!(part.objects.count() > 0, "no progress");
            seen.extend(part.objects.map(|(id, value)| (id.code(), value.len())));
            match part.next {
                Some(object) => next = object.code(),
                None => break,
            }
        }
        let all = [(0, 100), (1, 100), (2, 100), (4, 3), (0x80, 244), (0x81, 244), (0xFF, 1)];
        let expected: Vec<_> = all.into_iter().filter(|(id, _)| *id <= last).collect();
        assert_eq!(seen, expected, "category {category}");
    }
}

#[test]
fn one_object_and_an_unknown_start() {
    let mut owner = identified(&[(0, 1), (1, 2), (2, 3)]);
    assert_eq!(ask(&mut owner, &[0x2B, 0x0E, 4, 1]), [0x2B, 0x0E, 4, 0x83, 0, 0, 1, 1, 2, b'x', b'x']);
    let from_0 = ask(&mut owner, &[0x2B, 0x0E, 1, 0]);
    assert_eq!(ask(&mut owner, &[0x2B, 0x0E, 1, 9]), from_0);
}
