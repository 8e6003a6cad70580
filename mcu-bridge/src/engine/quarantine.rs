//! Devices that don't answer: after a few transactions in a row their requests are refused at once, but for a probe now
//! and then, so that they cost the others of their bus no time.

use crate::board::{Limits, Route};
use heapless::Vec;
use jointbus_protocol::time::Instant;

/// Devices whose last transaction was not answered; a bridge without more of them quarantines each one in time.
const TROUBLED: usize = 48;

#[derive(Debug, Clone, Copy)]
struct Device {
    unit: u8,
    /// Transactions in a row without an answer.
    unanswered: u8,
    /// When the next request is let through, once it is in quarantine.
    probe: Instant,
}

/// What is to become of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Admission {
    /// It goes its way.
    Normal,
    /// It is let through without retries.
    Probe,
    /// It is refused at once.
    Refused,
}

/// The devices that don't answer, by the unit that the host sees.
#[derive(Debug)]
pub(super) struct Quarantine(Vec<Device, TROUBLED>);

impl Quarantine {
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// A device has answered.
    pub(super) fn answered(&mut self, unit: u8) {
        self.release(unit, unit);
    }

    /// A transaction ended without an answer.
    pub(super) fn unanswered(&mut self, unit: u8, limits: &Limits, now: Instant) {
        let probe = now.saturating_add(limits.probe_period());
        if let Some(device) = self.0.iter_mut().find(|device| device.unit == unit) {
            device.unanswered = device.unanswered.saturating_add(1);
            if !device.is_quarantined(limits) || device.unanswered == limits.quarantine_after {
                device.probe = probe;
            }
        } else {
            // one that finds no room is asked as if it answered
            let _ = self.0.push(Device { unit, unanswered: 1, probe });
        }
    }

    /// Decides about a request; `waits` tells whether it has to wait for a late response.
    pub(super) fn admit(&mut self, unit: u8, waits: bool, limits: &Limits, now: Instant) -> Admission {
        match self.0.iter_mut().find(|device| device.unit == unit && device.is_quarantined(limits)) {
            None => Admission::Normal,
            Some(device) if waits || now < device.probe => Admission::Refused,
            Some(device) => {
                device.probe = now.saturating_add(limits.probe_period());
                Admission::Probe
            }
        }
    }

    /// The quarantined units of a route: bit 0 is its first unit, units past the sixteenth have none.
    pub(super) fn mask(&self, route: &Route, limits: &Limits) -> u16 {
        let quarantined =
            self.0.iter().filter(|device| route.serves(device.unit) && device.is_quarantined(limits));
        quarantined.fold(0, |mask, device| {
            mask | 1u16.checked_shl(device.unit.wrapping_sub(route.first_unit).into()).unwrap_or(0)
        })
    }

    /// Forgets the devices of a route that changes.
    pub(super) fn forget(&mut self, route: &Route) {
        if route.is_used() {
            self.release(route.first_unit, route.last_unit);
        }
    }

    /// Forgets the devices from one unit to another.
    fn release(&mut self, first: u8, last: u8) {
        self.0.retain(|device| !(first..=last).contains(&device.unit));
    }
}

impl Device {
    const fn is_quarantined(&self, limits: &Limits) -> bool {
        limits.quarantine_after > 0 && self.unanswered >= limits.quarantine_after
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Topology;
    use crate::boards::stm32f405::BOARD;

    fn at(millis: u64) -> Instant {
        Instant::from_micros(millis * 1000)
    }

    #[test]
    fn three_in_a_row_and_one_answer() {
        let (mut quarantine, limits, network) = (Quarantine::new(), Limits::default(), Topology::of(BOARD));
        let (_, route) = network.route(33).unwrap();
        for count in 1..=3 {
            assert_eq!(quarantine.admit(33, false, &limits, at(0)), Admission::Normal);
            quarantine.unanswered(33, &limits, at(0));
            assert_eq!(quarantine.mask(route, &limits), if count == 3 { 0b10 } else { 0 });
        }
        assert_eq!(quarantine.admit(32, false, &limits, at(0)), Admission::Normal);
        assert_eq!(quarantine.admit(33, false, &limits, at(999)), Admission::Refused);
        assert_eq!(
            quarantine.admit(33, true, &limits, at(1000)),
            Admission::Refused,
            "it would have to wait"
        );
        assert_eq!(quarantine.admit(33, false, &limits, at(1000)), Admission::Probe);
        quarantine.unanswered(33, &limits, at(1200));
        assert_eq!(quarantine.admit(33, false, &limits, at(1999)), Admission::Refused);
        assert_eq!(
            quarantine.admit(33, false, &limits, at(2000)),
            Admission::Probe,
            "one a second, no drift"
        );
        quarantine.answered(33);
        assert_eq!(quarantine.admit(33, false, &limits, at(2001)), Admission::Normal);
        assert_eq!(quarantine.mask(route, &limits), 0);
    }

    #[test]
    fn zero_means_never() {
        let (mut quarantine, mut limits) = (Quarantine::new(), Limits::default());
        limits.quarantine_after = 0;
        for _ in 0..300 {
            quarantine.unanswered(33, &limits, at(0));
        }
        assert_eq!(quarantine.admit(33, false, &limits, at(0)), Admission::Normal);
    }

    #[test]
    fn more_devices_than_there_is_room_for_go_their_way() {
        let (mut quarantine, limits) = (Quarantine::new(), Limits::default());
        for unit in 0..=u8::MAX {
            (0..3).for_each(|_| quarantine.unanswered(unit, &limits, at(0)));
        }
        assert_eq!(quarantine.admit(0, false, &limits, at(0)), Admission::Refused);
        assert_eq!(quarantine.admit(255, false, &limits, at(0)), Admission::Normal);
        quarantine.forget(&Route { first_unit: 1, last_unit: 254, ..Route::UNUSED });
        assert_eq!(quarantine.admit(1, false, &limits, at(0)), Admission::Normal);
    }
}
