use super::{Log, Motion, Order};
use jointbus_protocol::nst::register;
use jointbus_protocol::nst::{
    Channel, Daq, NoResponse, RamHardware, Request, SAMPLE_LENGTH, Sample, SignEncoding,
};
use jointbus_protocol::time::Instant;

/// Which of its ports a sensor uses, as its channel register (4.1.10) says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wiring {
    /// CAN.
    Can,
    /// RS485.
    Rs485,
}

/// One NST sensor: the protocol crate's dispatcher over registers in memory, moving by its [`Motion`].
#[derive(Debug)]
pub struct Sensor {
    daq: Daq<RamHardware>,
    motion: Motion,
    plugged: bool,
    told: Log<Sample>,
    silences: Log<NoResponse>,
    orders: Log<Order>,
}

impl Sensor {
    /// A sensor at `address` (its node on CAN), plugged in.
    #[must_use]
    pub fn new(address: u8, wiring: Wiring, motion: Motion) -> Self {
        let mut hardware = RamHardware::new(address);
        let serial_number = format!("SIM{address:010}");
        let settings = &mut hardware.settings;
        settings.set_serial_number(text(serial_number.as_bytes()));
        settings.set_model(text(b"NST-SIM"));
        settings.set_channel(match wiring {
            Wiring::Can => Channel::Can,
            Wiring::Rs485 => Channel::Rs485,
        });
        Self {
            daq: Daq::new(hardware, SignEncoding::TwosComplement),
            motion,
            plugged: true,
            told: Log::default(),
            silences: Log::default(),
            orders: Log::default(),
        }
    }

    /// The address in use.
    #[must_use]
    pub const fn address(&self) -> u8 {
        self.daq.address()
    }

    /// What moves it.
    #[must_use]
    pub const fn motion(&self) -> Motion {
        self.motion
    }

    /// The dispatcher and its registers.
    pub const fn daq(&mut self) -> &mut Daq<RamHardware> {
        &mut self.daq
    }

    /// Takes the plug out (`false`): the sensor hears nothing; or puts it in again.
    pub const fn set_plugged(&mut self, plugged: bool) {
        self.plugged = plugged;
    }

    /// Whether it is plugged in.
    #[must_use]
    pub const fn is_plugged(&self) -> bool {
        self.plugged
    }

    /// The samples that it sent: those of reads that took in all six axes.
    #[must_use]
    pub const fn told(&self) -> &Log<Sample> {
        &self.told
    }

    /// What it did not answer, and why; requests to others on its line included.
    #[must_use]
    pub const fn silences(&self) -> &Log<NoResponse> {
        &self.silences
    }

    /// The writes and commands that it carried out.
    #[must_use]
    pub const fn orders(&self) -> &Log<Order> {
        &self.orders
    }

    /// Answers the request with this body through `serve`, which picks the form.
    pub(super) fn answer<R>(
        &mut self,
        body: &[u8],
        now: Instant,
        serve: impl FnOnce(&mut Daq<RamHardware>) -> Result<R, NoResponse>,
    ) -> Option<R> {
        if !self.plugged {
            return None;
        }
        self.daq.hardware().sample = self.motion.sample(now);
        let result = serve(&mut self.daq);
        if matches!(result, Ok(_) | Err(NoResponse::Broadcast(None)))
            && let Ok(request) = Request::decode(body)
        {
            if reads_all_axes(&request) {
                let sample = self.daq.sample();
                self.told.push(now, sample);
            }
            if let Some(order) = Order::of_nst(&request) {
                self.orders.push(now, order);
            }
        }
        match result {
            Ok(reply) => Some(reply),
            Err(silence) => {
                self.silences.push(now, silence);
                None
            }
        }
    }
}

/// Whether the answer has all six axes in it.
fn reads_all_axes(request: &Request<'_>) -> bool {
    let first = usize::from(request.register());
    let data = usize::from(register::DATA.first);
    request.function().is_read()
        && first <= data
        && first + usize::from(request.length()) >= data + SAMPLE_LENGTH
}

/// As many characters as there are, and zeros behind them.
fn text(characters: &[u8]) -> [u8; 16] {
    let mut text = [0; 16];
    text.iter_mut().zip(characters).for_each(|(place, character)| *place = *character);
    text
}
