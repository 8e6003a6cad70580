//! Ports and routes that change, and what their buses do then.

use super::actions::Action;
use super::core::{Core, Shared};
use crate::board::{Board, Description, LocalUnits, PORTS_MAX};
use jointbus_protocol::time::{Duration, Instant};

impl<B: Board, const SERIAL: usize, const CAN: usize> Core<B, SERIAL, CAN> {
    /// Applies what is staged, where a request has asked for it. Here and not where it was asked for, so that it is
    /// answered first.
    pub(super) fn apply_asked(&mut self, now: Instant) {
        if core::mem::take(&mut self.shared.apply) {
            self.apply(now);
        }
    }

    /// Returns to the confirmed configuration where the applied one was not confirmed in time.
    pub(super) fn roll_back(&mut self, now: Instant) {
        if self.shared.confirm_until.is_some_and(|end| now >= end) {
            self.shared.confirm_until = None;
            self.shared.settings.topology = self.shared.confirmed;
            self.apply(now);
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

    /// Makes the staged ports and routes live, dropping what waits or is in flight where something changed.
    pub(super) fn apply(&mut self, now: Instant) {
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
