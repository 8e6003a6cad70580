//! A board as a value: its ports, its own units, where routes can lead, and its defaults.
//!
//! The engine, the register map, the simulation and the host's tools follow a [`Description`]; nothing else knows how
//! many ports there are. A new board is one file with one [`Board`].

mod description;
mod limits;
mod local;
mod port;
mod route;
mod topology;

pub use description::{Board, Description, Identification, PortDescription, TARGETS_MAX};
pub use limits::Limits;
pub use local::{Analog, InputsOutputs, LocalKind, LocalUnit, LocalUnits, Outputs};
pub use port::{PORTS_MAX, Parity, Port, PortConfig, PortKind, UartClock};
pub use route::{Protocol, ROUTES, Route, Target};
pub use topology::Topology;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::boards::stm32f405::{BOARD, CAN, RS485_A, RS485_B};

    #[test]
    fn targets_are_numbered_buses_first_and_the_bridge_last() {
        let expected = [
            Target::Bus(RS485_A),
            Target::Bus(RS485_B),
            Target::Bus(CAN),
            Target::Local(0),
            Target::Local(1),
            Target::Bridge,
        ];
        for (number, target) in (1..).zip(expected) {
            assert_eq!((BOARD.target(number), BOARD.target_number(target)), (Some(target), number));
        }
        assert_eq!((BOARD.target(0), BOARD.target(7), BOARD.targets()), (None, None, 6));
    }

    #[test]
    fn a_description_that_the_engine_cannot_serve_is_told() {
        assert!(BOARD.is_sound());
        let [host, rs485, .., can] = BOARD.ports else { panic!("four ports") };
        let disordered = [*host, *can, *rs485];
        assert!(!Description { ports: disordered.to_vec().leak(), ..*BOARD }.is_sound());
        assert!(!Description { ports: &[], ..*BOARD }.is_sound());
        assert!(!Description { ports: std::vec![*host; 7].leak(), ..*BOARD }.is_sound());
        assert!(!Description { ports: std::vec![*can].leak(), ..*BOARD }.is_sound());
    }
}
