use crate::codes::code_table;

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

    /// Whether this only reads. What is not known counts as a write.
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
