//! A bridge with simulated devices on all its buses, set up so that a slow machine decides no result.
//!
//! | host's unit | device |
//! |---|---|
//! | [`CAN_UNIT`] | NST sensor on CAN, node 1 |
//! | [`RS485_A_UNIT`] | NST sensor on the first RS485 line, address 1 |
//! | [`OUTPUTS_UNIT`] | the board's own outputs, an NXI-6201 |
//! | [`RS485_B_UNIT`] | NDAM station on the second RS485 line, start ID 1, one module ([`LAYOUT`]) |
//! | 247 | the bridge itself ([`bridge`]) |

use crate::bridge::{self, Limits};
use crate::client::{self, Client};
use crate::clock::Clock;
use crate::devices::attach::{self, Attached};
use crate::devices::{Motion, NdamLine, NstCan, NstSerial, PATIENT, Sensor, Wiring};
#[cfg(unix)]
use crate::emulator::{self, Emulator};
use crate::in_process::InProcess;
use crate::share::Share;
use anyhow::{Context, Result, anyhow};
use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{CAN, RS485_A, RS485_B};
use jointbus_protocol::ndam9010::Layout;
use std::net::TcpStream;
use std::time::Duration;

/// Unit of the sensor on CAN.
pub const CAN_UNIT: u8 = 1;
/// Unit of the sensor on the first RS485 line.
pub const RS485_A_UNIT: u8 = 16;
/// Unit of the board's own outputs.
pub const OUTPUTS_UNIT: u8 = 31;
/// Unit of the station's module on the second RS485 line.
pub const RS485_B_UNIT: u8 = 32;

/// Channels of the station's module.
pub const LAYOUT: Layout =
    Layout { digital_inputs: 14, digital_outputs: 8, analog_inputs: 8, analog_outputs: 4 };

/// Environment variable that tells tests where the firmware is, as an ELF file.
pub const IMAGE: &str = "JOINTBUS_IMAGE";
/// Environment variable that tells tests where the emulator's plugin is.
pub const PLUGIN: &str = "JOINTBUS_EMULATOR_PLUGIN";

/// Time that a bridge has to answer for the first time.
pub const START: Duration = Duration::from_secs(120);

/// Time between two questions to a bridge that does not answer yet.
const ASK_AGAIN: Duration = Duration::from_millis(500);

/// What the devices are attached to.
#[derive(Debug)]
pub enum Bridge {
    /// The firmware's image in QEMU.
    #[cfg(unix)]
    Emulated(Box<Emulator>),
    /// The engine in this process.
    InProcess(InProcess),
}

impl Bridge {
    /// Connects to a port.
    ///
    /// # Errors
    /// Where the bridge has ended.
    pub fn connect(&self, port: Port) -> Result<TcpStream> {
        match self {
            #[cfg(unix)]
            Self::Emulated(emulator) => emulator.connect(match port {
                Port::HOST => emulator::Port::Usart1,
                RS485_A => emulator::Port::Usart2,
                RS485_B => emulator::Port::Usart3,
                CAN => emulator::Port::Can,
                _ => anyhow::bail!("the emulated board does not have {port:?}"),
            }),
            Self::InProcess(engine) => engine.connect(port),
        }
    }

    /// Whether it still runs.
    ///
    /// # Errors
    /// Where the emulator has ended, with what it said.
    pub fn check(&mut self) -> Result<()> {
        match self {
            #[cfg(unix)]
            Self::Emulated(emulator) => emulator.check(),
            Self::InProcess(_) => Ok(()),
        }
    }
}

/// A bridge and its devices. Dropping it ends all of it.
#[derive(Debug)]
pub struct Bench {
    /// Sensors on CAN.
    pub can: Attached<NstCan>,
    /// Sensors on the first RS485 line.
    pub rs485_a: Attached<NstSerial>,
    /// The station on the second RS485 line.
    pub rs485_b: Attached<NdamLine<1>>,
    /// The bridge.
    pub bridge: Bridge,
    clock: Clock,
    host: TcpStream,
    limits: Limits,
}

impl Bench {
    /// The image in QEMU, as the options say.
    ///
    /// # Errors
    /// Where QEMU does not start or the image does not answer.
    #[cfg(unix)]
    pub fn emulated(options: &emulator::Options) -> Result<Self> {
        let emulator = Emulator::launch(options)?;
        Self::with(Bridge::Emulated(Box::new(emulator)), Clock::default())
    }

    /// The image and the plugin that the environment names ([`IMAGE`], [`PLUGIN`]) in QEMU.
    ///
    /// # Errors
    /// Where a name is missing, and as [`Self::emulated`].
    #[cfg(unix)]
    pub fn from_environment() -> Result<Self> {
        let path = |name: &str| {
            std::env::var_os(name).with_context(|| format!("{name} is not set; `cargo xtask test` sets it"))
        };
        Self::emulated(&emulator::Options::new(path(IMAGE)?, path(PLUGIN)?))
    }

    /// The engine in this process.
    ///
    /// # Errors
    /// Where there are no free ports or no threads.
    pub fn in_process() -> Result<Self> {
        let clock = Clock::default();
        Self::with(Bridge::InProcess(InProcess::start(clock)?), clock)
    }

    /// Attaches the devices to a bridge, waits for it and sets its limits to [`Limits::GENEROUS`].
    ///
    /// # Errors
    /// Where the bridge does not answer, or refuses the limits.
    pub fn with(mut bridge: Bridge, clock: Clock) -> Result<Self> {
        let station =
            NdamLine::new(LAYOUT, 1, PATIENT).map_err(|error| anyhow!("no such station: {error:?}"))?;
        // motions are numbered by the host's units, so that no sensor can be mistaken for another
        let on_can = Sensor::new(1, Wiring::Can, Motion::new(CAN_UNIT));
        let on_rs485_a = Sensor::new(1, Wiring::Rs485, Motion::new(RS485_A_UNIT));
        let can = attach::can(bridge.connect(CAN)?, NstCan::new(PATIENT).with(on_can), clock)?;
        let sensors = NstSerial::new(PATIENT).with(on_rs485_a);
        let rs485_a = attach::serial(bridge.connect(RS485_A)?, sensors, clock)?;
        let rs485_b = attach::serial(bridge.connect(RS485_B)?, station, clock)?;
        let host = bridge.connect(Port::HOST)?;
        client::prepare(&host)?;
        let mut asking = Client::new(host.try_clone()?, ASK_AGAIN);
        let started = bridge::wait(&mut asking, START);
        bridge.check()?;
        started.context("the bridge does not answer")?;
        let mut bench = Self { can, rs485_a, rs485_b, bridge, clock, host, limits: Limits::GENEROUS };
        bench.set_limits(&Limits::GENEROUS)?;
        Ok(bench)
    }

    /// The emulator, where there is one: for faults and resets.
    #[cfg(unix)]
    pub fn emulator(&mut self) -> Option<&mut Emulator> {
        match &mut self.bridge {
            Bridge::Emulated(emulator) => Some(emulator),
            Bridge::InProcess(_) => None,
        }
    }

    /// The clock of the devices, and of the bridge where it runs in this process.
    #[must_use]
    pub const fn clock(&self) -> Clock {
        self.clock
    }

    /// A client on the host port, with a timeout that only a dead bridge reaches. One at a time: all of them, and
    /// [`Bench::share`], are on the same connection.
    ///
    /// # Errors
    /// Where the operating system has no more sockets.
    pub fn client(&self) -> Result<Client<TcpStream>> {
        client::prepare(&self.host)?;
        Ok(Client::new(self.host.try_clone()?, self.patience()))
    }

    /// Shares the host port from now on.
    ///
    /// # Errors
    /// Where the operating system has no more sockets or threads.
    pub fn share(&self) -> Result<Share> {
        let attempts = Limits { time_to_live_ms: 0, ..self.limits }.longest();
        Ok(Share::start(self.host.try_clone()?, attempts + Duration::from_secs(1))?)
    }

    /// Time after which a question has no answer any more.
    #[must_use]
    pub fn patience(&self) -> Duration {
        self.limits.longest() + Duration::from_secs(60)
    }

    /// Puts other limits into force.
    ///
    /// # Errors
    /// Where the bridge refuses them.
    pub fn set_limits(&mut self, limits: &Limits) -> Result<()> {
        let patience = self.patience();
        let mut client = self.client()?;
        client.set_timeout(patience);
        bridge::set_limits(&mut client, limits).context("the bridge does not take the time limits")?;
        self.limits = *limits;
        Ok(())
    }
}
