//! The bridge's routing table, asked for the unit that stands last in it.

use jointbus_mcu_bridge::board::{ROUTES, Route, Target, Topology};
use jointbus_mcu_bridge::boards::stm32f405::BOARD;
use jointbus_mcu_bridge::engine::router::Router;

use crate::{FRAME_MAX, Kind, Subject};

/// A table with as many routes, each for one unit: the unit asked for is in the last.
pub struct Routes<const COUNT: usize>(Router);

/// The unit that is asked for.
const UNIT: u8 = ROUTES as u8;

impl<const COUNT: usize> Subject for Routes<COUNT> {
    const KIND: Kind = Kind::Routes;

    fn new() -> Self {
        let mut network = Topology { routes: [Route::UNUSED; ROUTES], ..Topology::of(BOARD) };
        let units = (1..=UNIT).rev().take(COUNT).rev();
        for (row, unit) in network.routes.iter_mut().zip(units) {
            *row = Route { first_unit: unit, last_unit: unit, target: Target::Bridge, ..Route::UNUSED };
        }
        Self(Router::new(&network))
    }

    fn serve(&mut self, frame: &[u8], _: &mut [u8; FRAME_MAX]) -> usize {
        let row = frame.first().and_then(|unit| self.0.row(*unit));
        usize::from(row.is_some_and(|row| usize::from(row) == COUNT - 1))
    }
}
