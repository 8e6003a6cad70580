//! The board's own inputs and outputs as an NDAM module.

use super::LOCAL_IO;
use core::convert::Infallible;
use jointbus_protocol::modbus::server::RegisterWriter;
use jointbus_protocol::ndam9010::{ChannelError, Layout, Module};
use jointbus_protocol::nxi6201;

/// Values of the analog inputs.
pub(super) type Analog = [u16; LOCAL_IO.analog_inputs as usize];

/// The board's own outputs: the firmware looks at the registers when they were written.
#[derive(Debug)]
pub(super) struct LocalOutputs {
    is_changed: bool,
}

impl LocalOutputs {
    pub(super) const fn new() -> Self {
        Self { is_changed: false }
    }

    pub(super) const fn take_change(&mut self) -> bool {
        core::mem::replace(&mut self.is_changed, false)
    }
}

impl nxi6201::Hardware for LocalOutputs {
    type Error = Infallible;

    fn commit(&mut self, _settings: &nxi6201::Settings) -> Result<(), Infallible> {
        self.is_changed = true;
        Ok(())
    }
}

/// The module. What the board has not told, or can't, fails; an output never does.
#[derive(Debug, Clone)]
pub(super) struct LocalIo {
    /// Digital inputs, DI0 in bit 0.
    pub(super) inputs: Option<u16>,
    /// Digital outputs, DO0 in bit 0.
    pub(super) outputs: u16,
    pub(super) analog: Option<Analog>,
}

impl LocalIo {
    /// Nothing is known yet: unit 40 answers exception 04 instead of a value that nobody measured.
    pub(super) const fn new() -> Self {
        Self { inputs: None, outputs: 0, analog: None }
    }
}

impl Module for LocalIo {
    fn layout(&self) -> Layout {
        LOCAL_IO
    }

    fn digital_inputs(&mut self) -> Result<u16, ChannelError> {
        self.inputs.ok_or(ChannelError::Failed)
    }

    fn digital_outputs(&mut self) -> Result<u16, ChannelError> {
        Ok(self.outputs)
    }

    fn set_digital_outputs(&mut self, mask: u16, value: u16) -> Result<(), ChannelError> {
        self.outputs = self.outputs & !mask | value & mask;
        Ok(())
    }

    fn analog_inputs(&mut self, first: u8, values: &mut RegisterWriter<'_>) -> Result<(), ChannelError> {
        let analog = self.analog.ok_or(ChannelError::Failed)?;
        for value in analog.iter().skip(first.into()) {
            values.push(*value);
        }
        Ok(())
    }

    fn analog_outputs(&mut self, _first: u8, _values: &mut RegisterWriter<'_>) -> Result<(), ChannelError> {
        // the layout has none
        Err(ChannelError::Failed)
    }

    fn set_analog_outputs(&mut self, _first: u8, _values: &[u16]) -> Result<(), ChannelError> {
        // the layout has none
        Err(ChannelError::Failed)
    }
}
