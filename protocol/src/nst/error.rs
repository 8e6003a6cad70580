//! Why an NST device does not do what it is asked, and why it does not answer.

use super::BodyError;
use super::register::Register;
use crate::error::error_text;

/// The settings could not be stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StoreError;

/// Why the bytes of a store are no settings; [`Settings::FACTORY`](super::Settings::FACTORY) takes their place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SettingsError {
    /// All bytes are 0xFF or all are 0x00: nothing was ever stored.
    Blank,
    /// The value of this register is not in its set: address, CAN rate, channel or Ethernet mode.
    Value(Register),
}

/// Why a device does not do what it is asked; it is silent then, and its owner learns the reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Refusal {
    /// The registers don't exist.
    Register,
    /// Nothing to read or write, or more than a reply can hold.
    Length,
    /// A register is read only.
    ReadOnly,
    /// A value is not in its set: address, CAN rate, channel or Ethernet mode.
    Value,
    /// The command has one register and one length, and these are others (4.3.1.7, 4.3.1.8, 4.3.1.11).
    CommandForm,
    /// The store failed.
    Store,
}

/// Why a frame or a transfer is not answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum NoResponse {
    /// The CRC is wrong.
    Checksum,
    /// Not a request.
    Malformed(BodyError),
    /// Meant for another address.
    OtherAddress,
    /// A broadcast is never answered; it was carried out, or refused for the reason given.
    Broadcast(Option<Refusal>),
    /// A read by broadcast.
    BroadcastRead,
    /// Refused.
    Refused(Refusal),
    /// The reply does not fit the caller's buffer; what was asked has been done all the same.
    NoSpace,
}

error_text! {
    StoreError {
        StoreError => ("the settings could not be stored"),
    }
}

error_text! {
    Refusal {
        Refusal::Register => ("the registers don't exist"),
        Refusal::Length => ("nothing, or more than a reply can hold"),
        Refusal::ReadOnly => ("a register is read only"),
        Refusal::Value => ("a value is not in its set"),
        Refusal::CommandForm => ("not the register and length of this command"),
        Refusal::Store => ("the store failed"),
    }
}

error_text! {
    NoResponse {
        NoResponse::Checksum => ("the CRC does not fit"),
        NoResponse::Malformed(error) => ("{error}"),
        NoResponse::OtherAddress => ("for another address"),
        NoResponse::Broadcast(None) => ("a broadcast, carried out"),
        NoResponse::Broadcast(Some(refusal)) => ("a broadcast, refused: {refusal}"),
        NoResponse::BroadcastRead => ("a read by broadcast"),
        NoResponse::Refused(refusal) => ("{refusal}"),
        NoResponse::NoSpace => ("the reply does not fit the buffer"),
    }
}

error_text! {
    SettingsError {
        SettingsError::Blank => ("nothing was ever stored"),
        SettingsError::Value(register) => ("the value at {:#06x} is not in its set", register.first),
    }
}
