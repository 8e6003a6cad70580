use super::request::{counted, write_range};
use super::{ExceptionCode, FunctionCode, Range};
use crate::wire::{NoSpace, Reader, Truncated, Writer};

/// A server's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Response<'a> {
    /// Answer to 0x01 to 0x04: packed bits or register values.
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
    /// Answer to 0x0F and 0x10.
    WriteMultiple {
        /// Function code of the request.
        function: FunctionCode,
        /// What was written.
        range: Range,
    },
    /// The request was refused.
    Exception {
        /// Function code of the request, without the exception flag.
        function: FunctionCode,
        /// Why.
        exception: ExceptionCode,
    },
    /// Answer to any other function code, whole.
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
            F::ReadCoils | F::ReadDiscreteInputs | F::ReadHoldingRegisters | F::ReadInputRegisters => {
                Self::Read { function, data: counted(&mut reader)? }
            }
            F::WriteSingleCoil | F::WriteSingleRegister => {
                Self::WriteSingle { function, address: reader.u16_be()?, value: reader.u16_be()? }
            }
            F::WriteMultipleCoils | F::WriteMultipleRegisters => Self::WriteMultiple {
                function,
                range: Range { start: reader.u16_be()?, quantity: reader.u16_be()? },
            },
            _ => return Ok(Self::Other { function, data: reader.rest() }),
        };
        if reader.rest().is_empty() { Ok(response) } else { Err(Truncated) }
    }

    /// Writes the protocol data unit.
    ///
    /// # Errors
    /// [`NoSpace`] where it does not fit, or the data is longer than its byte count can say.
    pub fn encode(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        match *self {
            Self::Read { function, data } => {
                writer.u8(function.code())?;
                writer.u8(u8::try_from(data.len()).map_err(|_| NoSpace)?)?;
                writer.slice(data)
            }
            Self::WriteSingle { function, address, value } => {
                writer.u8(function.code())?;
                writer.u16_be(address)?;
                writer.u16_be(value)
            }
            Self::WriteMultiple { function, range } => {
                writer.u8(function.code())?;
                write_range(writer, range)
            }
            Self::Exception { function, exception } => {
                writer.u8(function.code() | FunctionCode::EXCEPTION_FLAG)?;
                writer.u8(exception.code())
            }
            Self::Other { function, data } => {
                writer.u8(function.code())?;
                writer.slice(data)
            }
        }
    }

    /// The refusal of a request.
    #[must_use]
    pub const fn exception(function: FunctionCode, exception: ExceptionCode) -> Self {
        Self::Exception { function, exception }
    }
}
