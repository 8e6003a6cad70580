use core::convert::Infallible;

use super::{BROADCAST, CHANNELS, Channel, External, OutputRange, Register, Settings};
use crate::modbus::server::{Destination, Failure, NoResponse, data_unit, echo, reading, serve_rtu, words};
use crate::modbus::{AddressRange, ExceptionCode, READ_REGISTERS_MAX, Request, WRITE_REGISTERS_MAX};
use crate::wire::{NoSpace, Writer};

/// What a card's firmware puts behind its dispatcher.
pub trait Hardware {
    /// The outputs could not be driven or the settings not be stored.
    type Error;

    /// Makes new settings true: drives the outputs and stores what is to survive power-off. Called once a request
    /// that writes, with all of it.
    ///
    /// # Errors
    /// [`Hardware::Error`], and the former settings stay.
    fn commit(&mut self, settings: &Settings) -> Result<(), Self::Error>;
}

/// [`Hardware`] in memory, for tests and simulators.
#[derive(Debug, Clone, Default)]
pub struct RamHardware {
    /// What was committed last.
    pub committed: Option<Settings>,
}

impl Hardware for RamHardware {
    type Error = Infallible;

    fn commit(&mut self, settings: &Settings) -> Result<(), Infallible> {
        self.committed = Some(*settings);
        Ok(())
    }
}

/// An NXI-6201: its registers and what requests do to them.
#[derive(Debug)]
pub struct Card<H> {
    hardware: H,
    settings: Settings,
    /// Last seen state of the external inputs.
    inputs: [bool; CHANNELS],
}

impl<H: Hardware> Card<H> {
    /// Powers the card up with the settings that it stored.
    ///
    /// # Errors
    /// [`Hardware::Error`] where the outputs can't be driven.
    pub fn power_up(mut hardware: H, stored: &Settings) -> Result<Self, H::Error> {
        let settings = stored.after_power_up();
        hardware.commit(&settings)?;
        Ok(Self { hardware, settings, inputs: [false; CHANNELS] })
    }

    /// A card whose outputs already are as its settings say: nothing is committed.
    #[must_use]
    pub const fn resume(hardware: H, settings: Settings) -> Self {
        Self { hardware, settings, inputs: [false; CHANNELS] }
    }

    /// The registers.
    #[must_use]
    pub const fn settings(&self) -> &Settings {
        &self.settings
    }

    /// What is behind the dispatcher.
    pub const fn hardware(&mut self) -> &mut H {
        &mut self.hardware
    }

    /// Tells the card the state of a channel's external input (5.1.7); channels past the last are ignored.
    ///
    /// # Errors
    /// [`Hardware::Error`] where the output can't be driven; the register keeps its value.
    pub fn external_input(&mut self, channel: usize, active: bool) -> Result<(), H::Error> {
        let mut settings = self.settings;
        let (Some(registers), Some(input)) =
            (settings.channels.get_mut(channel), self.inputs.get_mut(channel))
        else {
            return Ok(());
        };
        let was_active = core::mem::replace(input, active);
        let rising = active && !was_active;
        registers.output = match registers.external {
            External::Off => registers.output,
            External::Toggle => registers.output != rising,
            External::Hold => active,
        };
        self.commit(settings)
    }

    /// Switches every output off; set values stay.
    ///
    /// # Errors
    /// [`Hardware::Error`] where the outputs can't be driven; the registers keep their values.
    pub fn outputs_off(&mut self) -> Result<(), H::Error> {
        let mut settings = self.settings;
        settings.channels.iter_mut().for_each(|channel| channel.output = false);
        self.commit(settings)
    }

    /// Answers a frame to `id`, or to all, into `out`.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve<'b>(&mut self, id: u8, frame: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
        let audience = |unit| match unit {
            BROADCAST => Destination::Broadcast,
            _ if unit == id => Destination::Unit,
            _ => Destination::Other,
        };
        serve_rtu(frame, audience, |_, request, writer| self.answer(request, writer), out)
    }

    /// Checks a request whole, then carries it out whole; the data unit of the response, written into `out`.
    ///
    /// Exceptions (the manual names none): 01 for other function codes, 02 for odd or unmapped addresses and odd
    /// counts, 03 for values outside their set or range, 04 where the hardware fails.
    ///
    /// # Errors
    /// [`NoSpace`], and nothing has been written.
    pub fn dispatch<'b>(&mut self, request: &Request<'_>, out: &'b mut [u8]) -> Result<&'b [u8], NoSpace> {
        data_unit(request, out, |writer| self.answer(request, writer))
    }

    fn answer(&mut self, request: &Request<'_>, writer: &mut Writer<'_>) -> Result<(), Failure> {
        match *request {
            Request::ReadHoldingRegisters(range) => {
                check_range(range, READ_REGISTERS_MAX)?;
                let length = usize::from(range.quantity).saturating_mul(2);
                let data = reading(request.function().code(), length, writer)?;
                let mut address = range.start;
                for place in data.as_chunks_mut::<4>().0 {
                    let value = Register::at(address).and_then(|register| self.settings.read(register));
                    let [a, b, c, d] = value.ok_or(ExceptionCode::IllegalDataAddress)?.to_be_bytes();
                    *place = [c, d, a, b];
                    address = address.wrapping_add(2);
                }
                Ok(())
            }
            Request::WriteMultipleRegisters { range, data } => {
                check_range(range, WRITE_REGISTERS_MAX)?;
                if data.len() != usize::from(range.quantity).saturating_mul(2) {
                    return Err(ExceptionCode::IllegalDataValue.into());
                }
                echo(request.function().code(), words([range.start, range.quantity]), writer)?;
                Ok(self.change(range.start, data)?)
            }
            _ => Err(ExceptionCode::IllegalFunction.into()),
        }
    }

    /// Writes values, of two registers each, and makes them true: all or none.
    fn change(&mut self, address: u16, data: &[u8]) -> Result<(), ExceptionCode> {
        let mut change = Change::new(&mut self.settings);
        let result = match change.write_all(address, data) {
            Ok(()) => self.hardware.commit(change.settings).map_err(|_| ExceptionCode::ServerDeviceFailure),
            refused => refused,
        };
        if result.is_err() {
            change.undo();
        }
        result
    }

    fn commit(&mut self, settings: Settings) -> Result<(), H::Error> {
        self.hardware.commit(&settings)?;
        self.settings = settings;
        Ok(())
    }
}

/// Quantity (exception 03), then whether there are whole pairs of registers (exception 02).
fn check_range(range: AddressRange, max: u16) -> Result<(), ExceptionCode> {
    if range.quantity == 0 || range.quantity > max {
        return Err(ExceptionCode::IllegalDataValue);
    }
    if !range.start.is_multiple_of(2) || !range.quantity.is_multiple_of(2) || range.last().is_none() {
        return Err(ExceptionCode::IllegalDataAddress);
    }
    Ok(())
}

/// Settings while they are written, with what they were; channel n is bit n.
struct Change<'a> {
    settings: &'a mut Settings,
    /// The channels of which a value was written, as they were.
    channels: [Option<Channel>; CHANNELS],
    can_bit_rate: u32,
    can_id: u32,
    keep: bool,
    /// Which set values the write names itself.
    set_named: u8,
    /// Which power-up set values the write names itself.
    start_named: u8,
}

/// The bit of a channel.
const fn channel_bit(index: usize) -> u8 {
    1u8.wrapping_shl(index as u32)
}

impl<'a> Change<'a> {
    const fn new(settings: &'a mut Settings) -> Self {
        let Settings { can_bit_rate, can_id, keep, .. } = *settings;
        let channels = [None; CHANNELS];
        Self { settings, channels, can_bit_rate, can_id, keep, set_named: 0, start_named: 0 }
    }

    /// The settings become what they were.
    fn undo(self) {
        for (channel, former) in self.settings.channels.iter_mut().zip(self.channels) {
            *channel = former.unwrap_or(*channel);
        }
        let Self { can_bit_rate, can_id, keep, .. } = self;
        *self.settings = Settings { can_bit_rate, can_id, keep, ..*self.settings };
    }

    /// A channel that is going to be written.
    fn channel(&mut self, index: usize) -> Option<&mut Channel> {
        let channel = self.settings.channels.get_mut(index)?;
        self.channels.get_mut(index)?.get_or_insert(*channel);
        Some(channel)
    }

    /// Takes values of two registers each, and checks what they leave behind.
    fn write_all(&mut self, mut address: u16, data: &[u8]) -> Result<(), ExceptionCode> {
        let mut fits = true;
        for words in data.as_chunks::<4>().0 {
            // an address that is not there is told before a value that does not fit
            let register = Register::at(address).ok_or(ExceptionCode::IllegalDataAddress)?;
            let [c, d, a, b] = *words;
            fits &= self.write(register, u32::from_be_bytes([a, b, c, d])).is_some();
            address = address.wrapping_add(2);
        }
        let fits = fits && self.check().is_some();
        if fits { Ok(()) } else { Err(ExceptionCode::IllegalDataValue) }
    }

    /// Takes one value; `None` where it is outside its set. Limits of ranges are checked at the end.
    fn write(&mut self, register: Register, value: u32) -> Option<()> {
        match register {
            Register::Range(index) => self.channel(index)?.range = OutputRange::from_value(value)?,
            Register::SetValue(index) => {
                self.channel(index)?.set_value = f32::from_bits(value);
                self.set_named |= channel_bit(index);
            }
            Register::Output(index) => self.channel(index)?.output = switch(value)?,
            Register::StartEnable(index) => self.channel(index)?.start_enable = value,
            Register::StartRange(index) => self.channel(index)?.start_range = OutputRange::from_value(value)?,
            Register::StartValue(index) => {
                self.channel(index)?.start_value = f32::from_bits(value);
                self.start_named |= channel_bit(index);
            }
            Register::External(index) => self.channel(index)?.external = External::from_value(value)?,
            Register::CanBitRate => {
                self.settings.can_bit_rate = Some(value).filter(|rate| (5000..=1_000_000).contains(rate))?;
            }
            Register::CanId => self.settings.can_id = Some(value).filter(|id| (1..=127).contains(id))?,
            Register::Keep => self.settings.keep = switch(value)?,
            Register::FactoryReset => {
                Some(value).filter(|value| *value == 1)?;
                (0..CHANNELS).for_each(|index| {
                    self.channel(index);
                });
                self.settings.factory_reset();
            }
        }
        Some(())
    }

    /// Checks what the write leaves behind; `None` where a value that it names does not fit its range.
    /// A value that it does not name and that no longer fits becomes 0: an output never jumps to a value that nobody
    /// asked for in that unit.
    fn check(&mut self) -> Option<()> {
        for (index, channel) in self.settings.channels.iter_mut().enumerate() {
            if self.channels.get(index)?.is_some() {
                let Channel { range, start_range, .. } = *channel;
                fit(range, &mut channel.set_value, self.set_named & channel_bit(index) != 0)?;
                fit(start_range, &mut channel.start_value, self.start_named & channel_bit(index) != 0)?;
            }
        }
        Some(())
    }
}

fn fit(range: OutputRange, value: &mut f32, named: bool) -> Option<()> {
    if !range.contains(*value) {
        if named {
            return None;
        }
        *value = 0.0;
    }
    Some(())
}

const fn switch(value: u32) -> Option<bool> {
    match value {
        0 => Some(false),
        1 => Some(true),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
