use super::boards::SimBoard;
use super::delay::Delay;
use super::moment::MICROS;
use jointbus_mcu_bridge::board::{Limits, Topology};

/// What is simulated. Which devices are on a bus follows from the routes that lead to it: NST sensors, or a station
/// with Modbus.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The board.
    pub board: SimBoard,
    /// Everything random follows from it.
    pub seed: u64,
    /// Ports and routes of the bridge.
    pub network: Topology,
    /// Its other limits.
    pub limits: Limits,
    /// NST sensors on each RS485 bus that speaks NST, at the addresses from 1.
    pub sensors: u8,
    /// NST sensors on each CAN bus, the nodes from 1.
    pub nodes: u8,
    /// Time from an interrupt until the main loop has taken notice.
    pub latency: Delay,
    /// Time from a request to the sensors' replies on RS485.
    pub sensor_delay: Delay,
    /// The same of a station's modules.
    pub station_delay: Delay,
    /// The same of the sensors on CAN.
    pub node_delay: Delay,
}

impl Settings {
    /// A board with its defaults, five sensors on each bus, or a station; all of them prompt.
    #[must_use]
    pub fn new(board: SimBoard, seed: u64) -> Self {
        Self {
            board,
            seed,
            network: Topology::of(board.description),
            limits: board.description.limits,
            sensors: 5,
            nodes: 5,
            latency: Delay::Uniform(2 * MICROS, 30 * MICROS),
            sensor_delay: Delay::PROMPT,
            station_delay: Delay::Uniform(300 * MICROS, 2000 * MICROS),
            node_delay: Delay::PROMPT,
        }
    }
}
