use crate::codes::code_table;
use crate::error::error_text;
use crate::wire::{NoSpace, Reader, Truncated, Writer};

code_table! {
    /// What a request asks for (table 8).
    FunctionCode {
        /// Read registers
        Read = 0x03,
        /// Write registers
        Write = 0x10,
        /// Set zero: the present sample becomes the zero point
        SetZero = 0x12,
        /// Connect device; no frame is printed, so it has the command form and is acknowledged like a write
        Connect = 0x13,
        /// Search IP address and port; no frame is printed, so it has the command form and is answered like a read
        Search = 0x15,
        /// Restart
        Restart = 0x18,
        /// Clear zero
        ClearZero = 0x19,
    }
}

impl FunctionCode {
    /// Whether this only reads.
    #[must_use]
    pub const fn is_read(self) -> bool {
        matches!(self, Self::Read | Self::Search)
    }
}

/// Length of a command's body: function code, register, length.
pub const COMMAND_LENGTH: usize = 4;

/// Bytes of a reply's body before its data: function code, length.
pub const RESPONSE_HEADER: usize = 2;

/// Most data bytes of a write: 4.2.3 demands fewer than 250.
pub const WRITE_DATA_MAX: usize = 249;

/// Most data bytes taken in a reply: 4.2.3 counts them from DAT0 to DATn with n < 250. A device sends one fewer.
pub const REPLY_DATA_MAX: usize = 250;

/// A request, decoded but not checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request<'a> {
    /// All but [`FunctionCode::Write`].
    Command {
        /// What is asked.
        function: FunctionCode,
        /// First register, a byte address.
        register: u16,
        /// Length in bytes.
        length: u8,
    },
    /// [`FunctionCode::Write`].
    Write {
        /// First register, a byte address.
        register: u16,
        /// The new bytes, fewer than 250.
        data: &'a [u8],
    },
}

/// Why bytes are no body of a request or a reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BodyError {
    /// Not in table 8.
    UnknownFunction(u8),
    /// The length does not fit the function code or the length byte, or passes the limit of 4.2.3.
    Length,
}

impl From<Truncated> for BodyError {
    fn from(Truncated: Truncated) -> Self {
        Self::Length
    }
}

impl<'a> Request<'a> {
    /// Decodes a body.
    ///
    /// # Errors
    /// [`BodyError`] where it is no request.
    pub fn decode(body: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(body);
        let function = FunctionCode::from_code(reader.u8()?);
        if let FunctionCode::Unknown(code) = function {
            return Err(BodyError::UnknownFunction(code));
        }
        let register = reader.u16_be()?;
        let length = reader.u8()?;
        let data = reader.rest();
        match function {
            FunctionCode::Write if data.len() == usize::from(length) && data.len() <= WRITE_DATA_MAX => {
                Ok(Self::Write { register, data })
            }
            FunctionCode::Write => Err(BodyError::Length),
            _ if data.is_empty() => Ok(Self::Command { function, register, length }),
            _ => Err(BodyError::Length),
        }
    }

    /// Writes the body.
    ///
    /// # Errors
    /// [`NoSpace`] where it does not fit, or a write has more than [`WRITE_DATA_MAX`] bytes.
    pub fn encode(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        writer.u8(self.function().code())?;
        writer.u16_be(self.register())?;
        match *self {
            Self::Command { length, .. } => writer.u8(length),
            Self::Write { data, .. } => {
                let length = u8::try_from(data.len()).ok().filter(|_| data.len() <= WRITE_DATA_MAX);
                writer.u8(length.ok_or(NoSpace)?)?;
                writer.slice(data)
            }
        }
    }

    /// A read of `length` bytes from `register`.
    #[must_use]
    pub const fn read(register: u16, length: u8) -> Self {
        Self::Command { function: FunctionCode::Read, register, length }
    }

    /// Its function code.
    #[must_use]
    pub const fn function(&self) -> FunctionCode {
        match *self {
            Self::Command { function, .. } => function,
            Self::Write { .. } => FunctionCode::Write,
        }
    }

    /// Its first register.
    #[must_use]
    pub const fn register(&self) -> u16 {
        match *self {
            Self::Command { register, .. } | Self::Write { register, .. } => register,
        }
    }

    /// Its length in bytes: what is read, written or acknowledged.
    #[must_use]
    pub fn length(&self) -> u8 {
        match *self {
            Self::Command { length, .. } => length,
            Self::Write { data, .. } => u8::try_from(data.len()).unwrap_or(u8::MAX),
        }
    }
}

/// A device's answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Response<'a> {
    /// Answer to [`FunctionCode::Read`] and [`FunctionCode::Search`].
    Data {
        /// Function code of the request.
        function: FunctionCode,
        /// The bytes read.
        data: &'a [u8],
    },
    /// Answer to all others.
    Acknowledge {
        /// Function code of the request.
        function: FunctionCode,
        /// Length of the request.
        length: u8,
    },
}

impl<'a> Response<'a> {
    /// Decodes a body. Data behind function code 0x10 is taken as data (4.3.2.10 prints it so).
    ///
    /// # Errors
    /// [`BodyError`] where it is no reply.
    pub fn decode(body: &'a [u8]) -> Result<Self, BodyError> {
        let mut reader = Reader::new(body);
        let function = FunctionCode::from_code(reader.u8()?);
        let length = reader.u8()?;
        let data = reader.rest();
        match function {
            FunctionCode::Unknown(code) => Err(BodyError::UnknownFunction(code)),
            _ if data.is_empty() && !function.is_read() => Ok(Self::Acknowledge { function, length }),
            FunctionCode::Read | FunctionCode::Search | FunctionCode::Write
                if data.len() == usize::from(length) && data.len() <= REPLY_DATA_MAX =>
            {
                Ok(Self::Data { function, data })
            }
            _ => Err(BodyError::Length),
        }
    }

    /// Writes the body.
    ///
    /// # Errors
    /// [`NoSpace`] where it does not fit, or there are more than [`REPLY_DATA_MAX`] bytes of data.
    pub fn encode(&self, writer: &mut Writer<'_>) -> Result<(), NoSpace> {
        match *self {
            Self::Data { function, data } => {
                let length = u8::try_from(data.len()).ok().filter(|_| data.len() <= REPLY_DATA_MAX);
                writer.u8(function.code())?;
                writer.u8(length.ok_or(NoSpace)?)?;
                writer.slice(data)
            }
            Self::Acknowledge { function, length } => {
                writer.u8(function.code())?;
                writer.u8(length)
            }
        }
    }
}

error_text! {
    BodyError {
        BodyError::UnknownFunction(code) => ("function code {code:#04x} is in no table"),
        BodyError::Length => ("the length does not fit the function code or the length byte"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn write_lengths_end_below_250() {
        let mut body = std::vec![0x10, 0, 0, 249];
        body.extend([7; 249]);
        let request = Request::decode(&body).unwrap();
        assert_eq!(request.length(), 249);
        let mut buffer = [0xEE; 256];
        let mut writer = Writer::new(&mut buffer);
        request.encode(&mut writer).unwrap();
        assert_eq!(writer.finish(), body);

        body[3] = 250;
        body.push(7);
        assert_eq!(Request::decode(&body), Err(BodyError::Length));
    }

    #[test]
    fn unknown_functions_are_refused_with_their_code() {
        for code in 0..=u8::MAX {
            let known = !matches!(FunctionCode::from_code(code), FunctionCode::Unknown(_));
            assert_eq!(known, [0x03, 0x10, 0x12, 0x13, 0x15, 0x18, 0x19].contains(&code));
            assert_eq!(FunctionCode::from_code(code).code(), code);
            if !known {
                assert_eq!(Request::decode(&[code, 0, 0, 1]), Err(BodyError::UnknownFunction(code)));
            }
        }
    }
}
