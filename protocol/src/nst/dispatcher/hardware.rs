use crate::nst::settings::{ActiveSettings, Settings};
use crate::nst::{Sample, StoreError};

/// What a DAQ firmware puts behind its dispatcher.
pub trait Hardware {
    /// The present sample before zero points: mN and mN.m, or uV.
    fn sample(&mut self) -> Sample;

    /// The registers 0x0000 to 0x01FF as stored: [`Settings::decode`] makes them of the bytes of a store.
    fn settings(&self) -> &Settings;

    /// Stores them; called once a request, with all of it.
    ///
    /// # Errors
    /// [`StoreError`], and the former ones stay.
    fn store(&mut self, settings: &Settings) -> Result<(), StoreError>;

    /// The device has restarted, by function code 0x18 (4.3.1.11) or [`Daq::restart`](super::Daq::restart), and these
    /// settings are in use from now on; called once a restart, not at power-up.
    ///
    /// The acknowledgement of the request is still to be sent, at the former rate: ports change theirs, or the whole
    /// board restarts, when it is out.
    fn restart(&mut self, active: &ActiveSettings);
}

/// [`Hardware`] in memory, for tests and simulators.
#[derive(Debug, Clone)]
pub struct RamHardware {
    /// What [`Hardware::sample`] returns.
    pub sample: Sample,
    /// The registers 0x0000 to 0x01FF.
    pub settings: Settings,
    /// How often the device has restarted.
    pub restarts: u32,
}

impl RamHardware {
    /// A device with the factory's settings but for its address; an address that no device can have is not taken.
    #[must_use]
    pub fn new(address: u8) -> Self {
        let mut settings = Settings::FACTORY;
        let _ = settings.set_address(address);
        Self { sample: Sample::default(), settings, restarts: 0 }
    }
}

impl Hardware for RamHardware {
    fn sample(&mut self) -> Sample {
        self.sample
    }

    fn settings(&self) -> &Settings {
        &self.settings
    }

    fn store(&mut self, settings: &Settings) -> Result<(), StoreError> {
        self.settings = *settings;
        Ok(())
    }

    fn restart(&mut self, _: &ActiveSettings) {
        self.restarts = self.restarts.saturating_add(1);
    }
}
