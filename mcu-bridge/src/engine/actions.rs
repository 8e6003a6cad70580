//! What the engine asks of the firmware.

use crate::board::Port;

/// Something that the firmware is to do, once, in the order in which [`Engine::poll`](super::bridge::Engine::poll) tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use]
pub enum Action {
    /// The board's own outputs were written: drive them as [`Engine::units`](super::bridge::Engine::units) says.
    Outputs,
    /// Give up the frames that a CAN port has not sent; [`Engine::frames_aborted`](super::bridge::Engine::frames_aborted)
    /// tells when none is left.
    AbortCan(Port),
    /// Restart the controller of a CAN port, which is bus-off.
    RestartCan(Port),
    /// Set up a port as [`Engine::port`](super::bridge::Engine::port) says.
    Configure(Port),
    /// Store what [`Engine::encode_settings`](super::bridge::Engine::encode_settings) writes;
    /// [`Engine::saved`](super::bridge::Engine::saved) tells how that ended.
    Store,
    /// Restart, after [`Engine::output`](super::bridge::Engine::output) of the host's port has been sent.
    Reboot,
}

/// Ports, a bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Ports(u8);

impl Ports {
    const NONE: Self = Self(0);

    fn insert(&mut self, port: Port) {
        self.0 |= 1u8.checked_shl(port.number().into()).unwrap_or(0);
    }

    /// Takes the first one out.
    fn take_first(&mut self) -> Option<Port> {
        let first = self.0.trailing_zeros() as u8;
        self.0 &= self.0.wrapping_sub(1);
        (first < u8::BITS as u8).then(|| Port::new(first))
    }
}

/// Actions that the firmware has not been told.
#[derive(Debug)]
pub(super) struct Pending {
    abort: Ports,
    restart: Ports,
    configure: Ports,
    outputs: bool,
    store: bool,
    reboot: bool,
    /// There is any.
    any: bool,
}

impl Pending {
    pub(super) const NONE: Self = Self {
        abort: Ports::NONE,
        restart: Ports::NONE,
        configure: Ports::NONE,
        outputs: false,
        store: false,
        reboot: false,
        any: false,
    };

    pub(super) fn push(&mut self, action: Action) {
        self.any = true;
        match action {
            Action::Outputs => self.outputs = true,
            Action::AbortCan(port) => self.abort.insert(port),
            Action::RestartCan(port) => self.restart.insert(port),
            Action::Configure(port) => self.configure.insert(port),
            Action::Store => self.store = true,
            Action::Reboot => self.reboot = true,
        }
    }

    pub(super) const fn is_empty(&self) -> bool {
        !self.any
    }

    /// The next one: outputs first, what ends the work last.
    pub(super) fn pop(&mut self) -> Option<Action> {
        if !self.any {
            return None;
        }
        let next = if core::mem::take(&mut self.outputs) {
            Some(Action::Outputs)
        } else if let Some(port) = self.abort.take_first() {
            Some(Action::AbortCan(port))
        } else if let Some(port) = self.restart.take_first() {
            Some(Action::RestartCan(port))
        } else if let Some(port) = self.configure.take_first() {
            Some(Action::Configure(port))
        } else if core::mem::take(&mut self.store) {
            Some(Action::Store)
        } else if core::mem::take(&mut self.reboot) {
            Some(Action::Reboot)
        } else {
            None
        };
        self.any = next.is_some();
        next
    }

    /// Forgets that ports are to be set up.
    pub(super) fn clear_configure(&mut self) {
        self.configure = Ports::NONE;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_action_is_told_once_and_what_ends_the_work_last() {
        let mut pending = Pending::NONE;
        let expected = [
            Action::Outputs,
            Action::AbortCan(Port::new(4)),
            Action::AbortCan(Port::new(5)),
            Action::RestartCan(Port::new(4)),
            Action::Configure(Port::HOST),
            Action::Configure(Port::new(5)),
            Action::Store,
            Action::Reboot,
        ];
        expected.iter().rev().chain(&expected).for_each(|action| pending.push(*action));
        assert!(expected.iter().all(|action| pending.pop() == Some(*action)));
        assert_eq!(pending.pop(), None);
    }
}
