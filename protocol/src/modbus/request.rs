use super::identification::{self, ObjectId, ReadDeviceIdCode};
use super::{AddressRange, DiagnosticSubfunction, FunctionCode};
use crate::error::error_text;
use crate::wire::{NoSpace, Reader, Truncated, Writer};

/// A request, decoded but not checked: quantities and values are as they came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request<'a> {
    /// 0x01 (6.1).
    ReadCoils(AddressRange),
    /// 0x02 (6.2).
    ReadDiscreteInputs(AddressRange),
    /// 0x03 (6.3).
    ReadHoldingRegisters(AddressRange),
    /// 0x04 (6.4).
    ReadInputRegisters(AddressRange),
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
    /// 0x07 (6.7).
    ReadExceptionStatus,
    /// 0x08 (6.8).
    Diagnostics {
        /// What is to be done.
        subfunction: DiagnosticSubfunction,
        /// Its data, two bytes but for [`DiagnosticSubfunction::ReturnQueryData`], which may have any number.
        data: &'a [u8],
    },
    /// 0x0B (6.9).
    GetCommEventCounter,
    /// 0x0C (6.10).
    GetCommEventLog,
    /// 0x0F (6.11).
    WriteMultipleCoils {
        /// The coils.
        range: AddressRange,
        /// Packed bits, as many bytes as the byte count said; that count need not fit the quantity.
        data: &'a [u8],
    },
    /// 0x10 (6.12).
    WriteMultipleRegisters {
        /// The registers.
        range: AddressRange,
        /// Register values, as many bytes as the byte count said; that count need not fit the quantity.
        data: &'a [u8],
    },
    /// 0x11 (6.13).
    ReportServerId,
    /// 0x16 (6.16): the register becomes its value and `and`, or `or` without `and`.
    MaskWriteRegister {
        /// Address of the register.
        address: u16,
        /// Bits that stay.
        and: u16,
        /// Bits that are set, of those that don't stay.
        or: u16,
    },
    /// 0x17 (6.17): writes, then reads.
    ReadWriteMultipleRegisters {
        /// The registers to be read.
        read: AddressRange,
        /// The registers to be written.
        write: AddressRange,
        /// Register values, as many bytes as the byte count said; that count need not fit the quantity.
        data: &'a [u8],
    },
    /// 0x2B with MEI type 0x0E (6.21).
    ReadDeviceIdentification {
        /// Which objects.
        category: ReadDeviceIdCode,
        /// The first, or the only one.
        object: ObjectId,
    },
    /// Any other function code or MEI type, whole.
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
            F::ReadCoils
            | F::ReadDiscreteInputs
            | F::ReadHoldingRegisters
            | F::ReadInputRegisters
            | F::WriteSingleCoil
            | F::WriteSingleRegister
            | F::WriteMultipleCoils
            | F::WriteMultipleRegisters => return Self::decode_basic(function, reader),
            F::ReadExceptionStatus => Self::ReadExceptionStatus,
            F::Diagnostics => Self::Diagnostics {
                subfunction: DiagnosticSubfunction::from_code(reader.u16_be()?),
                data: rest(&mut reader)?,
            },
            F::GetCommEventCounter => Self::GetCommEventCounter,
            F::GetCommEventLog => Self::GetCommEventLog,
            F::ReportServerId => Self::ReportServerId,
            F::MaskWriteRegister => Self::MaskWriteRegister {
                address: reader.u16_be()?,
                and: reader.u16_be()?,
                or: reader.u16_be()?,
            },
            F::ReadWriteMultipleRegisters => Self::ReadWriteMultipleRegisters {
                read: range(&mut reader)?,
                write: range(&mut reader)?,
                data: counted(&mut reader)?,
            },
            F::EncapsulatedInterface if reader.rest().first() == Some(&identification::MEI_TYPE) => {
                let [_, category, object] = reader.array()?;
                Self::ReadDeviceIdentification {
                    category: ReadDeviceIdCode::from_code(category),
                    object: ObjectId::from_code(object),
                }
            }
            F::EncapsulatedInterface | F::Unknown(_) => Self::Other { function, data: rest(&mut reader)? },
        };
        if reader.rest().is_empty() { Ok(request) } else { Err(Truncated) }
    }

    /// Decodes what follows one of the [basic](FunctionCode::is_basic) function codes: apart from the others, so that a
    /// server of these carries no more.
    #[inline]
    pub(super) fn decode_basic(function: FunctionCode, mut reader: Reader<'a>) -> Result<Self, Truncated> {
        use FunctionCode as F;
        let range @ AddressRange { start, quantity } = range(&mut reader)?;
        let request = match function {
            F::ReadCoils => Self::ReadCoils(range),
            F::ReadDiscreteInputs => Self::ReadDiscreteInputs(range),
            F::ReadHoldingRegisters => Self::ReadHoldingRegisters(range),
            F::ReadInputRegisters => Self::ReadInputRegisters(range),
            F::WriteSingleCoil => Self::WriteSingleCoil { address: start, value: quantity },
            F::WriteSingleRegister => Self::WriteSingleRegister { address: start, value: quantity },
            F::WriteMultipleCoils => Self::WriteMultipleCoils { range, data: counted(&mut reader)? },
            F::WriteMultipleRegisters => Self::WriteMultipleRegisters { range, data: counted(&mut reader)? },
            _ => return Err(Truncated),
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
            Self::ReadExceptionStatus
            | Self::GetCommEventCounter
            | Self::GetCommEventLog
            | Self::ReportServerId => Ok(()),
            Self::Diagnostics { subfunction, data } => {
                writer.u16_be(subfunction.code())?;
                writer.slice(data)
            }
            Self::WriteMultipleCoils { range, data } | Self::WriteMultipleRegisters { range, data } => {
                write_range(writer, range)?;
                write_counted(writer, data)
            }
            Self::MaskWriteRegister { address, and, or } => {
                writer.u16_be(address)?;
                writer.u16_be(and)?;
                writer.u16_be(or)
            }
            Self::ReadWriteMultipleRegisters { read, write, data } => {
                write_range(writer, read)?;
                write_range(writer, write)?;
                write_counted(writer, data)
            }
            Self::ReadDeviceIdentification { category, object } => {
                writer.slice(&[identification::MEI_TYPE, category.code(), object.code()])
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
            Self::ReadExceptionStatus => FunctionCode::ReadExceptionStatus,
            Self::Diagnostics { .. } => FunctionCode::Diagnostics,
            Self::GetCommEventCounter => FunctionCode::GetCommEventCounter,
            Self::GetCommEventLog => FunctionCode::GetCommEventLog,
            Self::WriteMultipleCoils { .. } => FunctionCode::WriteMultipleCoils,
            Self::WriteMultipleRegisters { .. } => FunctionCode::WriteMultipleRegisters,
            Self::ReportServerId => FunctionCode::ReportServerId,
            Self::MaskWriteRegister { .. } => FunctionCode::MaskWriteRegister,
            Self::ReadWriteMultipleRegisters { .. } => FunctionCode::ReadWriteMultipleRegisters,
            Self::ReadDeviceIdentification { .. } => FunctionCode::EncapsulatedInterface,
            Self::Other { function, .. } => function,
        }
    }

    /// Whether it only reads. What is not known counts as a write, and so does function code 08.
    #[must_use]
    pub const fn is_read(&self) -> bool {
        matches!(self, Self::ReadDeviceIdentification { .. }) || self.function().is_read()
    }
}

pub(super) fn range(reader: &mut Reader<'_>) -> Result<AddressRange, Truncated> {
    Ok(AddressRange { start: reader.u16_be()?, quantity: reader.u16_be()? })
}

pub(super) fn counted<'a>(reader: &mut Reader<'a>) -> Result<&'a [u8], Truncated> {
    let count = reader.u8()?;
    reader.slice(usize::from(count))
}

pub(super) fn rest<'a>(reader: &mut Reader<'a>) -> Result<&'a [u8], Truncated> {
    reader.slice(reader.rest().len())
}

pub(super) fn write_range(writer: &mut Writer<'_>, range: AddressRange) -> Result<(), NoSpace> {
    writer.u16_be(range.start)?;
    writer.u16_be(range.quantity)
}

pub(super) fn write_counted(writer: &mut Writer<'_>, data: &[u8]) -> Result<(), NoSpace> {
    writer.u8(u8::try_from(data.len()).map_err(|_| NoSpace)?)?;
    writer.slice(data)
}

error_text! {
    RequestError {
        RequestError::Empty => ("no function code"),
        RequestError::Length(function) => ("a wrong length for function code {:#04x}", function.code()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data units of the specification's examples, and the values that they are.
    fn printed() -> [(&'static [u8], Request<'static>, bool); 9] {
        [
            (&[0x05, 0, 0xAC, 0x12, 0x34], Request::WriteSingleCoil { address: 0xAC, value: 0x1234 }, false),
            (&[0x07], Request::ReadExceptionStatus, true),
            (
                &[0x08, 0, 0, 0xA5, 0x37],
                Request::Diagnostics {
                    subfunction: DiagnosticSubfunction::ReturnQueryData,
                    data: &[0xA5, 0x37],
                },
                false,
            ),
            (&[0x0B], Request::GetCommEventCounter, true),
            (&[0x11], Request::ReportServerId, true),
            (
                &[0x16, 0, 4, 0, 0xF2, 0, 0x25],
                Request::MaskWriteRegister { address: 4, and: 0xF2, or: 0x25 },
                false,
            ),
            (
                &[0x17, 0, 3, 0, 6, 0, 0x0E, 0, 3, 6, 0, 0xFF, 0, 0xFF, 0, 0xFF],
                Request::ReadWriteMultipleRegisters {
                    read: AddressRange::new(3, 6),
                    write: AddressRange::new(14, 3),
                    data: &[0, 0xFF, 0, 0xFF, 0, 0xFF],
                },
                false,
            ),
            (
                &[0x2B, 0x0E, 1, 0],
                Request::ReadDeviceIdentification {
                    category: ReadDeviceIdCode::Basic,
                    object: ObjectId::VendorName,
                },
                true,
            ),
            (
                &[0x2B, 0x0D, 1, 2, 3],
                Request::Other { function: FunctionCode::EncapsulatedInterface, data: &[0x0D, 1, 2, 3] },
                false,
            ),
        ]
    }

    #[test]
    fn printed_requests_go_both_ways() {
        for (pdu, request, is_read) in printed() {
            assert_eq!(Request::decode(pdu), Ok(request));
            assert_eq!(request.is_read(), is_read);
            let mut buffer = [0xEE; 32];
            let mut writer = Writer::new(&mut buffer);
            request.encode(&mut writer).unwrap();
            assert_eq!(writer.finish(), pdu);
            for space in 0..pdu.len() {
                assert_eq!(request.encode(&mut Writer::new(&mut [0; 32][..space])), Err(NoSpace));
            }
        }
    }

    #[test]
    fn what_is_too_long_or_too_short_is_refused() {
        for (pdu, request, _) in printed() {
            if matches!(request, Request::Other { .. } | Request::Diagnostics { .. }) {
                continue;
            }
            let error = Err(RequestError::Length(request.function()));
            for cut in 1..pdu.len() {
                // without its MEI type nobody knows what kind of 2B it is
                if pdu[..cut] != [0x2B] {
                    assert_eq!(Request::decode(&pdu[..cut]), error, "{pdu:x?} cut at {cut}");
                }
            }
            let longer = [pdu, &[0]].concat();
            assert_eq!(Request::decode(&longer), error, "{longer:x?}");
        }
        assert_eq!(Request::decode(&[]), Err(RequestError::Empty));
    }

    #[test]
    fn every_unknown_function_code_is_kept_whole() {
        for code in 0..=u8::MAX {
            let function = FunctionCode::from_code(code);
            assert_eq!(function.code(), code);
            if let FunctionCode::Unknown(_) = function {
                let pdu = [code, 1, 2, 3];
                let request = Request::decode(&pdu).unwrap();
                assert_eq!(request, Request::Other { function, data: &[1, 2, 3] });
                assert!(!request.is_read());
            }
        }
        assert_eq!(DiagnosticSubfunction::from_code(0x0013), DiagnosticSubfunction::Unknown(0x0013));
    }
}
