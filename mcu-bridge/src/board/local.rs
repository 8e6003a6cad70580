//! The units that a board serves by itself: its outputs as an NXI-6201, its inputs and outputs as an NDAM module.

use core::convert::Infallible;
use jointbus_protocol::modbus::Request;
use jointbus_protocol::modbus::server::RegisterWriter;
use jointbus_protocol::ndam9010::{self, ChannelError, Layout, Module};
use jointbus_protocol::nxi6201;

/// What one of the board's own units is to the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LocalKind {
    /// Outputs with the register map of an NXI-6201.
    Nxi,
    /// Inputs and outputs with the register map of an NDAM module.
    Ndam,
}

impl LocalKind {
    /// The address of a broadcast that reaches it.
    #[must_use]
    pub const fn broadcast(self) -> u8 {
        match self {
            Self::Nxi => nxi6201::BROADCAST,
            Self::Ndam => jointbus_protocol::modbus::BROADCAST,
        }
    }
}

/// One of a board's own units.
pub trait LocalUnit: core::fmt::Debug {
    /// The unit before it is powered up; all zeros where the engine's memory is to lie in `.bss`.
    const NEW: Self;
    /// What it is to the host.
    const KIND: LocalKind;

    /// Sets the unit to what it is when power comes.
    fn power_up(&mut self);

    /// Checks a request whole, then carries it out whole; the data unit of the response, written into `out`. `None`
    /// where it has no room.
    fn dispatch<'o>(&mut self, request: &Request<'_>, out: &'o mut [u8]) -> Option<&'o [u8]>;

    /// Switches the outputs off; what they are set to stays.
    fn switch_off(&mut self);

    /// Whether outputs were written since this was asked last.
    fn take_change(&mut self) -> bool;
}

/// All of a board's own units: `()` for none, else a tuple of at most four [`LocalUnit`]s.
pub trait LocalUnits: core::fmt::Debug {
    /// The units before they are powered up.
    const NEW: Self;
    /// What each is to the host.
    const KINDS: &'static [LocalKind];

    /// As [`LocalUnit::power_up`], for all.
    fn power_up(&mut self);

    /// As [`LocalUnit::dispatch`], for the unit at that place; `None` where there is none.
    fn dispatch<'o>(&mut self, index: u8, request: &Request<'_>, out: &'o mut [u8]) -> Option<&'o [u8]>;

    /// As [`LocalUnit::switch_off`], for all.
    fn switch_off(&mut self);

    /// As [`LocalUnit::take_change`], for any.
    fn take_change(&mut self) -> bool;
}

macro_rules! local_units {
    ($($unit:ident $index:tt),*) => {
        impl<$($unit: LocalUnit),*> LocalUnits for ($($unit,)*) {
            const NEW: Self = ($($unit::NEW,)*);
            const KINDS: &'static [LocalKind] = &[$($unit::KIND),*];

            fn power_up(&mut self) {
                $(self.$index.power_up();)*
            }

            #[allow(unused_variables, reason = "a board may have no units of its own")]
            fn dispatch<'o>(&mut self, index: u8, request: &Request<'_>, out: &'o mut [u8]) -> Option<&'o [u8]> {
                match index {
                    $($index => self.$index.dispatch(request, out),)*
                    _ => None,
                }
            }

            fn switch_off(&mut self) {
                $(self.$index.switch_off();)*
            }

            fn take_change(&mut self) -> bool {
                // each is asked
                false $(| self.$index.take_change())*
            }
        }
    };
}

local_units!();
local_units!(A 0);
local_units!(A 0, B 1);
local_units!(A 0, B 1, C 2);
local_units!(A 0, B 1, C 2, D 3);

/// Four outputs as an NXI-6201: the firmware looks at the registers when they were written.
#[derive(Debug)]
pub struct Outputs(nxi6201::Card<Commits>);

/// Remembers that registers were written.
#[derive(Debug)]
struct Commits {
    is_changed: bool,
}

impl nxi6201::Hardware for Commits {
    type Error = Infallible;

    fn commit(&mut self, _settings: &nxi6201::Settings) -> Result<(), Infallible> {
        self.is_changed = true;
        Ok(())
    }
}

impl Outputs {
    /// What the outputs are to be.
    #[must_use]
    pub const fn settings(&self) -> &nxi6201::Settings {
        self.0.settings()
    }
}

/// Registers of the outputs before the start, in zeros.
const NO_OUTPUTS: nxi6201::Settings = {
    let channel = nxi6201::Channel {
        range: nxi6201::OutputRange::Volts5,
        set_value: 0.0,
        output: false,
        start_enable: 0,
        start_range: nxi6201::OutputRange::Volts5,
        start_value: 0.0,
        external: nxi6201::External::Off,
    };
    nxi6201::Settings { channels: [channel; nxi6201::CHANNELS], can_bit_rate: 0, can_id: 0, keep: false }
};

impl LocalUnit for Outputs {
    const NEW: Self = Self(nxi6201::Card::resume(Commits { is_changed: false }, NO_OUTPUTS));
    const KIND: LocalKind = LocalKind::Nxi;

    fn power_up(&mut self) {
        let commits = Commits { is_changed: false };
        let Ok(card) = nxi6201::Card::power_up(commits, &nxi6201::Settings::default());
        self.0 = card;
    }

    fn dispatch<'o>(&mut self, request: &Request<'_>, out: &'o mut [u8]) -> Option<&'o [u8]> {
        self.0.dispatch(request, out).ok()
    }

    fn switch_off(&mut self) {
        let Ok(()) = self.0.outputs_off();
    }

    fn take_change(&mut self) -> bool {
        core::mem::take(&mut self.0.hardware().is_changed)
    }
}

/// Values of so many analog inputs.
pub type Analog<const AI: usize> = [u16; AI];

/// Inputs and outputs as an NDAM module with so many digital inputs, digital outputs and analog inputs, at most 16 of
/// each. What the board has not told, or can't, fails with exception 04; an output never does.
#[derive(Debug, Clone)]
pub struct InputsOutputs<const DI: u8, const DO: u8, const AI: usize> {
    inputs: Option<u16>,
    outputs: u16,
    analog: Option<Analog<AI>>,
    is_changed: bool,
}

impl<const DI: u8, const DO: u8, const AI: usize> InputsOutputs<DI, DO, AI> {
    const LAYOUT: Layout = {
        let max = ndam9010::CHANNELS_MAX;
        assert!(DI <= max && DO <= max && AI <= max as usize, "a module has at most 16 channels of a kind");
        Layout { digital_inputs: DI, digital_outputs: DO, analog_inputs: AI as u8, analog_outputs: 0 }
    };

    /// The state of the digital inputs, DI0 in bit 0, and the analog inputs, `None` where they can't be measured.
    pub fn set_inputs(&mut self, digital: u16, analog: impl Into<Option<Analog<AI>>>) {
        self.inputs = Some(digital);
        self.analog = analog.into();
    }

    /// What the digital outputs are to be, DO0 in bit 0.
    #[must_use]
    pub const fn digital_outputs(&self) -> u16 {
        self.outputs
    }
}

impl<const DI: u8, const DO: u8, const AI: usize> LocalUnit for InputsOutputs<DI, DO, AI> {
    // nothing is known yet: exception 04 instead of a value that nobody measured
    const NEW: Self = Self { inputs: None, outputs: 0, analog: None, is_changed: false };
    const KIND: LocalKind = LocalKind::Ndam;

    fn power_up(&mut self) {
        *self = Self::NEW;
    }

    fn dispatch<'o>(&mut self, request: &Request<'_>, out: &'o mut [u8]) -> Option<&'o [u8]> {
        ndam9010::dispatch(self, request, out).ok()
    }

    fn switch_off(&mut self) {
        self.outputs = 0;
        self.is_changed = true;
    }

    fn take_change(&mut self) -> bool {
        core::mem::take(&mut self.is_changed)
    }
}

impl<const DI: u8, const DO: u8, const AI: usize> Module for InputsOutputs<DI, DO, AI> {
    fn layout(&self) -> Layout {
        Self::LAYOUT
    }

    fn digital_inputs(&mut self) -> Result<u16, ChannelError> {
        self.inputs.ok_or(ChannelError::Failed)
    }

    fn digital_outputs(&mut self) -> Result<u16, ChannelError> {
        Ok(self.outputs)
    }

    fn set_digital_outputs(&mut self, mask: u16, value: u16) -> Result<(), ChannelError> {
        self.outputs = self.outputs & !mask | value & mask;
        self.is_changed = true;
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
