//! Frames, decoders and slave-side register dispatchers of three industrial dialects: NST six-axis force/torque DAQs,
//! the NXI-6201 analog output card, the NDAM-9010 I/O station, and the general Modbus beneath the latter two.
//!
//! `no_std`, no allocation, no `unsafe`, nothing that panics on any input, no I/O, no clock, no logging: bytes and the
//! time go in; values, frames and reasons come out. Buffers are the caller's or of a constant size, and each call does
//! work in proportion to the bytes that it is given.
//!
//! # Layers
//!
//! | | takes | gives |
//! |---|---|---|
//! | [`wire`], [`checksum`] | bytes | bounded reading and writing, CRC-16/MODBUS, LRC |
//! | [`decode`], [`modbus::line`], [`modbus::ascii`], [`modbus::tcp`], [`nst::line`], [`nst::can`], [`slcan`] | a stream of bytes or CAN frames, and the [`time`] | whole, valid frames, and what was wrong with the rest |
//! | [`modbus::Request`], [`modbus::Response`], [`nst::Request`], [`nst::Response`] | the content of a frame | a value, decoded but not checked; and back into the caller's buffer |
//! | [`modbus::server`], [`nst::Daq`], [`nxi6201::Card`], [`ndam9010::Station`] | a request and the owner's state behind a trait | a response, or silence with its reason |
//!
//! A firmware takes what it needs: the master's side of a bus wants [`decode::ResponseMatcher`] and an expectation such as
//! [`modbus::ExpectedResponse`]; a slave wants [`decode::FrameDecoder`], or [`modbus::line::MultidropDecoder`] or
//! [`nst::line::MultidropDecoder`] among other slaves, and a dispatcher. All decoders give the same [`decode::Event`]. What the manuals of the devices leave open or contradict is named at the item that it
//! shapes, and collected in `DEVIATIONS.md`.
//!
//! # Serve your own registers
//!
//! ```
//! use jointbus_protocol::decode::{FrameDecoder, Event, STRAY_MAX};
//! use jointbus_protocol::modbus::rtu::{FRAME_MAX, RequestFraming};
//! use jointbus_protocol::modbus::server::{self, Registers, RegisterWriter, Server};
//! use jointbus_protocol::modbus::{ExceptionCode, AddressRange};
//! use jointbus_protocol::time::{Duration, Instant};
//!
//! /// Holding register 0 is a set speed of at most 3000, input registers 0 and 1 are measured.
//! struct Motor {
//!     set_speed: u16,
//!     measured: [u16; 2],
//! }
//!
//! impl Server for Motor {
//!     fn read_holding_registers(&mut self, range: AddressRange, to: &mut RegisterWriter<'_>) -> Result<(), ExceptionCode> {
//!         if !range.within(0, 0) {
//!             return Err(ExceptionCode::IllegalDataAddress);
//!         }
//!         to.push(self.set_speed);
//!         Ok(())
//!     }
//!
//!     fn read_input_registers(&mut self, range: AddressRange, to: &mut RegisterWriter<'_>) -> Result<(), ExceptionCode> {
//!         if !range.within(0, 1) {
//!             return Err(ExceptionCode::IllegalDataAddress);
//!         }
//!         to.extend(self.measured.into_iter().skip(range.start.into()));
//!         Ok(())
//!     }
//!
//!     fn write_registers(&mut self, range: AddressRange, values: Registers<'_>) -> Result<(), ExceptionCode> {
//!         match (range.within(0, 0), values.get(0)) {
//!             (true, Some(speed @ 0..=3000)) => self.set_speed = speed,
//!             (true, _) => return Err(ExceptionCode::IllegalDataValue),
//!             (false, _) => return Err(ExceptionCode::IllegalDataAddress),
//!         }
//!         Ok(())
//!     }
//! }
//!
//! let mut motor = Motor { set_speed: 0, measured: [1480, 22] };
//! // 3.5 characters at 9600 baud end a frame
//! let mut line = FrameDecoder::<{ FRAME_MAX + STRAY_MAX }>::new(Duration::from_micros(4011));
//! let mut out = [0; FRAME_MAX];
//! let mut answers = 0;
//!
//! // from the UART: to unit 7, set register 0 to 1500
//! let mut received = &[0x07, 0x06, 0x00, 0x00, 0x05, 0xDC, 0x8B, 0x65][..];
//! let now = Instant::from_micros(1_000_000);
//! while let Some(event) = line.feed(&RequestFraming, &mut received, now) {
//!     if let Event::Frame(frame) = event
//!         && let Ok(answer) = server::rtu(&mut motor, 7, frame, &mut out)
//!     {
//!         // to the UART: this function code is answered with the request itself
//!         assert_eq!(answer, frame);
//!         answers += 1;
//!     }
//! }
//! assert_eq!((motor.set_speed, answers), (1500, 1));
//! ```
//!
//! # Parse an NST sample
//!
//! ```
//! use jointbus_protocol::decode::ResponseMatcher;
//! use jointbus_protocol::nst::serial::{self, ExpectedResponse};
//! use jointbus_protocol::nst::{Response, Request, SAMPLE_LENGTH, Sample, SignEncoding, register};
//!
//! let request = Request::read(register::DATA.first, SAMPLE_LENGTH as u8);
//! let mut buffer = [0; serial::REQUEST_MAX];
//! let sent = serial::encode_request(1, &request, &mut buffer)?;
//! assert_eq!(sent, [0x01, 0x03, 0x02, 0x00, 0x12, 0x38, 0x49]); // printed in 4.3.1.10
//!
//! // what comes back, behind a byte of noise: Fx 1500 mN, Fy -2 mN, Tz 300 mN.m
//! let mut received = &[
//!     0xFF, 0x01, 0x03, 0x12, 0x00, 0x05, 0xDC, 0xFF, 0xFF, 0xFE, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x00, 0x01, 0x2C,
//!     0xAF, 0xC7,
//! ][..];
//! let expected = ExpectedResponse::new(1, &request);
//! let mut search = ResponseMatcher::<{ serial::RESPONSE_MAX + 1 }, 1>::default();
//! let (_, frame) = search.feed(&expected, &mut received).ok_or("no reply yet")?;
//!
//! let body = serial::Frame::decode(frame).ok_or("checked already")?.body;
//! let Response::Data { data, .. } = Response::decode(body)? else { return Err("no data".into()) };
//! let sample = Sample::decode(data.try_into()?, SignEncoding::TwosComplement);
//! assert_eq!(sample.newtons(), [1.5, -0.002, 0.0, 0.0, 0.0, 0.3]);
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```
//!
//! # Reassemble CAN frames
//!
//! ```
//! use jointbus_protocol::can::{Frame, Id};
//! use jointbus_protocol::nst::can::{ReassemblyError, Outcome, Reassembler, segment};
//! use jointbus_protocol::nst::{RESPONSE_HEADER, Response};
//! use jointbus_protocol::time::{Duration, Instant};
//!
//! // transfers to node 2, from up to four sources at once, their frames at most 10 ms apart
//! let mut reassembler = Reassembler::<4>::new(2, Duration::from_millis(10));
//!
//! // from the CAN controller: the reply of node 1 to a read of 18 bytes, in three frames
//! let mut body = [0; RESPONSE_HEADER + 18];
//! body[..2].copy_from_slice(&[0x03, 18]);
//! let mut received = 0;
//! for frame in segment(1, 2, &body)? {
//!     let report = reassembler.push(&frame, Instant::from_micros(500));
//!     if let Some(Outcome::Complete { source, body, .. }) = report.outcome {
//!         assert_eq!(source, 1);
//!         let Response::Data { data, .. } = Response::decode(body)? else { return Err("no data".into()) };
//!         received = data.len();
//!     }
//! }
//! assert_eq!(received, 18);
//!
//! // a last frame of which nobody saw the first: nothing comes out, and the reason is told
//! let stray = Frame::data_frame(Id::Extended(0x0001_0282), &[1, 2, 3, 4])?;
//! let report = reassembler.push(&stray, Instant::from_micros(600));
//! assert_eq!((report.outcome, report.error), (None, Some(ReassemblyError::NoFirst)));
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```
//!
//! # Features
//!
//! `defmt` derives [`defmt::Format`](https://docs.rs/defmt) for the values that are worth a log line. Nothing else
//! depends on a feature.
#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::unreachable,
        clippy::arithmetic_side_effects
    )
)]

#[cfg(test)]
extern crate std;

/// How far a loop over all values goes at once: one by one, but under miri, which interprets every step, this far.
#[cfg(test)]
const fn stride(under_miri: usize) -> usize {
    if cfg!(miri) { under_miri } else { 1 }
}

pub mod can;
pub mod checksum;
mod codes;
pub mod decode;
mod error;
pub mod modbus;
pub mod ndam9010;
pub mod nst;
pub mod nxi6201;
pub mod slcan;
pub mod time;
pub mod wire;
