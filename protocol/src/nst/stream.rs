//! The form on USB, UDP and TCP: address and body, no CRC (4.2.3).

use super::{Reply, Request};
use crate::wire::{NoSpace, Writer};

/// A frame's address and body; `None` for nothing at all.
#[must_use]
pub fn split(frame: &[u8]) -> Option<(u8, &[u8])> {
    frame.split_first().map(|(address, body)| (*address, body))
}

/// Writes a request as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_request<'b>(
    address: u8,
    request: &Request<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(address)?;
    request.encode(&mut writer)?;
    Ok(writer.finish())
}

/// Writes a reply as a frame and returns the used part of `buffer`.
///
/// # Errors
/// [`NoSpace`] where it does not fit.
pub fn encode_reply<'b>(address: u8, reply: &Reply<'_>, buffer: &'b mut [u8]) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(address)?;
    reply.encode(&mut writer)?;
    Ok(writer.finish())
}
