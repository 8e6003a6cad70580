use super::Silence;
use super::view::{BitWriter, Bits, RegisterWriter, Registers};
use crate::modbus::identification::{self, Category, Conformity, MEI_TYPE, OBJECT_MAX, ObjectId};
use crate::modbus::request;
use crate::modbus::{
    COIL_OFF, COIL_ON, Diagnostic, ExceptionCode, FunctionCode, PDU_MAX, READ_BITS_MAX, READ_REGISTERS_MAX,
    READ_WRITE_REGISTERS_MAX, Range, Request, WRITE_BITS_MAX, WRITE_REGISTERS_MAX, bytes_of_bits,
};
use crate::wire::{NoSpace, Reader, Truncated, Writer};

/// An owner of coils, inputs and registers. What it does not have it leaves out: its function codes are answered with
/// exception 01.
///
/// A request makes one call. Quantity, byte count and coil value have been judged (exception 03), and no range passes
/// 0xFFFF; the owner judges the addresses ([`ExceptionCode::IllegalDataAddress`]), the values
/// ([`ExceptionCode::IllegalDataValue`]) and what it has behind them ([`ExceptionCode::ServerDeviceFailure`] for a
/// fault, [`ExceptionCode::ServerDeviceBusy`] for later), *before* it changes anything: a write is all or nothing.
/// A read that hands over fewer values than were asked for is answered with exception 04: none is made up.
/// An error type of its own becomes an exception by `?` where `ExceptionCode` implements `From` for it.
///
/// # Errors
/// Each method: the exception that refuses the request; by default function code not supported.
#[expect(unused_variables, reason = "the arguments are named for the reader")]
pub trait Server {
    /// Whether a function code is supported: if not, the answer is exception 01 whatever else is wrong. By default the
    /// [basic](FunctionCode::is_basic) ones; who writes a method for another one names its code here, and who leaves one
    /// of the basic ones out says so, lest a malformed request for it is answered with exception 03.
    fn supports(&self, function: FunctionCode) -> bool {
        function.is_basic()
    }

    /// Function code 01: coils (6.1).
    fn read_coils(&mut self, range: Range, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 02: discrete inputs (6.2).
    fn read_discrete_inputs(&mut self, range: Range, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 03: holding registers (6.3).
    fn read_holding_registers(
        &mut self,
        range: Range,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 04: input registers (6.4).
    fn read_input_registers(
        &mut self,
        range: Range,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function codes 05 and 0F: coils (6.5, 6.11).
    fn write_coils(&mut self, range: Range, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function codes 06 and 10: holding registers (6.6, 6.12).
    fn write_registers(&mut self, range: Range, registers: Registers<'_>) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 16: the register becomes its value and `and`, or `or` without `and` (6.16).
    /// [`masked`](crate::modbus::masked) computes that.
    fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 17: writes registers, then reads registers (6.17). Both ranges are to be judged first.
    fn read_write_registers(
        &mut self,
        write: Range,
        values: Registers<'_>,
        read: Range,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 07: eight status bits (6.7).
    fn exception_status(&mut self) -> Result<u8, ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 08 (6.8): `data` is the request's, one register but for [`Diagnostic::ReturnQueryData`], and is
    /// sent back, with a counter or register in place of its first one if there is `Some`.
    /// [`Diagnostic::ForceListenOnly`] never comes here, since it is never answered: exception 01.
    fn diagnostics(&mut self, what: Diagnostic, data: Registers<'_>) -> Result<Option<u16>, ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 0B: status, 0xFFFF while a program command is under way, else 0; number of requests carried out
    /// (6.9).
    fn comm_event_counter(&mut self) -> Result<(u16, u16), ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 11: the server's ID, a run indicator (0x00 or 0xFF) and more, in a layout of its own, at most
    /// 251 bytes (6.13). What is longer is exception 04.
    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        Err(ExceptionCode::IllegalFunction)
    }

    /// Function code 2B with MEI type 0E (6.21): which objects there are.
    fn conformity(&self) -> Conformity {
        Conformity::BasicIndividual
    }

    /// An object of the device identification, at most [`OBJECT_MAX`] bytes; a longer one is cut. 00 to 02 are
    /// mandatory.
    fn identification(&self, object: ObjectId) -> Option<&[u8]> {
        None
    }
}

/// Why a request has no response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Failure {
    /// It is refused.
    Exception(ExceptionCode),
    /// The response does not fit the caller's buffer.
    NoSpace,
}

impl From<ExceptionCode> for Failure {
    fn from(exception: ExceptionCode) -> Self {
        Self::Exception(exception)
    }
}

impl From<Truncated> for Failure {
    fn from(Truncated: Truncated) -> Self {
        Self::Exception(ExceptionCode::IllegalDataValue)
    }
}

impl From<NoSpace> for Failure {
    fn from(NoSpace: NoSpace) -> Self {
        Self::NoSpace
    }
}

/// Answers a request's data unit into `out`: the response, or an exception by the specification's state diagrams.
///
/// `out` must have room for the response even where an exception is the answer; [`PDU_MAX`] bytes hold any.
///
/// # Errors
/// [`Silence::NoRequest`] or [`Silence::NoSpace`]; nothing has been written then.
pub fn respond<'b>(server: &mut impl Server, pdu: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], Silence> {
    let mut writer = Writer::new(out);
    answer(server, pdu, &mut writer)?;
    Ok(writer.finish())
}

/// Appends the response to `pdu`; tells the exception, if it is one.
pub(super) fn answer(
    server: &mut impl Server,
    pdu: &[u8],
    writer: &mut Writer<'_>,
) -> Result<Option<ExceptionCode>, Silence> {
    let mut reader = Reader::new(pdu);
    let code = match reader.u8() {
        Ok(code @ 0x01..0x80) => code,
        _ => return Err(Silence::NoRequest),
    };
    let function = FunctionCode::from_code(code);
    let start = writer.written().len();
    let result = if !server.supports(function) {
        Err(Failure::Exception(ExceptionCode::IllegalFunction))
    } else if function.is_basic() {
        basic(server, code, function, reader, writer)
    } else {
        rarer(server, pdu, writer)
    };
    conclude(result, code, start, writer).map_err(|NoSpace| Silence::NoSpace)
}

/// Puts an exception in place of a response that was begun at `start`, if there is one; tells it.
#[inline]
pub(super) fn conclude(
    result: Result<(), Failure>,
    code: u8,
    start: usize,
    writer: &mut Writer<'_>,
) -> Result<Option<ExceptionCode>, NoSpace> {
    match result {
        Ok(()) => Ok(None),
        Err(Failure::NoSpace) => Err(NoSpace),
        Err(Failure::Exception(exception)) => {
            writer.truncate(start);
            writer.slice(&[code | FunctionCode::EXCEPTION_FLAG, exception.code()])?;
            Ok(Some(exception))
        }
    }
}

/// The data unit of the response that `answer` appends, or of the exception that it refuses with.
pub(crate) fn data_unit<'b>(
    request: &Request<'_>,
    out: &'b mut [u8],
    answer: impl FnOnce(&mut Writer<'_>) -> Result<(), Failure>,
) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(out);
    let result = answer(&mut writer);
    conclude(result, request.function().code(), 0, &mut writer)?;
    Ok(writer.finish())
}

/// The eight basic function codes.
fn basic(
    server: &mut impl Server,
    code: u8,
    function: FunctionCode,
    mut reader: Reader<'_>,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    use FunctionCode as F;
    let range @ Range { start: address, quantity: value } = request::range(&mut reader)?;
    let writes_many = matches!(function, F::WriteMultipleCoils | F::WriteMultipleRegisters);
    let data = if writes_many { request::counted(&mut reader)? } else { &[] };
    if !reader.rest().is_empty() {
        return Err(ExceptionCode::IllegalDataValue.into());
    }
    match function {
        F::ReadCoils | F::ReadDiscreteInputs => {
            judge(range, READ_BITS_MAX, true)?;
            let data = reading(code, bytes_of_bits(range.quantity), writer)?;
            let mut bits = BitWriter::new(data, range.quantity);
            match function {
                F::ReadCoils => server.read_coils(range, &mut bits)?,
                _ => server.read_discrete_inputs(range, &mut bits)?,
            }
            complete(bits.remaining() == 0)?;
        }
        F::ReadHoldingRegisters | F::ReadInputRegisters => {
            judge(range, READ_REGISTERS_MAX, true)?;
            let data = reading(code, bytes_of_registers(range.quantity), writer)?;
            let mut registers = RegisterWriter::new(data);
            match function {
                F::ReadHoldingRegisters => server.read_holding_registers(range, &mut registers)?,
                _ => server.read_input_registers(range, &mut registers)?,
            }
            complete(registers.remaining() == 0)?;
        }
        F::WriteSingleCoil => {
            let on = match value {
                COIL_ON => 1,
                COIL_OFF => 0,
                _ => return Err(ExceptionCode::IllegalDataValue.into()),
            };
            written(code, [address, value], writer)?;
            server.write_coils(Range::new(address, 1), Bits::new(&[on], 1))?;
        }
        F::WriteSingleRegister => {
            written(code, [address, value], writer)?;
            server.write_registers(Range::new(address, 1), Registers::new(&value.to_be_bytes()))?;
        }
        F::WriteMultipleCoils => {
            judge(range, WRITE_BITS_MAX, data.len() == bytes_of_bits(range.quantity))?;
            written(code, [address, value], writer)?;
            server.write_coils(range, Bits::new(data, range.quantity))?;
        }
        F::WriteMultipleRegisters => {
            judge(range, WRITE_REGISTERS_MAX, data.len() == bytes_of_registers(range.quantity))?;
            written(code, [address, value], writer)?;
            server.write_registers(range, Registers::new(data))?;
        }
        _ => return Err(ExceptionCode::IllegalFunction.into()),
    }
    Ok(())
}

/// Appends function code and byte count of the response to a read; the place of its data.
#[inline]
pub(crate) fn reading<'w>(
    function: u8,
    bytes: usize,
    writer: &'w mut Writer<'_>,
) -> Result<&'w mut [u8], Failure> {
    let count = u8::try_from(bytes).map_err(|_| ExceptionCode::IllegalDataValue)?;
    let [code, place, data @ ..] = writer.reserve(bytes.saturating_add(2))? else {
        return Err(Failure::NoSpace);
    };
    (*code, *place) = (function, count);
    Ok(data)
}

/// Appends the response to a write: function code, and the first two values of the request.
#[inline]
pub(crate) fn written(
    function: u8,
    [first, second]: [u16; 2],
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let place = writer.reserve(5)?.first_chunk_mut().ok_or(Failure::NoSpace)?;
    let ([a, b], [c, d]) = (first.to_be_bytes(), second.to_be_bytes());
    *place = [function, a, b, c, d];
    Ok(())
}

/// All others.
fn rarer(server: &mut impl Server, pdu: &[u8], writer: &mut Writer<'_>) -> Result<(), Failure> {
    let request = Request::decode(pdu).map_err(|_| ExceptionCode::IllegalDataValue)?;
    let function = request.function();
    if let Request::ReadWriteMultipleRegisters { read, write, data } = request {
        let fits = data.len() == bytes_of_registers(write.quantity)
            && (1..=READ_REGISTERS_MAX).contains(&read.quantity);
        judge(write, READ_WRITE_REGISTERS_MAX, fits)?;
        judge(read, READ_REGISTERS_MAX, true)?;
        let mut registers =
            RegisterWriter::new(reading(function.code(), bytes_of_registers(read.quantity), writer)?);
        server.read_write_registers(write, Registers::new(data), read, &mut registers)?;
        return Ok(complete(registers.remaining() == 0)?);
    }
    writer.u8(function.code())?;
    match request {
        Request::MaskWriteRegister { address, and, or } => {
            echo(writer, address, and)?;
            writer.u16_be(or)?;
            server.mask_write_register(address, and, or)?;
        }
        Request::ReadExceptionStatus => {
            let place = writer.reserve(1)?;
            place.fill(server.exception_status()?);
        }
        Request::Diagnostics { what, data } => diagnose(server, what, data, writer)?,
        Request::GetCommEventCounter => {
            let mut place = RegisterWriter::new(writer.reserve(4)?);
            let (status, events) = server.comm_event_counter()?;
            place.extend([status, events]);
        }
        Request::ReportServerId => {
            let id = server.server_id()?;
            let length = u8::try_from(id.len()).ok().filter(|_| id.len() <= PDU_MAX.saturating_sub(2));
            writer.u8(length.ok_or(ExceptionCode::ServerDeviceFailure)?)?;
            writer.slice(id)?;
        }
        Request::ReadDeviceIdentification { category, object } => identify(server, category, object, writer)?,
        _ => return Err(ExceptionCode::IllegalFunction.into()),
    }
    Ok(())
}

const fn bytes_of_registers(quantity: u16) -> usize {
    (quantity as usize).saturating_mul(2)
}

/// Quantity and what depends on it (exception 03), then the address (exception 02).
fn judge(range: Range, max: u16, fits: bool) -> Result<(), ExceptionCode> {
    if range.quantity == 0 || range.quantity > max || !fits {
        return Err(ExceptionCode::IllegalDataValue);
    }
    if range.last().is_none() {
        return Err(ExceptionCode::IllegalDataAddress);
    }
    Ok(())
}

/// A value that the owner did not hand over is not made up.
pub(crate) fn complete(all: bool) -> Result<(), ExceptionCode> {
    if all { Ok(()) } else { Err(ExceptionCode::ServerDeviceFailure) }
}

fn echo(writer: &mut Writer<'_>, first: u16, second: u16) -> Result<(), NoSpace> {
    writer.u16_be(first)?;
    writer.u16_be(second)
}

fn diagnose(
    server: &mut impl Server,
    what: Diagnostic,
    data: &[u8],
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    if what == Diagnostic::ForceListenOnly {
        return Err(ExceptionCode::IllegalFunction.into());
    }
    let fits = match what {
        Diagnostic::ReturnQueryData => data.len().is_multiple_of(2) && !data.is_empty(),
        _ => data.len() == 2,
    };
    if !fits {
        return Err(ExceptionCode::IllegalDataValue.into());
    }
    writer.u16_be(what.code())?;
    let place = writer.reserve(data.len())?;
    place.copy_from_slice(data);
    if let Some(answer) = server.diagnostics(what, Registers::new(data))? {
        RegisterWriter::new(place).push(answer);
    }
    Ok(())
}

/// A stream of objects up to the last of its category, or one object. An unknown first object of a stream stands for
/// the first one of all (6.21).
fn identify(
    server: &mut impl Server,
    category: Category,
    object: ObjectId,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let conformity = server.conformity();
    let (first, last) = match category {
        Category::Unknown(_) => return Err(ExceptionCode::IllegalDataValue.into()),
        Category::Individual if !conformity.is_individual() => {
            return Err(ExceptionCode::IllegalDataValue.into());
        }
        Category::Individual if server.identification(object).is_none() => {
            return Err(ExceptionCode::IllegalDataAddress.into());
        }
        Category::Individual => (object.code(), object.code()),
        Category::Basic | Category::Regular | Category::Extended => {
            let offered = conformity.category().last_object().map_or(0, ObjectId::code);
            let last = category.last_object().map_or(0, ObjectId::code).min(offered);
            let known = object.code() <= last && server.identification(object).is_some();
            (if known { object.code() } else { 0 }, last)
        }
    };
    writer.slice(&[MEI_TYPE, category.code(), conformity.code()])?;
    // more follows, next object, number of objects: known at the end
    let mut room = PDU_MAX.saturating_sub(identification::RESPONSE_HEADER);
    let (mut more, mut next, mut count) = (0x00, 0, 0u8);
    let head = writer.written().len();
    writer.slice(&[more, next, count])?;
    for id in first..=last {
        let Some(value) = server.identification(ObjectId::from_code(id)) else { continue };
        let value = value.get(..OBJECT_MAX).unwrap_or(value);
        let Some(left) = room.checked_sub(value.len().saturating_add(2)) else {
            (more, next) = (0xFF, id);
            break;
        };
        room = left;
        count = count.saturating_add(1);
        writer.u8(id)?;
        writer.u8(u8::try_from(value.len()).unwrap_or(u8::MAX))?;
        writer.slice(value)?;
    }
    writer.patch(head, &[more, next, count]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::{Response, masked};
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
        fn read_coils(&mut self, range: Range, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
            bits.extend(core::iter::repeat(true));
            self.call(std::format!("coils {}+{}", range.start, range.quantity))
        }
        fn read_discrete_inputs(
            &mut self,
            range: Range,
            bits: &mut BitWriter<'_>,
        ) -> Result<(), ExceptionCode> {
            bits.extend(core::iter::repeat_n(false, usize::from(range.quantity - self.withheld)));
            self.call(std::format!("inputs {}+{}", range.start, range.quantity))
        }
        fn read_holding_registers(
            &mut self,
            range: Range,
            to: &mut RegisterWriter<'_>,
        ) -> Result<(), ExceptionCode> {
            to.extend(range.addresses().skip(self.withheld.into()));
            self.call(std::format!("holding {}+{}", range.start, range.quantity))
        }
        fn read_input_registers(
            &mut self,
            range: Range,
            to: &mut RegisterWriter<'_>,
        ) -> Result<(), ExceptionCode> {
            to.extend(range.addresses().map(|_| 0).skip(self.withheld.into()));
            self.call(std::format!("input {}+{}", range.start, range.quantity))
        }
        fn write_coils(&mut self, range: Range, bits: Bits<'_>) -> Result<(), ExceptionCode> {
            let on = bits.iter().filter(|bit| *bit).count();
            self.call(std::format!("write coils {}+{}, {on} on", range.start, bits.len()))
        }
        fn write_registers(&mut self, range: Range, from: Registers<'_>) -> Result<(), ExceptionCode> {
            self.call(std::format!("write {}: {:?}", range.start, from.iter().collect::<Vec<_>>()))
        }
        fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
            self.call(std::format!("mask {address}: {:#x}", masked(0x12, and, or)))
        }
        fn read_write_registers(
            &mut self,
            write: Range,
            values: Registers<'_>,
            read: Range,
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
        fn diagnostics(&mut self, what: Diagnostic, _: Registers<'_>) -> Result<Option<u16>, ExceptionCode> {
            let answer = match what {
                Diagnostic::BusMessageCount => Some(0x0102),
                Diagnostic::ReturnQueryData => None,
                _ => return Err(ExceptionCode::IllegalFunction),
            };
            self.call(std::format!("{what:?}")).map(|()| answer)
        }
        fn comm_event_counter(&mut self) -> Result<(u16, u16), ExceptionCode> {
            self.call("events".into()).map(|()| (0xFFFF, 0x0108))
        }
        fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
            self.call("id".into()).map(|()| &b"\x42\xFFbus"[..])
        }
        fn conformity(&self) -> Conformity {
            Conformity::ExtendedIndividual
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
            assert_eq!(respond(&mut owner, pdu, &mut out[..space]), Err(Silence::NoSpace), "{pdu:x?}");
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
        for pdu in [
            &[2, 0, 9, 0, 9][..],
            &[3, 1, 2, 0, 2],
            &[4, 0, 9, 0, 1],
            &[0x17, 0, 3, 0, 1, 0, 9, 0, 1, 2, 7, 7],
        ] {
            let mut owner = Owner { withheld: 1, ..Owner::default() };
            assert_eq!(ask(&mut owner, pdu), [pdu[0] | 0x80, 4], "{pdu:x?}");
        }
    }

    #[test]
    fn limits_of_every_quantity() {
        let words = |count: u16| std::vec![0; usize::from(count) * 2];
        for (code, max) in [(1, 2000), (2, 2000), (3, 125), (4, 125), (0x0F, 1968), (0x10, 123), (0x17, 121)]
        {
            for quantity in [0, 1, max - 1, max, max + 1, 0x7FFF, 0xFFFF] {
                let [high, low] = u16::to_be_bytes(quantity);
                let mut pdu = std::vec![code, 0, 0, high, low];
                let data = match code {
                    0x0F => std::vec![0; bytes_of_bits(quantity)],
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
            assert_eq!(respond(&mut Owner::default(), &[code, 1], &mut out), Err(Silence::NoRequest));
        }
        assert_eq!(respond(&mut Owner::default(), &[], &mut out), Err(Silence::NoRequest));
    }

    fn identified(objects: &[(u8, usize)]) -> Owner {
        let objects = objects.iter().map(|(id, length)| (*id, std::vec![b'x'; *length])).collect();
        Owner { objects, ..Owner::default() }
    }

    #[test]
    fn a_stream_of_objects_goes_on_where_it_stopped() {
        let mut owner =
            identified(&[(0, 100), (1, 100), (2, 100), (4, 3), (0x80, 244), (0x81, 300), (0xFF, 1)]);
        for (category, last) in [(1, 2), (2, 4), (3, 0xFF)] {
            let (mut seen, mut next) = (Vec::new(), 0);
            loop {
                let response = ask(&mut owner, &[0x2B, 0x0E, category, next]);
                let Ok(Response::DeviceIdentification(part)) = Response::decode(&response) else { panic!() };
                assert_eq!(part.conformity, Conformity::ExtendedIndividual);
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
}
