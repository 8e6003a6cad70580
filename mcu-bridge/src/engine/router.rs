//! The routing table as it is looked through: six rows at once.

use crate::board::{ROUTES, Route, Topology};

/// Rows in a word: each takes nine bits, a byte and the carry of what is added to it.
const ROWS: usize = 3;
const ROW_BITS: u32 = u8::BITS + 1;

/// 1 in every row, and its carry.
const ONES: u32 = 1 | 1 << ROW_BITS | 1 << (2 * ROW_BITS);
const CARRIES: u32 = ONES << u8::BITS;

/// Rows in two groups, which are looked through in one step.
const PAIR: usize = 2 * ROWS;

/// A whole number of pairs.
const GROUPS: usize = 2 * ROUTES.div_ceil(PAIR);

/// Three rows.
#[derive(Debug, Clone, Copy)]
struct Group {
    /// A carry less the first unit: a unit added to it leaves the carry where it is not before the first.
    from: u32,
    /// A carry and the last unit: a unit taken from it leaves the carry where it is not behind the last.
    to: u32,
}

impl Group {
    /// The carries of the rows that serve a unit, given in every row.
    const fn serve(self, units: u32) -> u32 {
        self.from.wrapping_add(units) & self.to.wrapping_sub(units) & CARRIES
    }
}

/// Finds the row of a unit in a [`Topology`] in about the same time wherever it stands: the first that serves it.
#[derive(Debug, Clone)]
pub struct Router([Group; GROUPS]);

impl Router {
    /// One that finds nothing, in zeros.
    pub(super) const ZERO: Self = Self([Group { from: 0, to: 0 }; GROUPS]);

    /// For the rows of a topology.
    #[must_use]
    pub fn new(topology: &Topology) -> Self {
        let mut router = Self::ZERO;
        router.learn(topology);
        router
    }

    /// Forgets the former rows.
    pub(super) fn learn(&mut self, topology: &Topology) {
        let mut rows = topology.routes.iter();
        for group in &mut self.0 {
            // a row that is not used serves no unit, and lends its neighbour nothing
            *group = Group { from: 0, to: CARRIES };
            for shift in [0, ROW_BITS, 2 * ROW_BITS] {
                if let Some(row) = rows.next().filter(|row| row.is_used()) {
                    group.from |= (1u32 << u8::BITS).wrapping_sub(row.first_unit.into()) << shift;
                    group.to |= u32::from(row.last_unit) << shift;
                }
            }
        }
    }

    /// Number of the row of a unit.
    #[must_use]
    pub fn row(&self, unit: u8) -> Option<u8> {
        let units = ONES.wrapping_mul(unit.into());
        let mut row = 0u8;
        for [first, second] in self.0.as_chunks().0 {
            let (first, second) = (first.serve(units), second.serve(units));
            if first | second != 0 {
                let (found, row) =
                    if first != 0 { (first, row) } else { (second, row.wrapping_add(ROWS as u8)) };
                // the carry of a row is its last bit
                return Some(row.wrapping_add((found.trailing_zeros() / ROW_BITS) as u8));
            }
            row = row.wrapping_add(PAIR as u8);
        }
        None
    }
}

/// The routes in force, and how they are found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Routes<'a> {
    pub(super) router: &'a Router,
    pub(super) topology: &'a Topology,
}

impl<'a> Routes<'a> {
    /// The route of a unit, and its number.
    pub(super) fn find(self, unit: u8) -> Option<(u8, &'a Route)> {
        let number = self.router.row(unit)?;
        self.topology.routes.get(usize::from(number)).map(|route| (number, route))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::boards::stm32f405::BOARD;

    fn agree(topology: &Topology) {
        let router = Router::new(topology);
        for unit in 0..u8::MAX {
            assert_eq!(
                router.row(unit),
                topology.route(unit).map(|(row, _)| row),
                "unit {unit} of {topology:?}"
            );
        }
    }

    #[test]
    fn every_unit_is_found_in_the_first_row_that_serves_it() {
        agree(&Topology::of(BOARD));
        let unused = Topology { routes: [Route::UNUSED; ROUTES], ..Topology::of(BOARD) };
        agree(&unused);
        // any first and last units, in any order and overlapping
        let mut random = 1u32;
        let mut unit = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 24) as u8
        };
        for _ in 0..2000 {
            let mut topology = unused;
            for row in &mut topology.routes {
                (row.first_unit, row.last_unit) = match unit() % 4 {
                    0 => (0, 0),
                    1 => (unit(), unit()),
                    2 => (unit(), u8::MAX - 1),
                    _ => {
                        let first = unit();
                        (first, first.saturating_add(unit() % 16))
                    }
                };
            }
            agree(&topology);
        }
    }
}
