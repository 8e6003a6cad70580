use super::{FunctionCode, Range};
use crate::wire::{NoSpace, Reader, Truncated, Writer};

/// A request, decoded but not judged: quantities and values are as they came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request<'a> {
    /// 0x01 (6.1).
    ReadCoils(Range),
    /// 0x02 (6.2).
    ReadDiscreteInputs(Range),
    /// 0x03 (6.3).
    ReadHoldingRegisters(Range),
    /// 0x04 (6.4).
    ReadInputRegisters(Range),
    /// 0x05 (6.5).
    WriteSingleCoil {
        /// Address of the coil.
        address: u16,
        /// [`COIL_ON`](super::COIL_ON) or [`COIL_OFF`](super::COIL_OFF); anything else is for the server to refuse.
        value: u16,
    },
    /// 0x06 (6.6).
    WriteSingleRegister {
        /// Address of the register.
        address: u16,
        /// Its new value.
        value: u16,
    },
    /// 0x0F (6.11).
    WriteMultipleCoils {
        /// The coils.
        range: Range,
        /// Packed bits, as many bytes as the byte count said; that count need not fit the quantity.
        data: &'a [u8],
    },
    /// 0x10 (6.12).
    WriteMultipleRegisters {
        /// The registers.
        range: Range,
        /// Register values, as many bytes as the byte count said; that count need not fit the quantity.
        data: &'a [u8],
    },
    /// Any other function code, whole.
    Other {
        /// The function code.
        function: FunctionCode,
        /// All that follows it.
        data: &'a [u8],
    },
}

/// Why bytes are no request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RequestError {
    /// Not even a function code.
    Empty,
    /// The length does not fit the function code or the byte count; a server answers exception 03.
    Length(FunctionCode),
}

impl<'a> Request<'a> {
    /// Decodes a protocol data unit.
    ///
    /// # Errors
    /// [`RequestError`] where length, function code and byte count do not fit together.
    pub fn decode(pdu: &'a [u8]) -> Result<Self, RequestError> {
        let mut reader = Reader::new(pdu);
        let function = FunctionCode::from_code(reader.u8().map_err(|Truncated| RequestError::Empty)?);
        Self::decode_data(function, reader).map_err(|Truncated| RequestError::Length(function))
    }

    fn decode_data(function: FunctionCode, mut reader: Reader<'a>) -> Result<Self, Truncated> {
        use FunctionCode as F;
        let request = match function {
            F::ReadCoils => Self::ReadCoils(range(&mut reader)?),
            F::ReadDiscreteInputs => Self::ReadDiscreteInputs(range(&mut reader)?),
            F::ReadHoldingRegisters => Self::ReadHoldingRegisters(range(&mut reader)?),
            F::ReadInputRegisters => Self::ReadInputRegisters(range(&mut reader)?),
            F::WriteSingleCoil => {
                Self::WriteSingleCoil { address: reader.u16_be()?, value: reader.u16_be()? }
            }
            F::WriteSingleRegister => {
                Self::WriteSingleRegister { address: reader.u16_be()?, value: reader.u16_be()? }
            }
            F::WriteMultipleCoils => {
                Self::WriteMultipleCoils { range: range(&mut reader)?, data: counted(&mut reader)? }
            }
            F::WriteMultipleRegisters => {
                Self::WriteMultipleRegisters { range: range(&mut reader)?, data: counted(&mut reader)? }
            }
            _ => return Ok(Self::Other { function, data: reader.rest() }),
        };
        if reader.rest().is_empty() { Ok(request) } else { Err(Truncated) }
    }

    /// Writes the protocol data unit.
    ///
    /// # Errors
    /// [`NoSpace`] where it does not fit, or the data of a write is longer than its byte count can say.
    pub fn encode(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        writer.u8(self.function().code())?;
        match *self {
            Self::ReadCoils(range)
            | Self::ReadDiscreteInputs(range)
            | Self::ReadHoldingRegisters(range)
            | Self::ReadInputRegisters(range) => write_range(writer, range),
            Self::WriteSingleCoil { address, value } | Self::WriteSingleRegister { address, value } => {
                writer.u16_be(address)?;
                writer.u16_be(value)
            }
            Self::WriteMultipleCoils { range, data } | Self::WriteMultipleRegisters { range, data } => {
                write_range(writer, range)?;
                writer.u8(u8::try_from(data.len()).map_err(|_| NoSpace)?)?;
                writer.slice(data)
            }
            Self::Other { data, .. } => writer.slice(data),
        }
    }

    /// Its function code.
    #[must_use]
    pub const fn function(&self) -> FunctionCode {
        match *self {
            Self::ReadCoils(_) => FunctionCode::ReadCoils,
            Self::ReadDiscreteInputs(_) => FunctionCode::ReadDiscreteInputs,
            Self::ReadHoldingRegisters(_) => FunctionCode::ReadHoldingRegisters,
            Self::ReadInputRegisters(_) => FunctionCode::ReadInputRegisters,
            Self::WriteSingleCoil { .. } => FunctionCode::WriteSingleCoil,
            Self::WriteSingleRegister { .. } => FunctionCode::WriteSingleRegister,
            Self::WriteMultipleCoils { .. } => FunctionCode::WriteMultipleCoils,
            Self::WriteMultipleRegisters { .. } => FunctionCode::WriteMultipleRegisters,
            Self::Other { function, .. } => function,
        }
    }
}

fn range(reader: &mut Reader<'_>) -> Result<Range, Truncated> {
    Ok(Range { start: reader.u16_be()?, quantity: reader.u16_be()? })
}

pub(super) fn counted<'a>(reader: &mut Reader<'a>) -> Result<&'a [u8], Truncated> {
    let count = reader.u8()?;
    reader.slice(usize::from(count))
}

pub(super) fn write_range(writer: &mut Writer<'_>, range: Range) -> Result<(), NoSpace> {
    writer.u16_be(range.start)?;
    writer.u16_be(range.quantity)
}
