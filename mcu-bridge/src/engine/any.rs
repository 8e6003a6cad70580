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

/// Declares each method in the trait, and has it do what the engine's of the same name does.
macro_rules! any_engine {
    ($($(#[$meta:meta])? fn $name:ident(&self $(, $argument:ident: $kind:ty)*) $(-> $result:ty)?;)*
     mut $($(#[$meta_mut:meta])? fn $name_mut:ident(&mut self $(, $argument_mut:ident: $kind_mut:ty)*) $(-> $result_mut:ty)?;)*) => {
        /// An [`Engine`] whatever its board is. Each method does what the engine's of the same name does.
        #[allow(missing_docs, reason = "the engine's methods have them")]
        pub trait AnyEngine: core::fmt::Debug {
            /// What its board says of itself.
            fn board(&self) -> &'static Description;
            $($(#[$meta])? fn $name(&self $(, $argument: $kind)*) $(-> $result)?;)*
            $($(#[$meta_mut])? fn $name_mut(&mut self $(, $argument_mut: $kind_mut)*) $(-> $result_mut)?;)*
        }

        impl<B: Board, const SERIAL: usize, const CAN: usize> AnyEngine for Engine<B, SERIAL, CAN> {
            fn board(&self) -> &'static Description {
                B::DESCRIPTION
            }

            $(#[inline]
            fn $name(&self $(, $argument: $kind)*) $(-> $result)? {
                Engine::$name(self $(, $argument)*)
            })*

            $(#[inline]
            fn $name_mut(&mut self $(, $argument_mut: $kind_mut)*) $(-> $result_mut)? {
                Engine::$name_mut(self $(, $argument_mut)*)
            })*
        }
    };
}

any_engine! {
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
    #[must_use]
    fn poll(&mut self, now: Instant) -> Option<Action>;
}
