use super::delay::Delay;
use super::moment::MICROS;
use jointbus_mcu_bridge::board::{Limits, Topology};
use jointbus_mcu_bridge::boards::stm32f405::BOARD;

/// What is simulated.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Everything random follows from it.
    pub seed: u64,
    /// Ports and routes of the bridge.
    pub network: Topology,
    /// Its other limits.
    pub limits: Limits,
    /// NST sensors on the first RS485 line, at the addresses from 1.
    pub sensors: u8,
    /// NST sensors on CAN, the nodes from 1.
    pub nodes: u8,
    /// Time from an interrupt until the main loop has taken notice.
    pub latency: Delay,
    /// Time from a request to the sensors' replies on RS485.
    pub sensor_delay: Delay,
    /// The same of the station's modules.
    pub station_delay: Delay,
    /// The same of the sensors on CAN.
    pub node_delay: Delay,
}

impl Settings {
    /// The default bridge, five sensors on each bus, a station; all of them prompt.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self {
            seed,
            network: Topology::of(BOARD),
            limits: Limits::default(),
            sensors: 5,
            nodes: 5,
            latency: Delay::Uniform(2 * MICROS, 30 * MICROS),
            sensor_delay: Delay::PROMPT,
            station_delay: Delay::Uniform(300 * MICROS, 2000 * MICROS),
            node_delay: Delay::PROMPT,
        }
    }
}
