use super::{Client, Error};
use jointbus_protocol::nst::register::{DATA, IP_ADDRESS, IP_PORT, Register, SETTINGS_LENGTH, ZERO_POINTS};
use jointbus_protocol::nst::serial::{ExpectedResponse, Frame, REQUEST_MAX, encode_request};
use jointbus_protocol::nst::{
    BROADCAST, FunctionCode, Request, Response, SAMPLE_LENGTH, Sample, Settings, SignEncoding,
};
use std::io::{Read, Write};

/// Questions to one NST sensor, in the serial form. A sensor refuses by silence: [`Error::Timeout`]. Address 255 is
/// the broadcast: writes and commands only, done when they are sent.
#[derive(Debug)]
pub struct Nst<'c, S> {
    client: &'c mut Client<S>,
    address: u8,
}

impl<'c, S> Nst<'c, S> {
    pub(super) const fn new(client: &'c mut Client<S>, address: u8) -> Self {
        Self { client, address }
    }
}

impl<S: Read + Write> Nst<'_, S> {
    /// 0x03: reads 1 to 249 bytes of registers, from the byte address `register` on.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Timeout`] where the sensor refuses. So for every method here.
    pub fn read(&mut self, register: u16, length: u8) -> Result<Vec<u8>, Error> {
        self.data(&Request::read(register, length))
    }

    /// 0x03: the six axes, forces before torques, in the units of the sensor's output mode: mN and mN.m where the sensor is
    /// one of [`devices`](crate::devices).
    ///
    /// # Errors
    /// [`Error`].
    pub fn sample(&mut self) -> Result<Sample, Error> {
        const LENGTH: u8 = SAMPLE_LENGTH as u8;
        let data = self.read(DATA.first, LENGTH)?;
        let bytes = data.first_chunk().ok_or(Error::Answer)?;
        Ok(Sample::decode(bytes, SignEncoding::TwosComplement))
    }

    /// 0x03: a register of the manual's table 4, as its bytes; one longer than a frame in several reads.
    ///
    /// # Errors
    /// [`Error`].
    pub fn read_register(&mut self, register: Register) -> Result<Vec<u8>, Error> {
        self.read_all(register.first, register.length)
    }

    /// 0x03: all settings, to be read by their names: address, rates, zero points, texts.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Answer`] where the sensor holds values that the manual does not allow.
    pub fn settings(&mut self) -> Result<Settings, Error> {
        let bytes = self.read_all(0, SETTINGS_LENGTH as u16)?;
        let bytes = bytes.first_chunk().ok_or(Error::Answer)?;
        Settings::decode(bytes).map_err(|_| Error::Answer)
    }

    fn read_all(&mut self, first: u16, length: u16) -> Result<Vec<u8>, Error> {
        // a sensor sends no more at once
        const MOST: usize = 249;
        let mut bytes = Vec::new();
        while bytes.len() < usize::from(length) {
            let left = (usize::from(length) - bytes.len()).min(MOST);
            bytes.extend(self.read(first + bytes.len() as u16, left as u8)?);
        }
        Ok(bytes)
    }

    /// 0x10: writes 1 to 249 bytes of registers, from the byte address `register` on.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Question`] where the bytes fit no frame.
    pub fn write(&mut self, register: u16, data: &[u8]) -> Result<(), Error> {
        self.acknowledged(&Request::Write { register, data })
    }

    /// 0x12: the present sample becomes the zero point, at the next restart.
    ///
    /// # Errors
    /// [`Error`].
    pub fn set_zero(&mut self) -> Result<(), Error> {
        self.command(FunctionCode::SetZero, ZERO_POINTS.first, ZERO_POINTS.length)
    }

    /// 0x19: no zero point, at the next restart.
    ///
    /// # Errors
    /// [`Error`].
    pub fn clear_zero(&mut self) -> Result<(), Error> {
        self.command(FunctionCode::ClearZero, ZERO_POINTS.first, ZERO_POINTS.length)
    }

    /// 0x18: restarts the sensor.
    ///
    /// # Errors
    /// [`Error`].
    pub fn restart(&mut self) -> Result<(), Error> {
        self.command(FunctionCode::Restart, 0, 1)
    }

    /// 0x15: IP address and port.
    ///
    /// # Errors
    /// [`Error`].
    pub fn search(&mut self) -> Result<([u8; 4], u16), Error> {
        let length = (IP_ADDRESS.length + IP_PORT.length) as u8;
        let request = Request::Command { function: FunctionCode::Search, register: IP_ADDRESS.first, length };
        match *self.data(&request)? {
            [a, b, c, d, low, high] => Ok(([a, b, c, d], u16::from_le_bytes([low, high]))),
            _ => Err(Error::Answer),
        }
    }

    /// Any request; the answer's body.
    ///
    /// # Errors
    /// [`Error`].
    pub fn request(&mut self, request: &Request<'_>) -> Result<Vec<u8>, Error> {
        let mut buffer = [0; REQUEST_MAX];
        let frame = encode_request(self.address, request, &mut buffer).map_err(|_| Error::Question)?;
        let reply = self.client.exchange(frame, &ExpectedResponse::new(self.address, request), |_| false)?;
        Ok(Frame::decode(&reply).ok_or(Error::Answer)?.body.to_vec())
    }

    fn command(&mut self, function: FunctionCode, register: u16, length: u16) -> Result<(), Error> {
        let length = u8::try_from(length).map_err(|_| Error::Question)?;
        self.acknowledged(&Request::Command { function, register, length })
    }

    fn data(&mut self, request: &Request<'_>) -> Result<Vec<u8>, Error> {
        match Response::decode(&self.request(request)?) {
            Ok(Response::Data { data, .. }) => Ok(data.to_vec()),
            _ => Err(Error::Answer),
        }
    }

    fn acknowledged(&mut self, request: &Request<'_>) -> Result<(), Error> {
        if self.address == BROADCAST {
            let mut buffer = [0; REQUEST_MAX];
            let frame = encode_request(BROADCAST, request, &mut buffer).map_err(|_| Error::Question)?;
            return self.client.send(frame);
        }
        match Response::decode(&self.request(request)?) {
            Ok(Response::Acknowledge { .. }) => Ok(()),
            _ => Err(Error::Answer),
        }
    }
}
