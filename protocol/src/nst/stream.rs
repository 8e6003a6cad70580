//! The form on USB, UDP and TCP: address and body, no CRC (4.2.3).
//!
//! A datagram of UDP holds one frame. On USB and TCP frames follow each other and only their lengths tell them apart:
//! [`RequestFraming`] for the device's side, [`ExpectedResponse`] for the master's. Without a checksum nothing shows that bytes
//! were lost, so on TCP the owner closes the connection after a burst that was dropped.

use super::serial;
use super::{Request, Response};
use crate::checksum::CRC_LENGTH;
use crate::decode::{FrameLength, Framing, Match};
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
pub fn encode_reply<'b>(
    address: u8,
    reply: &Response<'_>,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], NoSpace> {
    let mut writer = Writer::new(buffer);
    writer.u8(address)?;
    reply.encode(&mut writer)?;
    Ok(writer.finish())
}

/// Length of the request frame that starts with `prefix`.
#[must_use]
pub fn request_length(prefix: &[u8]) -> FrameLength {
    match serial::request_length(prefix) {
        FrameLength::Exactly(length) => FrameLength::Exactly(length.saturating_sub(CRC_LENGTH)),
        other => other,
    }
}

/// Requests to a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RequestFraming;

impl Framing for RequestFraming {
    fn length(&self, prefix: &[u8]) -> FrameLength {
        request_length(prefix)
    }

    fn is_valid(&self, frame: &[u8]) -> bool {
        split(frame).is_some_and(|(_, body)| Request::decode(body).is_ok())
    }

    /// Every frame counts as one: without a checksum none is taken out of the middle of a burst.
    fn is_broadcast(&self, _: &[u8]) -> bool {
        true
    }
}

/// What a master remembers of a request to know the reply: address, function code and length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ExpectedResponse(serial::ExpectedResponse);

impl ExpectedResponse {
    /// What the device at `address` may answer to `request`.
    #[must_use]
    pub fn new(address: u8, request: &Request<'_>) -> Self {
        Self(serial::ExpectedResponse::new(address, request))
    }
}

impl Match<1> for ExpectedResponse {
    fn lengths(&self) -> [usize; 1] {
        [self.0.body_length().saturating_add(1)]
    }

    fn accepts(&self, _: usize, frame: &[u8]) -> bool {
        split(frame).is_some_and(|(address, body)| address == self.0.address() && self.0.accepts_body(body))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::{Event, FrameDecoder, ResponseMatcher};
    use crate::nst::{Daq, REPLY_DATA_MAX, RamHardware, SignEncoding};
    use crate::time::{Duration, Instant};
    use std::vec::Vec;

    #[test]
    fn requests_and_replies_on_a_stream_in_pieces_of_every_size() {
        let requests = [
            Request::read(0x0200, 18),
            Request::Write { register: 0x0193, data: &[1] },
            Request::Command { function: crate::nst::FunctionCode::Search, register: 0x01A1, length: 6 },
        ];
        let mut stream = Vec::new();
        for request in &requests {
            stream.extend_from_slice(encode_request(1, request, &mut [0xEE; 300]).unwrap());
        }
        for piece in 1..=stream.len() {
            let mut daq = Daq::new(RamHardware::new(1), SignEncoding::TwosComplement);
            let mut decoder = FrameDecoder::<260>::new(Duration::from_millis(20));
            let mut replies = Vec::new();
            for mut chunk in stream.chunks(piece) {
                while let Some(event) = decoder.feed(&RequestFraming, &mut chunk, Instant::default()) {
                    let Event::Frame(frame) = event else { panic!("{event:?}") };
                    let mut out = [0xEE; REPLY_DATA_MAX + 3];
                    replies.extend_from_slice(daq.serve_stream(frame, &mut out).unwrap());
                }
            }
            let mut rest = &replies[..];
            for request in &requests {
                let mut search = ResponseMatcher::<300, 1>::default();
                let (_, reply) = search.feed(&ExpectedResponse::new(1, request), &mut rest).unwrap();
                assert_eq!(reply[1], request.function().code());
            }
            assert_eq!(rest, []);
        }
    }

    #[test]
    fn after_something_wrong_nothing_is_taken_until_silence() {
        let mut decoder = FrameDecoder::<260>::new(Duration::from_millis(20));
        let start = Instant::default();
        let mut bytes = &[1, 4, 1, 3, 2, 0, 18][..];
        assert_eq!(decoder.feed(&RequestFraming, &mut bytes, start), None);
        let later = start.saturating_add(Duration::from_millis(20));
        assert!(matches!(decoder.poll(&RequestFraming, later), Some(Event::Dropped { .. })));
        let mut bytes = &[1, 3, 2, 0, 18][..];
        assert!(matches!(decoder.feed(&RequestFraming, &mut bytes, later), Some(Event::Frame(_))));
    }
}
