//! The dispatchers of the three devices.

use core::convert::Infallible;

use jointbus_protocol::ndam9010::{Layout, RamModule, Station};
use jointbus_protocol::nst::{Daq, RamHardware, SignEncoding};
use jointbus_protocol::nxi6201::{Card, Hardware, Settings};

use crate::{FRAME_MAX, Request, Subject};

/// An NST sensor on a serial line.
pub struct Nst(Daq<RamHardware>);

impl Subject for Nst {
    const REQUESTS: &'static [Request] = &[Request::new("read of six axes", &[1, 0x03, 0x02, 0x00, 0x12])];

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
    const REQUESTS: &'static [Request] =
        &[Request::new("write of one value", &[1, 0x10, 0, 4, 0, 2, 4, 0, 0, 0x40, 0x20])];

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
    const REQUESTS: &'static [Request] = &[Request::new("read of 8 AI", &[1, 0x04, 0, 0x40, 0, 8])];

    fn new() -> Self {
        let layout = Layout { digital_inputs: 8, digital_outputs: 8, analog_inputs: 8, analog_outputs: 4 };
        Self(Station::new([RamModule::new(layout)], 1).expect("one module, unit 1"))
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        self.0.serve(frame, out).map_or(0, <[u8]>::len)
    }
}
