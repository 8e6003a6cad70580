//! An engine of any board, for adapters and for programs that choose the board when they run.

use super::actions::Action;
use super::bridge::Engine;
use super::counters::Counters;
use super::identity::Health;
use super::polling::Slot;
use super::settings::{STORED_LENGTH, Settings};
use crate::board::{Board, Description, Port, PortConfig};
use jointbus_protocol::can::Frame;
use jointbus_protocol::time::Instant;

/// An [`Engine`] whatever its board is. Each method does what the engine's of the same name does.
#[allow(missing_docs)] // told there
pub trait AnyEngine: core::fmt::Debug {
    fn board(&self) -> &'static Description;
    fn restore(&mut self, settings: &Settings, now: Instant);
    fn receive(&mut self, port: Port, bytes: &[u8], now: Instant);
    fn overrun(&mut self, port: Port);
    fn receive_error(&mut self, port: Port);
    fn transmit_error(&mut self, port: Port);
    fn output(&self, port: Port) -> &[u8];
    fn advance(&mut self, port: Port, taken: usize);
    fn transmit_complete(&mut self, port: Port, now: Instant);
    fn receive_frame(&mut self, port: Port, frame: &Frame, now: Instant);
    fn next_frame(&mut self, port: Port) -> Option<Frame>;
    fn frame_sent(&mut self, port: Port, now: Instant);
    fn frames_aborted(&mut self, port: Port, now: Instant);
    fn set_bus_off(&mut self, port: Port, bus_off: bool, now: Instant);
    fn set_health(&mut self, health: Health);
    fn health(&self) -> Health;
    fn port(&self, port: Port) -> Option<&PortConfig>;
    fn counters(&self, port: Port) -> Counters;
    fn slot(&self, index: usize) -> Option<&Slot>;
    fn legacy_codes(&self) -> u32;
    fn encode_settings(&self, stored: &mut [u8; STORED_LENGTH]);
    fn saved(&mut self, stored: bool);
    #[must_use]
    fn poll(&mut self, now: Instant) -> Option<Action>;
    fn poll_at(&self) -> Option<Instant>;
}

macro_rules! delegate {
    ($(fn $name:ident(&self $(, $argument:ident: $kind:ty)*) $(-> $result:ty)?;)*
     mut $(fn $name_mut:ident(&mut self $(, $argument_mut:ident: $kind_mut:ty)*) $(-> $result_mut:ty)?;)*) => {
        $(#[inline]
        fn $name(&self $(, $argument: $kind)*) $(-> $result)? {
            Engine::$name(self $(, $argument)*)
        })*
        $(#[inline]
        fn $name_mut(&mut self $(, $argument_mut: $kind_mut)*) $(-> $result_mut)? {
            Engine::$name_mut(self $(, $argument_mut)*)
        })*
    };
}

impl<B: Board, const SERIAL: usize, const CAN: usize> AnyEngine for Engine<B, SERIAL, CAN> {
    fn board(&self) -> &'static Description {
        B::DESCRIPTION
    }

    delegate! {
        fn output(&self, port: Port) -> &[u8];
        fn health(&self) -> Health;
        fn port(&self, port: Port) -> Option<&PortConfig>;
        fn counters(&self, port: Port) -> Counters;
        fn slot(&self, index: usize) -> Option<&Slot>;
        fn legacy_codes(&self) -> u32;
        fn encode_settings(&self, stored: &mut [u8; STORED_LENGTH]);
        fn poll_at(&self) -> Option<Instant>;
        mut
        fn restore(&mut self, settings: &Settings, now: Instant);
        fn receive(&mut self, port: Port, bytes: &[u8], now: Instant);
        fn overrun(&mut self, port: Port);
        fn receive_error(&mut self, port: Port);
        fn transmit_error(&mut self, port: Port);
        fn advance(&mut self, port: Port, taken: usize);
        fn transmit_complete(&mut self, port: Port, now: Instant);
        fn receive_frame(&mut self, port: Port, frame: &Frame, now: Instant);
        fn next_frame(&mut self, port: Port) -> Option<Frame>;
        fn frame_sent(&mut self, port: Port, now: Instant);
        fn frames_aborted(&mut self, port: Port, now: Instant);
        fn set_bus_off(&mut self, port: Port, bus_off: bool, now: Instant);
        fn set_health(&mut self, health: Health);
        fn saved(&mut self, stored: bool);
        fn poll(&mut self, now: Instant) -> Option<Action>;
    }
}
