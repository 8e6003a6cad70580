//! The bridge as a host sees it, against simulated devices in virtual time.

mod ascii;
mod bridge;
mod can;
mod configuration;
mod devices;
mod life;
mod order;
mod world;

use jointbus_protocol::nst::SignEncoding;
use jointbus_protocol::time::Duration;
use world::SAMPLE;

const SOON: Duration = Duration::from_millis(40);
const LATER: Duration = Duration::from_millis(2000);

/// Reads the six axes.
const READ: [u8; 4] = [0x03, 0x02, 0x00, 0x12];

fn axes(factor: i32) -> Vec<u8> {
    let sample = jointbus_protocol::nst::Sample(SAMPLE.0.map(|axis| axis * factor));
    [&[0x03, 0x12][..], &sample.encode(SignEncoding::TwosComplement)].concat()
}
