mod hardware;
#[cfg(test)]
mod tests;

pub use hardware::{Hardware, RamHardware};

use super::can::{self, Segments};
use super::register::{self, SETTINGS_LENGTH};
use super::settings::ActiveSettings;
use super::{
    BROADCAST, BodyError, FunctionCode, NoResponse, REPLY_DATA_MAX, RESPONSE_HEADER, Refusal, Request,
    Response, Sample, SignEncoding, StoreError, serial, stream,
};
use crate::checksum::{self, CRC_LENGTH};
use crate::wire::copy;

/// An NST device: its registers and what requests do to them.
///
/// Settings act after a restart, zero points too (4.1.3 to 4.1.11): a read gives the new value at once, the device
/// goes on with the old one until function code 0x18 or power-up.
#[derive(Debug)]
pub struct Daq<H> {
    hardware: H,
    sign: SignEncoding,
    active: ActiveSettings,
}

impl<H: Hardware> Daq<H> {
    /// Powers the device up: the stored settings take effect.
    #[must_use]
    pub fn new(hardware: H, sign: SignEncoding) -> Self {
        let active = ActiveSettings::new(hardware.settings(), sign);
        Self { hardware, sign, active }
    }

    /// Restarts the device as function code 0x18 does: the stored settings take effect, and the hardware is told.
    pub fn restart(&mut self) {
        self.active = ActiveSettings::new(self.hardware.settings(), self.sign);
        self.hardware.restart(&self.active);
    }

    /// The settings in use: those stored when the device last started.
    #[must_use]
    pub const fn active(&self) -> &ActiveSettings {
        &self.active
    }

    /// Whether settings are stored that are not in use before a restart.
    #[must_use]
    pub fn needs_restart(&self) -> bool {
        self.active != ActiveSettings::new(self.hardware.settings(), self.sign)
    }

    /// The address in use; on CAN it is the node.
    #[must_use]
    pub const fn address(&self) -> u8 {
        self.active.address
    }

    /// What is behind the dispatcher.
    pub const fn hardware(&mut self) -> &mut H {
        &mut self.hardware
    }

    /// The present sample after zero points, as the data registers show it.
    pub fn sample(&mut self) -> Sample {
        let mut sample = self.hardware.sample();
        for (axis, zero) in sample.0.iter_mut().zip(self.active.zero_points.0) {
            *axis = axis.saturating_sub(zero);
        }
        sample
    }

    /// Answers a frame of RS232 or RS485 into `out`.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_serial<'b>(&mut self, frame: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
        let frame = serial::Frame::decode(frame).ok_or(NoResponse::Checksum)?;
        self.serve_frame(&frame, out)
    }

    /// [`Daq::serve_serial`] of a frame whose checksum was looked at: from [`line::MultidropDecoder`](super::line::MultidropDecoder).
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_frame<'b>(
        &mut self,
        frame: &serial::Frame<'_>,
        out: &'b mut [u8],
    ) -> Result<&'b [u8], NoResponse> {
        let reply = self.serve_around(frame.address, frame.body, (1, CRC_LENGTH), out)?;
        if let Some(first) = reply.first_mut() {
            *first = frame.address;
        }
        checksum::close(reply);
        Ok(reply)
    }

    /// Answers a frame of USB, TCP, or a datagram of UDP into `out`.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_stream<'b>(&mut self, frame: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
        let (address, body) = stream::split(frame).ok_or(NoResponse::Malformed(BodyError::Length))?;
        let reply = self.serve_around(address, body, (1, 0), out)?;
        if let Some(first) = reply.first_mut() {
            *first = address;
        }
        Ok(reply)
    }

    /// Answers a transfer on CAN from node `source` to node `destination`: the frames of the answer, whose body is put
    /// into `buffer`.
    ///
    /// What does not fit one transfer is refused whole: a master asks for it in several (4.2.1.2).
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_can<'b>(
        &mut self,
        source: u8,
        destination: u8,
        body: &[u8],
        buffer: &'b mut [u8; can::TRANSFER_MAX],
    ) -> Result<Segments<'b>, NoResponse> {
        let node = self.active.address;
        let reply =
            self.serve_around(destination, body, (0, 0), buffer).map_err(|silence| match silence {
                NoResponse::NoSpace => NoResponse::Refused(Refusal::Length),
                other => other,
            })?;
        can::segment(node, source, reply).map_err(|can::TransferLength| NoResponse::NoSpace)
    }

    /// Answers the body of a request to `address`, which on CAN is the destination node.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve<'b>(
        &mut self,
        address: u8,
        body: &[u8],
        data: &'b mut [u8],
    ) -> Result<Response<'b>, NoResponse> {
        let request = self.check(address, body)?;
        let result = self.dispatch(&request, data);
        if address == BROADCAST {
            return Err(NoResponse::Broadcast(result.err()));
        }
        result.map_err(NoResponse::Refused)
    }

    /// Whether a body is a request to this device.
    fn check<'r>(&self, address: u8, body: &'r [u8]) -> Result<Request<'r>, NoResponse> {
        if address != self.active.address && address != BROADCAST {
            return Err(NoResponse::OtherAddress);
        }
        let request = Request::decode(body).map_err(NoResponse::Malformed)?;
        if address == BROADCAST && request.function().is_read() {
            return Err(NoResponse::BroadcastRead);
        }
        Ok(request)
    }

    /// Answers a body into `out`, with so many bytes before and behind the answer left to the caller. Who can't be
    /// answered is not served.
    fn serve_around<'b>(
        &mut self,
        address: u8,
        body: &[u8],
        (before, behind): (usize, usize),
        out: &'b mut [u8],
    ) -> Result<&'b mut [u8], NoResponse> {
        let request = self.check(address, body)?;
        if address == BROADCAST {
            return Err(NoResponse::Broadcast(self.carry_out(&request, &mut []).err()));
        }
        let (function, length) = (request.function(), request.length());
        let data_length = if function.is_read() { usize::from(length) } else { 0 };
        let end = before.wrapping_add(RESPONSE_HEADER).wrapping_add(data_length);
        let frame = out.get_mut(..end.wrapping_add(behind)).ok_or(NoResponse::NoSpace)?;
        let reply = frame.get_mut(before..end).ok_or(NoResponse::NoSpace)?;
        let [code, count, data @ ..] = reply else { return Err(NoResponse::NoSpace) };
        (*code, *count) = (function.code(), length);
        self.carry_out(&request, data).map_err(NoResponse::Refused)?;
        Ok(frame)
    }

    /// Checks a request whole, then carries it out whole. What a read reads is put into `data`.
    ///
    /// # Errors
    /// [`Refusal`], and nothing has changed.
    pub fn dispatch<'b>(
        &mut self,
        request: &Request<'_>,
        data: &'b mut [u8],
    ) -> Result<Response<'b>, Refusal> {
        let (function, length) = (request.function(), request.length());
        if !function.is_read() {
            self.carry_out(request, &mut [])?;
            return Ok(Response::Acknowledge { function, length });
        }
        let data = data.get_mut(..usize::from(length)).ok_or(Refusal::Length)?;
        self.carry_out(request, data)?;
        Ok(Response::Data { function, data })
    }

    /// `data` has the length that a read asks for.
    fn carry_out(&mut self, request: &Request<'_>, data: &mut [u8]) -> Result<(), Refusal> {
        let exactly = |register: register::Register| {
            request.register() == register.first && u16::from(request.length()) == register.length
        };
        match *request {
            Request::Write { register, data } => self.write(register, data),
            Request::Command { function: FunctionCode::Read, register, .. } => self.read(register, data),
            Request::Command { function: FunctionCode::Search, register, length } => {
                let wanted = register::IP_ADDRESS.length.saturating_add(register::IP_PORT.length);
                if register != register::IP_ADDRESS.first || u16::from(length) != wanted {
                    return Err(Refusal::CommandForm);
                }
                self.read(register, data)
            }
            Request::Command { function: FunctionCode::SetZero, .. } if exactly(register::ZERO_POINTS) => {
                let sample = self.hardware.sample();
                self.store_zero(sample)
            }
            Request::Command { function: FunctionCode::ClearZero, .. } if exactly(register::ZERO_POINTS) => {
                self.store_zero(Sample::default())
            }
            Request::Command { function: FunctionCode::Restart, register: 0, length: 1 } => {
                self.restart();
                Ok(())
            }
            Request::Command { function: FunctionCode::Connect, .. } => Ok(()),
            Request::Command { .. } => Err(Refusal::CommandForm),
        }
    }

    fn read(&mut self, register: u16, data: &mut [u8]) -> Result<(), Refusal> {
        // a device sends one byte fewer than a master takes
        if data.is_empty() || data.len() >= REPLY_DATA_MAX {
            return Err(Refusal::Length);
        }
        let first = usize::from(register);
        if first.saturating_add(data.len()) > usize::from(register::DATA.last()).saturating_add(1) {
            return Err(Refusal::Register);
        }
        let data = match self.hardware.settings().as_bytes().get(first..) {
            Some(stored @ [_, ..]) => {
                let (settings, measured) = data.split_at_mut(stored.len().min(data.len()));
                copy(stored, settings);
                measured
            }
            _ => data,
        };
        if data.is_empty() {
            return Ok(());
        }
        match data.split_first_chunk_mut() {
            Some((place, zeros)) if first <= SETTINGS_LENGTH => {
                self.sample().encode_into(self.sign, place);
                zeros.iter_mut().for_each(|byte| *byte = 0);
            }
            _ => {
                let sample = self.sample().encode(self.sign);
                let values = sample.iter().copied().skip(first.saturating_sub(SETTINGS_LENGTH));
                let values = values.chain(core::iter::repeat(0));
                data.iter_mut().zip(values).for_each(|(byte, value)| *byte = value);
            }
        }
        Ok(())
    }

    fn write(&mut self, first: u16, data: &[u8]) -> Result<(), Refusal> {
        let mut settings = *self.hardware.settings();
        settings.write_or_spoil(first, data)?;
        self.hardware.store(&settings).map_err(|StoreError| Refusal::Store)
    }

    fn store_zero(&mut self, zero: Sample) -> Result<(), Refusal> {
        let mut settings = *self.hardware.settings();
        settings.set_zero_points(zero, self.sign);
        self.hardware.store(&settings).map_err(|StoreError| Refusal::Store)
    }
}
