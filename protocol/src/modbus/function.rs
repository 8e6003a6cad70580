use crate::codes::code_table;
use crate::error::error_text;

code_table! {
    /// What a request asks for (specification, chapter 6).
    FunctionCode {
        /// Read coils
        ReadCoils = 0x01,
        /// Read discrete inputs
        ReadDiscreteInputs = 0x02,
        /// Read holding registers
        ReadHoldingRegisters = 0x03,
        /// Read input registers
        ReadInputRegisters = 0x04,
        /// Write single coil
        WriteSingleCoil = 0x05,
        /// Write single register
        WriteSingleRegister = 0x06,
        /// Read exception status
        ReadExceptionStatus = 0x07,
        /// Diagnostics
        Diagnostics = 0x08,
        /// Get comm event counter
        GetCommEventCounter = 0x0B,
        /// Get comm event log
        GetCommEventLog = 0x0C,
        /// Write multiple coils
        WriteMultipleCoils = 0x0F,
        /// Write multiple registers
        WriteMultipleRegisters = 0x10,
        /// Report server ID
        ReportServerId = 0x11,
        /// Mask write register
        MaskWriteRegister = 0x16,
        /// Read and write multiple registers
        ReadWriteMultipleRegisters = 0x17,
        /// Encapsulated interface transport, with 0x0E: read device identification
        EncapsulatedInterface = 0x2B,
    }
}

impl FunctionCode {
    /// Set in the function code of an exception response.
    pub const EXCEPTION_FLAG: u8 = 0x80;

    /// Whether this is one of the eight that most servers have: 01 to 06, 0F and 10.
    #[must_use]
    #[inline]
    pub const fn is_basic(self) -> bool {
        matches!(
            self,
            Self::ReadCoils
                | Self::ReadDiscreteInputs
                | Self::ReadHoldingRegisters
                | Self::ReadInputRegisters
                | Self::WriteSingleCoil
                | Self::WriteSingleRegister
                | Self::WriteMultipleCoils
                | Self::WriteMultipleRegisters
        )
    }

    /// Whether this only reads. What is not known counts as a write; [`Request::is_read`](super::Request::is_read)
    /// knows more of function code 2B.
    #[must_use]
    pub const fn is_read(self) -> bool {
        matches!(
            self,
            Self::ReadCoils
                | Self::ReadDiscreteInputs
                | Self::ReadHoldingRegisters
                | Self::ReadInputRegisters
                | Self::ReadExceptionStatus
                | Self::GetCommEventCounter
                | Self::GetCommEventLog
                | Self::ReportServerId
        )
    }
}

code_table! {
    /// Why a server refuses (specification, chapter 7).
    ExceptionCode {
        /// Illegal function
        IllegalFunction = 0x01,
        /// Illegal data address
        IllegalDataAddress = 0x02,
        /// Illegal data value
        IllegalDataValue = 0x03,
        /// Server device failure
        ServerDeviceFailure = 0x04,
        /// Acknowledge: accepted, and takes long
        Acknowledge = 0x05,
        /// Server device busy
        ServerDeviceBusy = 0x06,
        /// Memory parity error
        MemoryParityError = 0x08,
        /// Gateway path unavailable
        GatewayPathUnavailable = 0x0A,
        /// Gateway target device failed to respond
        GatewayTargetDeviceFailedToRespond = 0x0B,
    }
}

code_table! {
    /// What function code 08 is to do (6.8.1).
    DiagnosticSubfunction: u16 {
        /// Return query data
        ReturnQueryData = 0x0000,
        /// Restart communications option
        RestartCommunications = 0x0001,
        /// Return diagnostic register
        ReturnDiagnosticRegister = 0x0002,
        /// Change ASCII input delimiter
        ChangeAsciiDelimiter = 0x0003,
        /// Force listen only mode: never answered
        ForceListenOnly = 0x0004,
        /// Clear counters and diagnostic register
        ClearCounters = 0x000A,
        /// Return bus message count
        BusMessageCount = 0x000B,
        /// Return bus communication error count
        BusCommunicationErrorCount = 0x000C,
        /// Return bus exception error count
        BusExceptionErrorCount = 0x000D,
        /// Return server message count
        ServerMessageCount = 0x000E,
        /// Return server no response count
        ServerNoResponseCount = 0x000F,
        /// Return server NAK count
        ServerNakCount = 0x0010,
        /// Return server busy count
        ServerBusyCount = 0x0011,
        /// Return bus character overrun count
        BusCharacterOverrunCount = 0x0012,
        /// Clear overrun counter and flag
        ClearOverrunCounter = 0x0014,
    }
}

error_text! {
    ExceptionCode {
        ExceptionCode::IllegalFunction => ("illegal function"),
        ExceptionCode::IllegalDataAddress => ("illegal data address"),
        ExceptionCode::IllegalDataValue => ("illegal data value"),
        ExceptionCode::ServerDeviceFailure => ("server device failure"),
        ExceptionCode::Acknowledge => ("accepted, and takes long"),
        ExceptionCode::ServerDeviceBusy => ("server device busy"),
        ExceptionCode::MemoryParityError => ("memory parity error"),
        ExceptionCode::GatewayPathUnavailable => ("gateway path unavailable"),
        ExceptionCode::GatewayTargetDeviceFailedToRespond => ("gateway target device failed to respond"),
        ExceptionCode::Unknown(code) => ("exception {code:#04x}"),
    }
}
