//! Ports and routes that change, and what their buses do then.

use super::actions::Action;
use super::core::{Change, Core, Shared};
use crate::board::{Board, Description, LocalUnits, PORTS_MAX};
use jointbus_protocol::time::{Duration, Instant};

impl<B: Board, const SERIAL: usize, const CAN: usize> Core<B, SERIAL, CAN> {
    /// Makes the change that a request has asked for. Here and not where it was asked for, so that it is answered first.
    pub(super) fn make_change(&mut self, now: Instant) {
        let change = core::mem::replace(&mut self.shared.change, Change::None);
        self.change(change, now);
    }

    /// Returns to the confirmed configuration where the applied one was not confirmed in time.
    pub(super) fn roll_back(&mut self, now: Instant) {
        if self.shared.confirm_until.is_some_and(|end| now >= end) {
            self.shared.confirm_until = None;
            self.change(Change::RollBack, now);
        }
    }

    /// Switches the board's own outputs off when the host was silent for too long; only the host switches on again.
    pub(super) fn host_silence(&mut self, now: Instant) {
        let limit = self.shared.host_silence_limit();
        if limit > Duration::ZERO
            && self.shared.last_request.is_some_and(|last| now.saturating_duration_since(last) >= limit)
        {
            self.shared.last_request = None;
            self.units.switch_off();
            if self.units.take_change() {
                self.shared.actions.push(Action::Outputs);
            }
        }
    }

    /// Changes ports and routes, dropping what waits or is in flight where something changed.
    pub(super) fn change(&mut self, change: Change, now: Instant) {
        match change {
            Change::None => return,
            Change::Apply => {}
            Change::RollBack => self.shared.settings.topology = self.shared.confirmed,
        }
        let moved = self.shared.go_live(B::DESCRIPTION);
        for port in B::DESCRIPTION.ports().filter(|port| moved.get(port.index()) == Some(&true)) {
            if let Some((bus, mut cx)) = self.serial(port) {
                bus.reset(now, &mut cx);
            } else if let Some((bus, mut cx)) = self.can(port) {
                bus.reset(&mut cx);
            }
        }
    }
}

impl Shared {
    /// Makes the staged ports and routes live; tells which ports something changed for.
    fn go_live(&mut self, board: &Description) -> [bool; PORTS_MAX] {
        let (live, next) = (&mut self.live, &self.settings.topology);
        let mut moved = [false; PORTS_MAX];
        for (old, new) in live.routes.iter().zip(&next.routes).filter(|(old, new)| old != new) {
            for row in [old, new].into_iter().filter(|row| row.is_used()) {
                self.quarantine.forget(row);
                if let Some(moved) = row.target.port().and_then(|port| moved.get_mut(port.index())) {
                    *moved = true;
                }
            }
        }
        for port in board.ports() {
            let index = port.index();
            if live.ports.get(index) != next.ports.get(index)
                && let Some(moved) = moved.get_mut(index)
            {
                *moved = true;
                self.actions.push(Action::Configure(port));
            }
        }
        *live = *next;
        self.router.learn(live);
        moved
    }
}
