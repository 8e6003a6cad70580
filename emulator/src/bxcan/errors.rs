//! Fault confinement of the transmitter: error counter, last error code, bus-off and the way out of it
//! (RM0090, 32.7.6).

use super::registers::{esr, ier};

/// Times that eleven recessive bits are seen before a node is back from bus-off.
const RECOVERY_SEQUENCES: u32 = 128;
const WARNING: u16 = 96;
const PASSIVE: u16 = 128;
const BUS_OFF: u16 = 256;

/// Values of LEC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LastError {
    None = 0,
    Acknowledgement = 3,
    BitDominant = 5,
}

#[derive(Debug, Clone, Copy)]
struct BusOff {
    sequences: u32,
    /// Initialisation mode was entered and left since.
    restarted: bool,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Errors {
    transmit: u16,
    last: u32,
    bus_off: Option<BusOff>,
}

impl Errors {
    pub(super) const fn is_bus_off(&self) -> bool {
        self.bus_off.is_some()
    }

    /// A frame has passed without error.
    pub(super) fn passed(&mut self, own: bool) {
        self.last = LastError::None as u32;
        if own {
            self.transmit = self.transmit.saturating_sub(1);
        }
    }

    /// An own frame has failed; whether that raises ERRI with these interrupts enabled.
    ///
    /// An error-passive node that is alone on the bus stays so: a missing acknowledgement no longer counts.
    pub(super) fn failed(&mut self, error: LastError, enabled: u32) -> bool {
        let before = self.transmit;
        if error != LastError::Acknowledgement || before < PASSIVE {
            self.transmit += 8;
        }
        self.last = error as u32;
        let crossed = |limit, interrupt| before < limit && self.transmit >= limit && enabled & interrupt != 0;
        let interrupt = enabled & ier::LECIE != 0
            || crossed(WARNING, ier::EWGIE)
            || crossed(PASSIVE, ier::EPVIE)
            || crossed(BUS_OFF, ier::BOFIE);
        if self.transmit >= BUS_OFF {
            self.bus_off = Some(BusOff { sequences: 0, restarted: false });
        }
        interrupt
    }

    /// Initialisation mode has been left: a node that is bus-off may now recover.
    pub(super) fn restart(&mut self) {
        if let Some(bus_off) = &mut self.bus_off {
            *bus_off = BusOff { sequences: 0, restarted: true };
        }
    }

    pub(super) fn recovers(&self, automatic: bool) -> bool {
        self.bus_off.is_some_and(|bus_off| automatic || bus_off.restarted)
    }

    /// Eleven recessive bits have been seen.
    pub(super) fn recessive_sequence(&mut self, automatic: bool) {
        if !self.recovers(automatic) {
            return;
        }
        if let Some(bus_off) = &mut self.bus_off {
            bus_off.sequences += 1;
            if bus_off.sequences >= RECOVERY_SEQUENCES {
                self.bus_off = None;
                self.transmit = 0;
            }
        }
    }

    pub(super) fn read(&self) -> u32 {
        let flag = |is_set, flag| if is_set { flag } else { 0 };
        u32::from(self.transmit.min(255)) << esr::TEC
            | self.last << esr::LEC
            | flag(self.is_bus_off(), esr::BOFF)
            | flag(self.transmit >= PASSIVE, esr::EPVF)
            | flag(self.transmit >= WARNING, esr::EWGF)
    }

    pub(super) fn write(&mut self, value: u32) {
        self.last = value >> esr::LEC & 0b111;
    }
}
