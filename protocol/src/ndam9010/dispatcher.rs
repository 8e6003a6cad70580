use super::register::{AREA_BITS, AREA_REGISTERS, Area};
use crate::error::error_text;
use crate::modbus::server::{Failure, RegisterWriter, complete, data_unit, echo, reading, words};
use crate::modbus::{AddressRange, COIL_OFF, COIL_ON, ExceptionCode, Request, bit, packed_len, registers};
use crate::wire::{NoSpace, Writer};

/// Most channels of one kind in a module.
pub const CHANNELS_MAX: u8 = 16;

/// How many channels a module has of each kind, each at most [`CHANNELS_MAX`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Layout {
    /// Digital inputs.
    pub digital_inputs: u8,
    /// Digital outputs.
    pub digital_outputs: u8,
    /// Analog inputs.
    pub analog_inputs: u8,
    /// Analog outputs.
    pub analog_outputs: u8,
}

/// Why a module's channels can't be read or written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ChannelError {
    /// The driver fails: exception 04.
    Failed,
    /// The driver is busy: exception 06.
    Busy,
}

/// What a module's firmware puts behind its dispatcher; one call a request.
pub trait Module {
    /// How many channels there are.
    fn layout(&self) -> Layout;

    /// The digital inputs, DI0 in bit 0; an unconnected one is 1.
    ///
    /// # Errors
    /// [`ChannelError`]. So for every method here.
    fn digital_inputs(&mut self) -> Result<u16, ChannelError>;

    /// The digital outputs as they are set, DO0 in bit 0.
    ///
    /// # Errors
    /// [`ChannelError`].
    fn digital_outputs(&mut self) -> Result<u16, ChannelError>;

    /// Sets the digital outputs of `mask` to the bits of `value`.
    ///
    /// # Errors
    /// [`ChannelError`], and no output has changed.
    fn set_digital_outputs(&mut self, mask: u16, value: u16) -> Result<(), ChannelError>;

    /// The analog inputs from AI`first`, as many as `values` takes. Fewer are exception 04: none is made up.
    ///
    /// # Errors
    /// [`ChannelError`].
    fn analog_inputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError>;

    /// The analog outputs from AO`first` as they are set, as many as `values` takes.
    ///
    /// # Errors
    /// [`ChannelError`].
    fn analog_outputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError>;

    /// Sets the analog outputs from AO`first`; the values fit the layout.
    ///
    /// # Errors
    /// [`ChannelError`], and no output has changed.
    fn set_analog_outputs(&mut self, first: u8, values: &[u16]) -> Result<(), ChannelError>;
}

/// A [`Module`] in memory, for tests and simulators.
#[derive(Debug, Clone, Default)]
pub struct RamModule {
    /// How many channels there are.
    pub layout: Layout,
    /// Digital inputs.
    pub inputs: u16,
    /// Digital outputs.
    pub outputs: u16,
    /// Analog inputs.
    pub analog_inputs: [u16; CHANNELS_MAX as usize],
    /// Analog outputs.
    pub analog_outputs: [u16; CHANNELS_MAX as usize],
    /// What every driver call returns instead of its result, to simulate a fault.
    pub fault: Option<ChannelError>,
}

impl RamModule {
    /// A module with this layout; its inputs are not connected.
    #[must_use]
    pub fn new(layout: Layout) -> Self {
        Self { layout, inputs: u16::MAX, ..Self::default() }
    }

    fn driver(&self) -> Result<(), ChannelError> {
        self.fault.map_or(Ok(()), Err)
    }
}

impl Module for RamModule {
    fn layout(&self) -> Layout {
        self.layout
    }

    fn digital_inputs(&mut self) -> Result<u16, ChannelError> {
        self.driver().map(|()| self.inputs)
    }

    fn digital_outputs(&mut self) -> Result<u16, ChannelError> {
        self.driver().map(|()| self.outputs)
    }

    fn set_digital_outputs(&mut self, mask: u16, value: u16) -> Result<(), ChannelError> {
        self.driver()?;
        self.outputs = self.outputs & !mask | value & mask;
        Ok(())
    }

    #[inline]
    fn analog_inputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError> {
        values.extend(self.analog_inputs.get(first.into()..).unwrap_or(&[]).iter().copied());
        self.driver()
    }

    #[inline]
    fn analog_outputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError> {
        values.extend(self.analog_outputs.get(first.into()..).unwrap_or(&[]).iter().copied());
        self.driver()
    }

    fn set_analog_outputs(&mut self, first: u8, values: &[u16]) -> Result<(), ChannelError> {
        self.driver()?;
        self.analog_outputs.iter_mut().skip(first.into()).zip(values).for_each(|(to, from)| *to = *from);
        Ok(())
    }
}

/// Checks a request to a module whole, then carries it out whole; the data unit of the response, written into `out`.
///
/// Exceptions (the manual names none): 01 for other function codes; 02 past the last present register or bit, across
/// areas, and for writes of inputs; 03 for quantities, byte counts and coil values; 04 and 06 from the driver.
///
/// # Errors
/// [`NoSpace`], and nothing has been written.
pub fn dispatch<'b>(
    module: &mut impl Module,
    request: &Request<'_>,
    out: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    data_unit(request, out, |writer| answer(module, request, writer))
}

pub(super) fn answer(
    module: &mut impl Module,
    request: &Request<'_>,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let code = request.function().code();
    match *request {
        Request::ReadCoils(range) | Request::ReadDiscreteInputs(range) => {
            read_bits(module, code, range, writer)
        }
        Request::ReadHoldingRegisters(range) | Request::ReadInputRegisters(range) => {
            read_registers(module, code, range, writer)
        }
        Request::WriteSingleCoil { address, value } => {
            let bit = match value {
                COIL_ON => [1],
                COIL_OFF => [0],
                _ => return Err(ExceptionCode::IllegalDataValue.into()),
            };
            echo(code, words([address, value]), writer)?;
            Ok(write_bits(module, AddressRange::new(address, 1), &bit)?)
        }
        Request::WriteSingleRegister { address, value } => {
            echo(code, words([address, value]), writer)?;
            Ok(write_registers(module, AddressRange::new(address, 1), &value.to_be_bytes())?)
        }
        Request::WriteMultipleCoils { range, data } => {
            echo(code, words([range.start, range.quantity]), writer)?;
            Ok(write_bits(module, range, data)?)
        }
        Request::WriteMultipleRegisters { range, data } => {
            echo(code, words([range.start, range.quantity]), writer)?;
            Ok(write_registers(module, range, data)?)
        }
        _ => Err(ExceptionCode::IllegalFunction.into()),
    }
}

impl From<ChannelError> for ExceptionCode {
    fn from(error: ChannelError) -> Self {
        match error {
            ChannelError::Failed => Self::ServerDeviceFailure,
            ChannelError::Busy => Self::ServerDeviceBusy,
        }
    }
}

impl Layout {
    /// Present registers of an area: one for all digital channels of a kind, one for each analog channel.
    fn registers(self, area: Area) -> u16 {
        match area {
            Area::DigitalInput => u16::from(self.digital_inputs > 0),
            Area::DigitalOutput => u16::from(self.digital_outputs > 0),
            Area::AnalogInput => self.analog_inputs.min(CHANNELS_MAX).into(),
            Area::AnalogOutput => self.analog_outputs.min(CHANNELS_MAX).into(),
        }
    }
}

/// The bits that the channels of a digital register occupy.
const fn mask(channels: u8) -> u16 {
    match 1u16.checked_shl(channels as u32) {
        Some(above) => above.wrapping_sub(1),
        None => u16::MAX,
    }
}

/// Where in its area a run of registers starts; all of it must be present.
fn locate_registers(module: &impl Module, range: AddressRange) -> Result<(Area, u8), ExceptionCode> {
    if range.quantity == 0 || range.quantity > AREA_REGISTERS {
        return Err(ExceptionCode::IllegalDataValue);
    }
    let area = Area::of_register(range.start).ok_or(ExceptionCode::IllegalDataAddress)?;
    let first = range.start % AREA_REGISTERS;
    let end = first.saturating_add(range.quantity);
    match u8::try_from(first) {
        Ok(first) if end <= module.layout().registers(area) => Ok((area, first)),
        _ => Err(ExceptionCode::IllegalDataAddress),
    }
}

/// Where in its area a run of bits starts; all of it must lie in present registers.
fn locate_bits(module: &impl Module, range: AddressRange) -> Result<(Area, u16), ExceptionCode> {
    if range.quantity == 0 || range.quantity > AREA_BITS {
        return Err(ExceptionCode::IllegalDataValue);
    }
    let area = Area::of_bit(range.start).ok_or(ExceptionCode::IllegalDataAddress)?;
    let first = range.start % AREA_BITS;
    let end = first.saturating_add(range.quantity);
    if end > module.layout().registers(area).saturating_mul(16) {
        return Err(ExceptionCode::IllegalDataAddress);
    }
    Ok((area, first))
}

/// The digital channels of an area; missing ones read 0.
fn digital(module: &mut impl Module, area: Area) -> Result<u16, ExceptionCode> {
    let layout = module.layout();
    Ok(match area {
        Area::DigitalInput => module.digital_inputs()? & mask(layout.digital_inputs),
        _ => module.digital_outputs()? & mask(layout.digital_outputs),
    })
}

fn read_bits(
    module: &mut impl Module,
    code: u8,
    range: AddressRange,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let (area, first) = locate_bits(module, range)?;
    let data = reading(code, packed_len(range.quantity), writer)?;
    let bits = digital(module, area)?.checked_shr(first.into()).unwrap_or(0) & mask_of(range.quantity);
    // no more than sixteen bits are ever present
    for (byte, value) in data.iter_mut().zip(bits.to_le_bytes()) {
        *byte = value;
    }
    Ok(())
}

/// The lowest `quantity` bits.
fn mask_of(quantity: u16) -> u16 {
    mask(u8::try_from(quantity).unwrap_or(CHANNELS_MAX))
}

fn read_registers(
    module: &mut impl Module,
    code: u8,
    range: AddressRange,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    let (area, first) = locate_registers(module, range)?;
    let data = reading(code, usize::from(range.quantity).saturating_mul(2), writer)?;
    let mut values = RegisterWriter::new(data);
    match area {
        Area::DigitalInput | Area::DigitalOutput => values.push(digital(module, area)?),
        Area::AnalogInput => module.analog_inputs(first, &mut values).map_err(ExceptionCode::from)?,
        Area::AnalogOutput => module.analog_outputs(first, &mut values).map_err(ExceptionCode::from)?,
    }
    Ok(complete(values.remaining() == 0)?)
}

fn write_bits(module: &mut impl Module, range: AddressRange, data: &[u8]) -> Result<(), ExceptionCode> {
    if data.len() != packed_len(range.quantity) {
        return Err(ExceptionCode::IllegalDataValue);
    }
    let (area, first) = locate_bits(module, range)?;
    if area != Area::DigitalOutput {
        return Err(ExceptionCode::IllegalDataAddress);
    }
    let value = (0..range.quantity)
        .filter(|index| bit(data, *index))
        .fold(0u16, |bits, index| bits | 1u16.checked_shl(index.into()).unwrap_or(0));
    let shift = |bits: u16| bits.checked_shl(first.into()).unwrap_or(0);
    let present = mask(module.layout().digital_outputs);
    Ok(module.set_digital_outputs(shift(mask_of(range.quantity)) & present, shift(value))?)
}

fn write_registers(module: &mut impl Module, range: AddressRange, data: &[u8]) -> Result<(), ExceptionCode> {
    if data.len() != usize::from(range.quantity).saturating_mul(2) {
        return Err(ExceptionCode::IllegalDataValue);
    }
    let (area, first) = locate_registers(module, range)?;
    let mut values = [0; CHANNELS_MAX as usize];
    values.iter_mut().zip(registers(data)).for_each(|(place, value)| *place = value);
    match area {
        Area::DigitalInput | Area::AnalogInput => Err(ExceptionCode::IllegalDataAddress),
        Area::DigitalOutput => {
            let [value, ..] = values;
            Ok(module.set_digital_outputs(mask(module.layout().digital_outputs), value)?)
        }
        Area::AnalogOutput => {
            let values = values.get(..usize::from(range.quantity)).unwrap_or(&[]);
            Ok(module.set_analog_outputs(first, values)?)
        }
    }
}

error_text! {
    ChannelError {
        ChannelError::Failed => ("the channel's driver fails"),
        ChannelError::Busy => ("the channel's driver is busy"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::ExpectedResponse;
    use crate::modbus::PDU_MAX;
    use std::vec::Vec;

    const FULL: Layout =
        Layout { digital_inputs: 14, digital_outputs: 10, analog_inputs: 8, analog_outputs: 5 };
    const ADDRESS: u8 = 2;
    const VALUE: u8 = 3;

    fn module() -> RamModule {
        let mut module = RamModule::new(FULL);
        module.inputs = 0b1111_0101_1010_1100;
        module.analog_inputs = core::array::from_fn(|index| 0x1000 + index as u16);
        module
    }

    /// The response's data unit, or the exception's code.
    fn ask(module: &mut RamModule, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        let mut out = [0xEE; PDU_MAX];
        let request = Request::decode(pdu).unwrap();
        let before = module.clone();
        let response = dispatch(module, &request, &mut out).unwrap();
        assert!(ExpectedResponse::new(1, &request).accepts_pdu(response));
        for space in 0..response.len() {
            let mut other = before.clone();
            assert_eq!(dispatch(&mut other, &request, &mut [0; PDU_MAX][..space]), Err(NoSpace));
            assert_eq!((other.outputs, other.analog_outputs), (before.outputs, before.analog_outputs));
        }
        match response {
            [function, code] if *function >= 0x80 => Err(*code),
            _ => Ok(response.to_vec()),
        }
    }

    #[test]
    fn missing_channels_of_a_present_register_read_0() {
        let mut module = module();
        assert_eq!(ask(&mut module, &[4, 0, 0, 0, 1]).unwrap(), [4, 2, 0x35, 0xAC]);
        assert_eq!(ask(&mut module, &[2, 0, 0, 0, 14]).unwrap(), [2, 2, 0xAC, 0x35]);
        assert_eq!(ask(&mut module, &[1, 0, 2, 0, 3]).unwrap(), [1, 1, 0b011]);
        assert_eq!(ask(&mut module, &[2, 0, 15, 0, 1]).unwrap(), [2, 1, 0]);
        assert_eq!(ask(&mut module, &[2, 0, 0, 0, 16]).unwrap(), [2, 2, 0xAC, 0x35]);
    }

    #[test]
    fn what_lies_past_the_last_present_register_is_refused() {
        let mut module = module();
        for pdu in [
            &[2, 0, 16, 0, 1][..],
            &[2, 0, 0, 0, 17],
            &[4, 0, 1, 0, 1],
            &[4, 0, 0x47, 0, 2],
            &[4, 0, 0x48, 0, 1],
            &[3, 0, 0x1F, 0, 2],
            &[3, 0, 0x65, 0, 1],
            &[3, 0, 0x80, 0, 1],
            &[1, 4, 0, 0, 1],
            &[5, 0, 0, 0xFF, 0],
            &[6, 0, 0, 0, 1],
            &[6, 0, 0x40, 0, 1],
            &[16, 0, 0x64, 0, 2, 4, 0, 0, 0, 0],
            &[3, 0xFF, 0xFF, 0, 2],
        ] {
            assert_eq!(ask(&mut module, pdu), Err(ADDRESS), "{pdu:x?}");
        }
    }

    #[test]
    fn quantities_counts_and_values() {
        let mut module = module();
        for pdu in [
            &[3, 0, 0x40, 0, 0][..],
            &[3, 0, 0x40, 0, 0x21],
            &[1, 2, 0, 0, 0],
            &[1, 2, 0, 2, 1],
            &[5, 2, 0, 0x12, 0x34],
            &[15, 2, 0, 0, 10, 1, 0xFF],
            &[15, 2, 0, 0, 10, 0],
            &[16, 0, 0x20, 0, 1, 1, 0],
            &[16, 0, 0x20, 0, 0, 0],
        ] {
            assert_eq!(ask(&mut module, pdu), Err(VALUE), "{pdu:x?}");
        }
        assert_eq!(ask(&mut module, &[7]), Err(1));
        assert_eq!(ask(&mut module, &[0x17, 0, 0, 0, 1, 0, 0, 0, 1, 2, 0, 0]), Err(1));
        assert_eq!(ask(&mut module, &[0x41, 0, 0]), Err(1));
    }

    #[test]
    fn outputs_are_written_by_bit_and_by_register() {
        let mut module = module();
        assert_eq!(ask(&mut module, &[15, 2, 0, 0, 10, 2, 0xCD, 0x01]).unwrap(), [15, 2, 0, 0, 10]);
        assert_eq!(module.outputs, 0x01CD);
        assert_eq!(ask(&mut module, &[5, 2, 1, 0xFF, 0]).unwrap(), [5, 2, 1, 0xFF, 0]);
        assert_eq!(ask(&mut module, &[5, 2, 0, 0, 0]).unwrap(), [5, 2, 0, 0, 0]);
        assert_eq!(module.outputs, 0x01CE);
        assert_eq!(ask(&mut module, &[16, 0, 0x20, 0, 1, 2, 0xFF, 0xFF]).unwrap(), [16, 0, 0x20, 0, 1]);
        assert_eq!(module.outputs, 0x03FF, "missing channels are ignored");
        assert_eq!(ask(&mut module, &[1, 2, 8, 0, 8]).unwrap(), [1, 1, 0x03]);
        assert_eq!(ask(&mut module, &[15, 2, 4, 0, 3, 1, 0b010]).unwrap(), [15, 2, 4, 0, 3]);
        assert_eq!(module.outputs, 0x03AF);
    }

    #[test]
    fn analog_channels() {
        let mut module = module();
        assert_eq!(ask(&mut module, &[4, 0, 0x42, 0, 2]).unwrap(), [4, 4, 0x10, 2, 0x10, 3]);
        assert_eq!(ask(&mut module, &[6, 0, 0x60, 6, 0]).unwrap(), [6, 0, 0x60, 6, 0]);
        assert_eq!(ask(&mut module, &[16, 0, 0x62, 0, 2, 4, 0, 7, 0, 8]).unwrap(), [16, 0, 0x62, 0, 2]);
        assert_eq!(ask(&mut module, &[3, 0, 0x60, 0, 5]).unwrap(), [3, 10, 6, 0, 0, 0, 0, 7, 0, 8, 0, 0]);
    }

    #[test]
    fn driver_faults_become_exceptions() {
        let mut module = module();
        for (fault, code) in [(ChannelError::Failed, 4), (ChannelError::Busy, 6)] {
            module.fault = Some(fault);
            for pdu in [&[4, 0, 0, 0, 1][..], &[4, 0, 0x40, 0, 1], &[6, 0, 0x60, 6, 0], &[5, 2, 0, 0xFF, 0]] {
                assert_eq!(ask(&mut module, pdu), Err(code));
            }
        }
        assert_eq!((module.outputs, module.analog_outputs[0]), (0, 0));
    }
}
