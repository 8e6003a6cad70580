use jointbus_protocol::{modbus, nst};

/// A write or a command that a device has carried out, broadcasts included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Order {
    /// Function code.
    pub function: u8,
    /// First register, coil or byte address.
    pub register: u16,
    /// The first data: four bytes of NST, one or two registers of Modbus, the high byte first; 0 for a command.
    pub value: u32,
}

impl Order {
    /// What an NST request orders; `None` for one that only reads.
    #[must_use]
    pub fn of_nst(request: &nst::Request<'_>) -> Option<Self> {
        let (function, register) = (request.function(), request.register());
        let value = match *request {
            nst::Request::Write { data, .. } => head(data),
            nst::Request::Command { .. } => 0,
        };
        (!function.is_read()).then_some(Self { function: function.code(), register, value })
    }

    /// What a Modbus data unit orders; `None` for one that only reads, or has no address and value.
    #[must_use]
    pub fn of_modbus(pdu: &[u8]) -> Option<Self> {
        let request = modbus::Request::decode(pdu).ok().filter(|request| !request.is_read())?;
        let function = request.function();
        let many = matches!(
            function,
            modbus::FunctionCode::WriteMultipleCoils | modbus::FunctionCode::WriteMultipleRegisters
        );
        let (register, rest) = pdu.get(1..)?.split_first_chunk::<2>()?;
        // quantity and byte count come before the data
        let data = rest.get(if many { 3 } else { 0 }..)?;
        Some(Self { function: function.code(), register: u16::from_be_bytes(*register), value: head(data) })
    }
}

fn head(data: &[u8]) -> u32 {
    data.iter().take(4).fold(0, |value, byte| value << 8 | u32::from(*byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_are_no_orders() {
        assert_eq!(Order::of_nst(&nst::Request::read(0, 4)), None);
        assert_eq!(Order::of_modbus(&[3, 0, 0, 0, 1]), None);
        let write = nst::Request::Write { register: 7, data: &[1, 2, 3, 4, 5] };
        assert_eq!(Order::of_nst(&write), Some(Order { function: 0x10, register: 7, value: 0x0102_0304 }));
        let single = Order { function: 6, register: 0x60, value: 0x1234 };
        assert_eq!(Order::of_modbus(&[6, 0, 0x60, 0x12, 0x34]), Some(single));
        let many = Order { function: 16, register: 0x60, value: 0x1234_5678 };
        assert_eq!(Order::of_modbus(&[16, 0, 0x60, 0, 2, 4, 0x12, 0x34, 0x56, 0x78]), Some(many));
    }
}
