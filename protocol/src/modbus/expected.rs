use super::identification;
use super::{DiagnosticSubfunction, FunctionCode, PDU_MAX, Request, packed_len};
use crate::checksum;
use crate::decode::{FrameLength, Match};

/// What a master remembers of a request to know the response: unit, function code, length, and for writes what they
/// echo of the request.
///
/// Modbus over a serial line numbers nothing: a late response to an equal request fits as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ExpectedResponse {
    unit: u8,
    function: u8,
    is_read: bool,
    shape: Shape,
}

/// What follows the function code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
enum Shape {
    /// A byte count, which must be this, and so many bytes.
    Data(u8),
    /// So many bytes.
    Plain(u8),
    /// The first bytes of the request's data come back, and so many bytes more.
    Echo { head: [u8; 6], echoed: u8, more: u8 },
    /// A byte count and so many bytes.
    Counted,
    /// Objects of a device identification.
    Identification,
    /// Only an exception: no data unit can hold what was asked, or the request is never answered.
    Refusal,
    /// Anything, up to silence.
    Open,
}

/// Function code and exception code.
const EXCEPTION_PDU: usize = 2;

/// Unit address and CRC.
const OVERHEAD: usize = 1 + checksum::CRC_LENGTH;

impl ExpectedResponse {
    /// What `unit` may answer to `request`.
    #[must_use]
    pub fn new(unit: u8, request: &Request<'_>) -> Self {
        Self {
            unit,
            function: request.function().code(),
            is_read: request.is_read(),
            shape: Shape::of(request),
        }
    }

    /// What `unit` may answer to some request of this function code.
    pub(super) const fn any(unit: u8, function: FunctionCode) -> Self {
        use FunctionCode as F;
        let shape = match function {
            F::ReadCoils
            | F::ReadDiscreteInputs
            | F::ReadHoldingRegisters
            | F::ReadInputRegisters
            | F::GetCommEventLog
            | F::ReportServerId
            | F::ReadWriteMultipleRegisters => Shape::Counted,
            F::WriteSingleCoil
            | F::WriteSingleRegister
            | F::Diagnostics
            | F::GetCommEventCounter
            | F::WriteMultipleCoils
            | F::WriteMultipleRegisters => Shape::Plain(4),
            F::ReadExceptionStatus => Shape::Plain(1),
            F::MaskWriteRegister => Shape::Plain(6),
            F::EncapsulatedInterface => Shape::Identification,
            F::Unknown(_) => Shape::Open,
        };
        Self { unit, function: function.code(), is_read: function.is_read(), shape }
    }

    /// Unit that was asked.
    #[must_use]
    pub const fn unit(&self) -> u8 {
        self.unit
    }

    /// Function code that was asked.
    #[must_use]
    pub const fn function(&self) -> FunctionCode {
        FunctionCode::from_code(self.function)
    }

    /// Whether the request only reads: [`Request::is_read`].
    #[must_use]
    pub const fn is_read(&self) -> bool {
        self.is_read
    }

    /// Whether only silence ends the response: its length is not known before it comes.
    #[must_use]
    pub fn is_open(&self) -> bool {
        matches!(self.shape, Shape::Counted | Shape::Identification | Shape::Open)
    }

    /// Whether a whole RTU frame is the response, its CRC included.
    #[must_use]
    pub fn accepts(&self, frame: &[u8]) -> bool {
        frame.len().checked_sub(OVERHEAD).is_some()
            && frame.first() == Some(&self.unit)
            && checksum::strip_crc(frame)
                .and_then(|content| content.get(1..))
                .is_some_and(|pdu| self.accepts_pdu(pdu))
    }

    /// Whether a protocol data unit is the response: for framings other than RTU, where the unit was compared.
    #[must_use]
    pub fn accepts_pdu(&self, pdu: &[u8]) -> bool {
        match self.pdu_length(pdu) {
            FrameLength::Exactly(length) => pdu.len() == length,
            FrameLength::UntilSilence => pdu.len() <= PDU_MAX,
            FrameLength::AtLeast(_) | FrameLength::Impossible => false,
        }
    }

    /// Length of the RTU frame that starts with `prefix`, if that is the response.
    pub(super) fn frame_length(&self, prefix: &[u8]) -> FrameLength {
        match prefix.split_first() {
            Some((unit, pdu)) if *unit == self.unit => match self.pdu_length(pdu) {
                FrameLength::Exactly(length) => FrameLength::Exactly(length.saturating_add(OVERHEAD)),
                FrameLength::AtLeast(length) => FrameLength::AtLeast(length.saturating_add(1)),
                other => other,
            },
            Some(_) => FrameLength::Impossible,
            None => FrameLength::AtLeast(1),
        }
    }

    fn pdu_length(&self, prefix: &[u8]) -> FrameLength {
        let Some((&function, data)) = prefix.split_first() else { return FrameLength::AtLeast(1) };
        if function == self.function | FunctionCode::EXCEPTION_FLAG {
            return FrameLength::Exactly(EXCEPTION_PDU);
        }
        if function != self.function {
            return FrameLength::Impossible;
        }
        match (self.shape, data.first()) {
            (Shape::Data(expected), Some(count)) if *count != expected => FrameLength::Impossible,
            (Shape::Data(count), _) => FrameLength::Exactly(2usize.saturating_add(count.into())),
            (Shape::Plain(length), _) => FrameLength::Exactly(1usize.saturating_add(length.into())),
            (Shape::Echo { head, echoed, more }, _) => {
                let same = head.iter().take(echoed.into()).zip(data).all(|(sent, came)| sent == came);
                let length = 1usize.saturating_add(echoed.into()).saturating_add(more.into());
                if same { FrameLength::Exactly(length) } else { FrameLength::Impossible }
            }
            (Shape::Counted, None) => FrameLength::AtLeast(2),
            (Shape::Counted, Some(count)) => match 2usize.saturating_add((*count).into()) {
                length if length <= PDU_MAX => FrameLength::Exactly(length),
                _ => FrameLength::Impossible,
            },
            (Shape::Identification, Some(&mei)) if mei != identification::MEI_TYPE => FrameLength::Impossible,
            (Shape::Identification, _) => identification::response_length(prefix),
            (Shape::Refusal, _) => FrameLength::Impossible,
            (Shape::Open, _) => FrameLength::UntilSilence,
        }
    }
}

impl Shape {
    fn of(request: &Request<'_>) -> Self {
        match *request {
            Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
                Self::data(packed_len(range.quantity))
            }
            Request::ReadHoldingRegisters(range)
            | Request::ReadInputRegisters(range)
            | Request::ReadWriteMultipleRegisters { read: range, .. } => {
                Self::data(usize::from(range.quantity).saturating_mul(2))
            }
            Request::WriteSingleCoil { address, value } | Request::WriteSingleRegister { address, value } => {
                Self::echo([address, value])
            }
            Request::WriteMultipleCoils { range, .. } | Request::WriteMultipleRegisters { range, .. } => {
                Self::echo([range.start, range.quantity])
            }
            Request::MaskWriteRegister { address, and, or } => {
                let ([a, b], [c, d], [e, f]) = (address.to_be_bytes(), and.to_be_bytes(), or.to_be_bytes());
                Self::Echo { head: [a, b, c, d, e, f], echoed: 6, more: 0 }
            }
            Request::Diagnostics { subfunction, data } => Self::diagnostics(subfunction, data),
            Request::ReadExceptionStatus => Self::Plain(1),
            Request::GetCommEventCounter => Self::Plain(4),
            Request::GetCommEventLog | Request::ReportServerId => Self::Counted,
            Request::ReadDeviceIdentification { .. } => Self::Identification,
            Request::Other { .. } => Self::Open,
        }
    }

    fn data(bytes: usize) -> Self {
        match u8::try_from(bytes) {
            Ok(count) if bytes <= PDU_MAX.saturating_sub(2) => Self::Data(count),
            _ => Self::Refusal,
        }
    }

    fn echo([first, second]: [u16; 2]) -> Self {
        let ([a, b], [c, d]) = (first.to_be_bytes(), second.to_be_bytes());
        Self::Echo { head: [a, b, c, d, 0, 0], echoed: 4, more: 0 }
    }

    /// A response has the length of its request; all but counters and the register come back as they were sent.
    fn diagnostics(subfunction: DiagnosticSubfunction, data: &[u8]) -> Self {
        use DiagnosticSubfunction as D;
        let [high, low] = subfunction.code().to_be_bytes();
        let mut head = [high, low, 0, 0, 0, 0];
        head.iter_mut().skip(2).zip(data).for_each(|(place, byte)| *place = *byte);
        let Ok(length) = u8::try_from(data.len()) else { return Self::Refusal };
        let known = match subfunction {
            D::ForceListenOnly => return Self::Refusal,
            D::Unknown(_) => return Self::Open,
            D::ReturnQueryData
            | D::RestartCommunications
            | D::ChangeAsciiDelimiter
            | D::ClearCounters
            | D::ClearOverrunCounter => length.min(4),
            D::ReturnDiagnosticRegister
            | D::BusMessageCount
            | D::BusCommunicationErrorCount
            | D::BusExceptionErrorCount
            | D::ServerMessageCount
            | D::ServerNoResponseCount
            | D::ServerNakCount
            | D::ServerBusyCount
            | D::BusCharacterOverrunCount => 0,
        };
        Self::Echo { head, echoed: known.saturating_add(2), more: length.saturating_sub(known) }
    }
}

/// The response itself, then an exception.
impl Match<2> for ExpectedResponse {
    fn lengths(&self) -> [usize; 2] {
        let pdu = match self.shape {
            Shape::Data(count) => 2usize.saturating_add(count.into()),
            Shape::Plain(length) => 1usize.saturating_add(length.into()),
            Shape::Echo { echoed, more, .. } => {
                1usize.saturating_add(echoed.into()).saturating_add(more.into())
            }
            Shape::Counted | Shape::Identification | Shape::Refusal | Shape::Open => 0,
        };
        let response = if pdu == 0 { 0 } else { pdu.saturating_add(OVERHEAD) };
        [response, EXCEPTION_PDU.saturating_add(OVERHEAD)]
    }

    fn accepts(&self, _: usize, frame: &[u8]) -> bool {
        self.accepts(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::identification::{
        ConformityLevel, Identification, ObjectId, Objects, ReadDeviceIdCode,
    };
    use crate::modbus::rtu::{FRAME_MAX, encode_response};
    use crate::modbus::{AddressRange, ExceptionCode, Response};

    #[test]
    fn only_the_response_to_the_request_is_accepted() {
        let mut buffer = [0; FRAME_MAX];
        let request =
            Request::WriteMultipleRegisters { range: AddressRange::new(0x60, 2), data: &[0, 1, 0, 2] };
        let expected = ExpectedResponse::new(5, &request);
        let function = FunctionCode::WriteMultipleRegisters;
        let right = Response::WriteMultiple { function, range: AddressRange::new(0x60, 2) };
        let refused = Response::exception(function, ExceptionCode::ServerDeviceBusy);
        for (unit, response, fits) in [
            (5, right, true),
            (6, right, false),
            (5, Response::WriteMultiple { function, range: AddressRange::new(0x60, 3) }, false),
            (5, Response::WriteMultiple { function, range: AddressRange::new(0x61, 2) }, false),
            (5, refused, true),
            (4, refused, false),
            (5, Response::exception(FunctionCode::ReadCoils, ExceptionCode::ServerDeviceBusy), false),
        ] {
            let frame = encode_response(unit, &response, &mut buffer).unwrap();
            assert_eq!(expected.accepts(frame), fits, "{unit} {response:?}");
            for cut in 0..frame.len() {
                assert!(!expected.accepts(&frame[..cut]));
            }
        }
    }

    #[test]
    fn responses_to_reads_are_known_by_their_length() {
        let expected = ExpectedResponse::new(1, &Request::ReadInputRegisters(AddressRange::new(0, 2)));
        assert_eq!(expected.lengths(), [9, 5]);
        let mut buffer = [0; FRAME_MAX];
        for bytes in (0..=250).step_by(crate::stride(4)) {
            let response =
                Response::Read { function: FunctionCode::ReadInputRegisters, data: &[7; 250][..bytes] };
            let frame = encode_response(1, &response, &mut buffer).unwrap();
            assert_eq!(expected.accepts(frame), bytes == 4);
        }
        let impossible = ExpectedResponse::new(1, &Request::ReadCoils(AddressRange::new(0, 2009)));
        assert_eq!(impossible.lengths(), [0, 5]);
        assert_eq!(
            ExpectedResponse::new(1, &Request::ReadCoils(AddressRange::new(0, 2008))).lengths(),
            [256, 5]
        );
    }

    #[test]
    fn the_rarer_function_codes() {
        let objects = Objects::new(&[0, 2, 7, 7]).unwrap();
        let identification = Identification {
            category: ReadDeviceIdCode::Basic,
            conformity: ConformityLevel::Basic,
            next: None,
            objects,
        };
        let query = |subfunction, data| Request::Diagnostics { subfunction, data };
        let answer = |subfunction, data| Response::Diagnostics { subfunction, data };
        let read_write = Request::ReadWriteMultipleRegisters {
            read: AddressRange::new(0, 1),
            write: AddressRange::new(0, 1),
            data: &[0, 0],
        };
        let read = |data| Response::Read { function: FunctionCode::ReadWriteMultipleRegisters, data };
        let mask = Request::MaskWriteRegister { address: 1, and: 2, or: 3 };
        let device = Request::ReadDeviceIdentification {
            category: ReadDeviceIdCode::Basic,
            object: ObjectId::VendorName,
        };
        use DiagnosticSubfunction::{BusMessageCount, ForceListenOnly, ReturnQueryData};
        let mut buffer = [0; FRAME_MAX];
        for (request, response, fits, length) in [
            (Request::ReadExceptionStatus, Response::ExceptionStatus(9), true, 5),
            (query(ReturnQueryData, &[1, 2]), answer(ReturnQueryData, &[1, 2]), true, 8),
            (query(ReturnQueryData, &[1, 2]), answer(ReturnQueryData, &[1, 3]), false, 8),
            (query(BusMessageCount, &[0, 0]), answer(BusMessageCount, &[1, 3]), true, 8),
            (query(BusMessageCount, &[0, 0]), answer(ReturnQueryData, &[0, 0]), false, 8),
            (query(ForceListenOnly, &[0, 0]), answer(ForceListenOnly, &[0, 0]), false, 0),
            (Request::GetCommEventCounter, Response::CommEventCounter { status: 0, events: 1 }, true, 8),
            (Request::ReportServerId, Response::ServerId(&[1, 2, 3]), true, 0),
            (mask, Response::MaskWrite { address: 1, and: 2, or: 3 }, true, 10),
            (mask, Response::MaskWrite { address: 1, and: 2, or: 4 }, false, 10),
            (read_write, read(&[0, 7]), true, 7),
            (read_write, read(&[0, 7, 0, 8]), false, 7),
            (device, Response::DeviceIdentification(identification), true, 0),
        ] {
            let expected = ExpectedResponse::new(1, &request);
            assert_eq!(expected.lengths(), [length, 5], "{request:?}");
            let frame = encode_response(1, &response, &mut buffer).unwrap();
            assert_eq!(expected.accepts(frame), fits, "{request:?} {response:?}");
            let refused = Response::exception(request.function(), ExceptionCode::IllegalFunction);
            assert!(expected.accepts(encode_response(1, &refused, &mut buffer).unwrap()));
        }
    }
}
