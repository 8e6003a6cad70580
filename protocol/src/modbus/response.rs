use super::identification::{self, Identification};
use super::request::{counted, range, rest, write_counted, write_range};
use super::{AddressRange, DiagnosticSubfunction, ExceptionCode, FunctionCode};
use crate::error::error_text;
use crate::wire::{NoSpace, Reader, Truncated, Writer};

/// A server's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Response<'a> {
    /// Answer to 0x01 to 0x04 and 0x17: packed bits or register values.
    Read {
        /// Function code of the request.
        function: FunctionCode,
        /// The data, without the byte count; at most 250 bytes for a frame that the specification allows.
        data: &'a [u8],
    },
    /// Answer to 0x05 and 0x06: the request again.
    WriteSingle {
        /// Function code of the request.
        function: FunctionCode,
        /// Address written.
        address: u16,
        /// Value written.
        value: u16,
    },
    /// Answer to 0x07.
    ExceptionStatus(u8),
    /// Answer to 0x08.
    Diagnostics {
        /// What was done.
        subfunction: DiagnosticSubfunction,
        /// A counter or register in two bytes, or the request's data again.
        data: &'a [u8],
    },
    /// Answer to 0x0B.
    CommEventCounter {
        /// 0xFFFF while a program command is under way, else 0.
        status: u16,
        /// Requests that were carried out, but for those of this kind and refused ones.
        events: u16,
    },
    /// Answer to 0x0C.
    CommEventLog {
        /// As in [`Response::CommEventCounter`].
        status: u16,
        /// As in [`Response::CommEventCounter`].
        events: u16,
        /// Messages that were processed.
        messages: u16,
        /// Events, the newest first; at most 64.
        log: &'a [u8],
    },
    /// Answer to 0x0F and 0x10.
    WriteMultiple {
        /// Function code of the request.
        function: FunctionCode,
        /// What was written.
        range: AddressRange,
    },
    /// Answer to 0x11: the server's ID, a run indicator (0x00 or 0xFF) and more, in the device's own layout.
    ServerId(&'a [u8]),
    /// Answer to 0x16: the request again.
    MaskWrite {
        /// Address written.
        address: u16,
        /// Bits that stayed.
        and: u16,
        /// Bits that were set, of those that didn't stay.
        or: u16,
    },
    /// Answer to 0x2B with MEI type 0x0E.
    DeviceIdentification(Identification<'a>),
    /// The request was refused.
    Exception {
        /// Function code of the request, without the exception flag.
        function: FunctionCode,
        /// Why.
        exception: ExceptionCode,
    },
    /// Answer to any other function code or MEI type, whole.
    Other {
        /// The function code.
        function: FunctionCode,
        /// All that follows it.
        data: &'a [u8],
    },
}

/// Why bytes are no response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ResponseError {
    /// Not even a function code.
    Empty,
    /// The length does not fit the function code or the byte count.
    Length(FunctionCode),
}

impl<'a> Response<'a> {
    /// Decodes a protocol data unit.
    ///
    /// # Errors
    /// [`ResponseError`] where length, function code and byte count do not fit together.
    pub fn decode(pdu: &'a [u8]) -> Result<Self, ResponseError> {
        let mut reader = Reader::new(pdu);
        let code = reader.u8().map_err(|Truncated| ResponseError::Empty)?;
        let function = FunctionCode::from_code(code & !FunctionCode::EXCEPTION_FLAG);
        let refused = code & FunctionCode::EXCEPTION_FLAG != 0;
        Self::decode_data(function, refused, reader).map_err(|Truncated| ResponseError::Length(function))
    }

    fn decode_data(function: FunctionCode, refused: bool, mut reader: Reader<'a>) -> Result<Self, Truncated> {
        use FunctionCode as F;
        let response = match function {
            _ if refused => Self::Exception { function, exception: ExceptionCode::from_code(reader.u8()?) },
            F::ReadCoils
            | F::ReadDiscreteInputs
            | F::ReadHoldingRegisters
            | F::ReadInputRegisters
            | F::ReadWriteMultipleRegisters => Self::Read { function, data: counted(&mut reader)? },
            F::WriteSingleCoil | F::WriteSingleRegister => {
                Self::WriteSingle { function, address: reader.u16_be()?, value: reader.u16_be()? }
            }
            F::ReadExceptionStatus => Self::ExceptionStatus(reader.u8()?),
            F::Diagnostics => Self::Diagnostics {
                subfunction: DiagnosticSubfunction::from_code(reader.u16_be()?),
                data: rest(&mut reader)?,
            },
            F::GetCommEventCounter => {
                Self::CommEventCounter { status: reader.u16_be()?, events: reader.u16_be()? }
            }
            F::GetCommEventLog => {
                let mut log = Reader::new(counted(&mut reader)?);
                Self::CommEventLog {
                    status: log.u16_be()?,
                    events: log.u16_be()?,
                    messages: log.u16_be()?,
                    log: log.rest(),
                }
            }
            F::WriteMultipleCoils | F::WriteMultipleRegisters => {
                Self::WriteMultiple { function, range: range(&mut reader)? }
            }
            F::ReportServerId => Self::ServerId(counted(&mut reader)?),
            F::MaskWriteRegister => {
                Self::MaskWrite { address: reader.u16_be()?, and: reader.u16_be()?, or: reader.u16_be()? }
            }
            F::EncapsulatedInterface if reader.rest().first() == Some(&identification::MEI_TYPE) => {
                reader.u8()?;
                Self::DeviceIdentification(Identification::decode(&mut reader)?)
            }
            F::EncapsulatedInterface | F::Unknown(_) => Self::Other { function, data: rest(&mut reader)? },
        };
        if reader.rest().is_empty() { Ok(response) } else { Err(Truncated) }
    }

    /// Its function code, without the exception flag.
    #[must_use]
    pub const fn function(&self) -> FunctionCode {
        match *self {
            Self::Read { function, .. }
            | Self::WriteSingle { function, .. }
            | Self::WriteMultiple { function, .. }
            | Self::Exception { function, .. }
            | Self::Other { function, .. } => function,
            Self::ExceptionStatus(_) => FunctionCode::ReadExceptionStatus,
            Self::Diagnostics { .. } => FunctionCode::Diagnostics,
            Self::CommEventCounter { .. } => FunctionCode::GetCommEventCounter,
            Self::CommEventLog { .. } => FunctionCode::GetCommEventLog,
            Self::ServerId(_) => FunctionCode::ReportServerId,
            Self::MaskWrite { .. } => FunctionCode::MaskWriteRegister,
            Self::DeviceIdentification(_) => FunctionCode::EncapsulatedInterface,
        }
    }

    /// Writes the protocol data unit.
    ///
    /// # Errors
    /// [`NoSpace`] where it does not fit, or the data is longer than its byte count can say.
    pub fn encode(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        let function = self.function().code();
        match *self {
            Self::Exception { exception, .. } => {
                writer.slice(&[function | FunctionCode::EXCEPTION_FLAG, exception.code()])
            }
            _ => {
                writer.u8(function)?;
                self.encode_data(writer)
            }
        }
    }

    fn encode_data(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        match *self {
            Self::Read { data, .. } | Self::ServerId(data) => write_counted(writer, data),
            Self::WriteSingle { address, value, .. } => {
                writer.u16_be(address)?;
                writer.u16_be(value)
            }
            Self::ExceptionStatus(status) => writer.u8(status),
            Self::Diagnostics { subfunction, data } => {
                writer.u16_be(subfunction.code())?;
                writer.slice(data)
            }
            Self::CommEventCounter { status, events } => {
                writer.u16_be(status)?;
                writer.u16_be(events)
            }
            Self::CommEventLog { status, events, messages, log } => {
                let count = u8::try_from(log.len()).ok().and_then(|length| length.checked_add(6));
                writer.u8(count.ok_or(NoSpace)?)?;
                for word in [status, events, messages] {
                    writer.u16_be(word)?;
                }
                writer.slice(log)
            }
            Self::WriteMultiple { range, .. } => write_range(writer, range),
            Self::MaskWrite { address, and, or } => {
                writer.u16_be(address)?;
                writer.u16_be(and)?;
                writer.u16_be(or)
            }
            Self::DeviceIdentification(identification) => identification.encode(writer),
            Self::Exception { exception, .. } => writer.u8(exception.code()),
            Self::Other { data, .. } => writer.slice(data),
        }
    }

    /// The refusal of a request.
    #[must_use]
    pub const fn exception(function: FunctionCode, exception: ExceptionCode) -> Self {
        Self::Exception { function, exception }
    }
}

error_text! {
    ResponseError {
        ResponseError::Empty => ("no function code"),
        ResponseError::Length(function) => ("a wrong length for function code {:#04x}", function.code()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data units of the specification's examples, and the values that they are.
    fn printed() -> [(&'static [u8], Response<'static>); 8] {
        [
            (&[0x07, 0x6D], Response::ExceptionStatus(0x6D)),
            (
                &[0x08, 0, 0, 0xA5, 0x37],
                Response::Diagnostics {
                    subfunction: DiagnosticSubfunction::ReturnQueryData,
                    data: &[0xA5, 0x37],
                },
            ),
            (&[0x0B, 0xFF, 0xFF, 1, 8], Response::CommEventCounter { status: 0xFFFF, events: 0x0108 }),
            (
                &[0x0C, 8, 0, 0, 1, 8, 1, 0x21, 0x20, 0],
                Response::CommEventLog { status: 0, events: 0x0108, messages: 0x0121, log: &[0x20, 0] },
            ),
            (&[0x11, 3, 0x12, 0xFF, 7], Response::ServerId(&[0x12, 0xFF, 7])),
            (&[0x16, 0, 4, 0, 0xF2, 0, 0x25], Response::MaskWrite { address: 4, and: 0xF2, or: 0x25 }),
            (
                &[0x17, 4, 0, 0xFE, 0x0A, 0xCD],
                Response::Read {
                    function: FunctionCode::ReadWriteMultipleRegisters,
                    data: &[0, 0xFE, 0x0A, 0xCD],
                },
            ),
            (
                &[0x97, 0x04],
                Response::exception(
                    FunctionCode::ReadWriteMultipleRegisters,
                    ExceptionCode::ServerDeviceFailure,
                ),
            ),
        ]
    }

    #[test]
    fn printed_responses_go_both_ways() {
        for (pdu, response) in printed() {
            assert_eq!(Response::decode(pdu), Ok(response));
            let mut buffer = [0xEE; 32];
            let mut writer = Writer::new(&mut buffer);
            response.encode(&mut writer).unwrap();
            assert_eq!(writer.finish(), pdu);
            for space in 0..pdu.len() {
                assert_eq!(response.encode(&mut Writer::new(&mut [0; 32][..space])), Err(NoSpace));
            }
        }
    }

    #[test]
    fn what_is_too_long_or_too_short_is_refused() {
        for (pdu, response) in printed() {
            if matches!(response, Response::Diagnostics { .. }) {
                continue;
            }
            let error = Err(ResponseError::Length(response.function()));
            for cut in 1..pdu.len() {
                assert_eq!(Response::decode(&pdu[..cut]), error, "{pdu:x?} cut at {cut}");
            }
            assert_eq!(Response::decode(&[pdu, &[0]].concat()), error, "{pdu:x?} and a byte more");
        }
        assert_eq!(Response::decode(&[]), Err(ResponseError::Empty));
        assert_eq!(
            Response::decode(&[0x0C, 5, 0, 0, 0, 0, 0]),
            Err(ResponseError::Length(FunctionCode::GetCommEventLog)),
            "a log shorter than its head"
        );
    }
}
