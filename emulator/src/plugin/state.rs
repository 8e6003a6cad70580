//! The state that changes while the machine runs, and the news of it for QEMU.

use super::complain;
use super::peripherals::{SerialEffects, SerialState};
use crate::board::Board;
use crate::flash;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::{Mutex, MutexGuard};

static STATE: Mutex<Option<State>> = Mutex::new(None);

/// The state that changes while the machine runs.
pub(super) struct State {
    pub(super) board: Board,
    /// Levels last driven, in the order of [`super::machine::CAN1_INTERRUPTS`].
    pub(super) levels: [bool; 4],
    pub(super) sysclk_hz: u32,
    /// A step of the bus is announced.
    pub(super) armed: bool,
    /// The client was told that there is no room.
    pub(super) starved: bool,
    /// The machine has been reset once: it has started.
    pub(super) started: bool,
    /// Keeps the flash's sectors when QEMU ends, however it ends.
    pub(super) flash: Option<File>,
    /// Whether the independent watchdog bites.
    pub(super) watchdog: bool,
    /// Whether there is a CAN controller.
    pub(super) has_can: bool,
    /// QEMU ends after the self-test.
    pub(super) self_test_only: bool,
    /// USART2 and USART3.
    pub(super) serial: [SerialState; 2],
}

pub(super) fn lock() -> MutexGuard<'static, Option<State>> {
    STATE.lock().expect("no panic is survived")
}

pub(super) fn with<R>(action: impl FnOnce(&mut State) -> R) -> R {
    action(lock().as_mut().expect("installed before anything else is called"))
}

/// What an update has to tell QEMU.
pub(super) struct Effects {
    pub(super) lines: Vec<(usize, bool)>,
    pub(super) sysclk_hz: Option<u32>,
    pub(super) deadline_ns: Option<u64>,
    pub(super) can_output: Vec<u8>,
    pub(super) console_output: Vec<u8>,
    pub(super) accept_input: bool,
    pub(super) serial: [SerialEffects; 2],
}

impl State {
    /// Keeps what has changed in the flash, half of it where the power goes meanwhile.
    pub(super) fn keep(&mut self, change: Option<flash::Change>) {
        let Some(flash::Change { offset, length }) = change else { return };
        let is_last = self.board.power_goes();
        let length = if is_last { length / 2 } else { length };
        if let Some(file) = &self.flash {
            let bytes = &self.board.flash().bytes()[offset as usize..][..length as usize];
            if let Err(error) = file.write_all_at(bytes, offset.into()) {
                complain(&format!("the flash is not kept: {error}"));
            }
        }
        if is_last {
            // SAFETY: it ends the process at once, as a power cut does; nothing else is to happen
            unsafe { libc::_exit(0) };
        }
    }

    pub(super) fn effects(&mut self) -> Effects {
        let now = self.board.interrupts();
        let levels = [now.transmit, now.receive[0], now.receive[1], now.status];
        let lines =
            (0..levels.len()).filter(|&i| levels[i] != self.levels[i]).map(|i| (i, levels[i])).collect();
        self.levels = levels;

        let sysclk_hz = self.board.sysclk_hz();
        let changed = std::mem::replace(&mut self.sysclk_hz, sysclk_hz) != sysclk_hz;

        let deadline_ns = if self.armed { None } else { self.board.idle_ns() };
        self.armed |= deadline_ns.is_some();
        let accept_input = self.starved && self.board.can_room() > 0;
        self.starved &= !accept_input;
        Effects {
            lines,
            sysclk_hz: changed.then_some(sysclk_hz),
            deadline_ns,
            can_output: self.board.can_output(),
            console_output: self.board.console_output(),
            accept_input,
            serial: std::array::from_fn(|index| self.serial[index].effects(self.board.usart(index).0)),
        }
    }
}
