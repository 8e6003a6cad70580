//! The frames that the manuals print, and what they print wrongly (`vectors/`), against the protocol stack.

mod errata;
mod manual;

use jointbus_protocol::ndam9010::{Layout, RamModule, Station};
use jointbus_protocol::nst::{Daq, RamHardware, SignEncoding};

/// An NST sensor at `address`.
fn daq(address: u8) -> Daq<RamHardware> {
    Daq::new(RamHardware::new(address), SignEncoding::TwosComplement)
}

/// A station of one module at unit 1 with all kinds of channels, as the manual's examples need them.
fn station() -> Station<RamModule, 1> {
    let layout = Layout { digital_inputs: 16, digital_outputs: 16, analog_inputs: 8, analog_outputs: 5 };
    Station::new([RamModule::new(layout)], 1).unwrap()
}

/// `01 AB`, with or without the spaces.
fn bytes(hex: &str) -> Vec<u8> {
    let digits: String = hex.split_whitespace().collect();
    let pairs = digits.as_bytes().as_chunks::<2>();
    assert!(pairs.1.is_empty(), "{hex}");
    pairs.0.iter().map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}
