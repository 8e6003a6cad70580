//! The dispatchers of the three devices.

use core::convert::Infallible;

use jointbus_protocol::ndam9010::{Layout, RamModule, Station};
use jointbus_protocol::nst::{Daq, RamHardware, SignEncoding};
use jointbus_protocol::nxi6201::{Card, Hardware, Settings};

use crate::{FRAME_MAX, Kind, Subject};

/// An NST sensor on a serial line.
pub struct Nst(Daq<RamHardware>);

impl Subject for Nst {
    const KIND: Kind = Kind::Nst;

    fn new() -> Self {
        Self(Daq::new(RamHardware::new(1), SignEncoding::TwosComplement))
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        self.0.serve_serial(frame, out).map_or(0, <[u8]>::len)
    }
}

/// Outputs that go nowhere.
pub struct Outputs;

impl Hardware for Outputs {
    type Error = Infallible;

    fn commit(&mut self, settings: &Settings) -> Result<(), Infallible> {
        core::hint::black_box(settings);
        Ok(())
    }
}

/// An NXI-6201.
pub struct Nxi(Card<Outputs>);

impl Subject for Nxi {
    const KIND: Kind = Kind::Nxi;

    fn new() -> Self {
        let Ok(card) = Card::power_up(Outputs, &Settings::default());
        Self(card)
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        self.0.serve(1, frame, out).map_or(0, <[u8]>::len)
    }
}

/// A station of one NDAM module with eight analog inputs.
pub struct Ndam(Station<RamModule, 1>);

impl Subject for Ndam {
    const KIND: Kind = Kind::Ndam;

    fn new() -> Self {
        let layout = Layout { digital_inputs: 8, digital_outputs: 8, analog_inputs: 8, analog_outputs: 4 };
        Self(Station::new([RamModule::new(layout)], 1).expect("one module, unit 1"))
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        self.0.serve(frame, out).map_or(0, <[u8]>::len)
    }
}
