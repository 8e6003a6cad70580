use super::value::{self, RegisterValue, WordOrder};
use super::{Client, Error};
use jointbus_protocol::modbus::rtu::{ExpectedResponse, FRAME_MAX, Frame, encode_request};
use jointbus_protocol::modbus::{
    AddressRange, BROADCAST, COIL_OFF, COIL_ON, Request, Response, bit, packed_len, registers,
};
use std::io::{Read, Write};

/// Questions to one Modbus unit. Unit 0 is the broadcast: writes only, done when they are sent.
#[derive(Debug)]
pub struct Modbus<'c, S> {
    client: &'c mut Client<S>,
    unit: u8,
}

impl<'c, S> Modbus<'c, S> {
    pub(super) const fn new(client: &'c mut Client<S>, unit: u8) -> Self {
        Self { client, unit }
    }
}

impl<S: Read + Write> Modbus<'_, S> {
    /// 0x01: reads 1 to 2000 coils from `start` on.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Exception`] where the unit refuses, a quantity out of range included. So for every method here.
    pub fn read_coils(&mut self, start: u16, quantity: u16) -> Result<Vec<bool>, Error> {
        let range = AddressRange::new(start, quantity);
        Ok(unpack(&self.read(&Request::ReadCoils(range))?, quantity))
    }

    /// 0x02: reads 1 to 2000 discrete inputs from `start` on.
    ///
    /// # Errors
    /// [`Error`].
    pub fn read_discrete_inputs(&mut self, start: u16, quantity: u16) -> Result<Vec<bool>, Error> {
        let range = AddressRange::new(start, quantity);
        Ok(unpack(&self.read(&Request::ReadDiscreteInputs(range))?, quantity))
    }

    /// 0x03: reads 1 to 125 holding registers from `start` on.
    ///
    /// # Errors
    /// [`Error`].
    pub fn read_holding_registers(&mut self, start: u16, quantity: u16) -> Result<Vec<u16>, Error> {
        let range = AddressRange::new(start, quantity);
        Ok(registers(&self.read(&Request::ReadHoldingRegisters(range))?).collect())
    }

    /// 0x04: reads 1 to 125 input registers from `start` on.
    ///
    /// # Errors
    /// [`Error`].
    pub fn read_input_registers(&mut self, start: u16, quantity: u16) -> Result<Vec<u16>, Error> {
        let range = AddressRange::new(start, quantity);
        Ok(registers(&self.read(&Request::ReadInputRegisters(range))?).collect())
    }

    /// 0x05: writes one coil.
    ///
    /// # Errors
    /// [`Error`].
    pub fn write_coil(&mut self, address: u16, on: bool) -> Result<(), Error> {
        let value = if on { COIL_ON } else { COIL_OFF };
        self.write(&Request::WriteSingleCoil { address, value })
    }

    /// 0x06: writes one holding register.
    ///
    /// # Errors
    /// [`Error`].
    pub fn write_register(&mut self, address: u16, value: u16) -> Result<(), Error> {
        self.write(&Request::WriteSingleRegister { address, value })
    }

    /// 0x0F: writes 1 to 1968 coils from `start` on.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Question`] where the values fit no frame.
    pub fn write_coils(&mut self, start: u16, values: &[bool]) -> Result<(), Error> {
        let quantity = u16::try_from(values.len()).map_err(|_| Error::Question)?;
        let mut data = vec![0u8; packed_len(quantity)];
        for (index, _) in values.iter().enumerate().filter(|(_, on)| **on) {
            data[index / 8] |= 1 << (index % 8);
        }
        self.write(&Request::WriteMultipleCoils { range: AddressRange::new(start, quantity), data: &data })
    }

    /// 0x10: writes 1 to 123 holding registers from `start` on.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Question`] where the values fit no frame.
    pub fn write_registers(&mut self, start: u16, values: &[u16]) -> Result<(), Error> {
        let quantity = u16::try_from(values.len()).map_err(|_| Error::Question)?;
        let data: Vec<u8> = values.iter().flat_map(|value| value.to_be_bytes()).collect();
        self.write(&Request::WriteMultipleRegisters {
            range: AddressRange::new(start, quantity),
            data: &data,
        })
    }

    /// 0x03: reads `count` numbers from holding registers, at most 125 registers in all; with `T` as `f32`, `i32`, `u64` and
    /// so on.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Question`] where they are more registers than there are.
    pub fn read_holding_values<T: RegisterValue>(
        &mut self,
        start: u16,
        count: u16,
        order: WordOrder,
    ) -> Result<Vec<T>, Error> {
        let quantity = count.checked_mul(T::WORDS).ok_or(Error::Question)?;
        Ok(value::decode(&self.read_holding_registers(start, quantity)?, order))
    }

    /// 0x04: reads `count` numbers from input registers, likewise.
    ///
    /// # Errors
    /// As [`Modbus::read_holding_values`].
    pub fn read_input_values<T: RegisterValue>(
        &mut self,
        start: u16,
        count: u16,
        order: WordOrder,
    ) -> Result<Vec<T>, Error> {
        let quantity = count.checked_mul(T::WORDS).ok_or(Error::Question)?;
        Ok(value::decode(&self.read_input_registers(start, quantity)?, order))
    }

    /// 0x10: writes numbers to holding registers, at most 123 registers in all.
    ///
    /// # Errors
    /// [`Error`]; [`Error::Question`] where the values fit no frame.
    pub fn write_values<T: RegisterValue>(
        &mut self,
        start: u16,
        values: &[T],
        order: WordOrder,
    ) -> Result<(), Error> {
        self.write_registers(start, &value::encode(values, order))
    }

    /// Any request; the answer's protocol data unit.
    ///
    /// # Errors
    /// [`Error`].
    pub fn request(&mut self, request: &Request<'_>) -> Result<Vec<u8>, Error> {
        let mut buffer = [0; FRAME_MAX];
        let frame = encode_request(self.unit, request, &mut buffer).map_err(|_| Error::Question)?;
        let expected = ExpectedResponse::new(self.unit, request);
        let ends_at_silence = |frame: &[u8]| expected.is_open() && expected.accepts(frame);
        let reply = self.client.exchange(frame, &expected, ends_at_silence)?;
        let pdu = Frame::decode(&reply).map_err(|_| Error::Answer)?.pdu;
        match Response::decode(pdu).map_err(|_| Error::Answer)? {
            Response::Exception { exception, .. } => Err(Error::Exception(exception)),
            _ => Ok(pdu.to_vec()),
        }
    }

    fn read(&mut self, request: &Request<'_>) -> Result<Vec<u8>, Error> {
        match Response::decode(&self.request(request)?) {
            Ok(Response::Read { data, .. }) => Ok(data.to_vec()),
            _ => Err(Error::Answer),
        }
    }

    fn write(&mut self, request: &Request<'_>) -> Result<(), Error> {
        if self.unit == BROADCAST {
            let mut buffer = [0; FRAME_MAX];
            let frame = encode_request(BROADCAST, request, &mut buffer).map_err(|_| Error::Question)?;
            return self.client.send(frame);
        }
        self.request(request).map(drop)
    }
}

fn unpack(data: &[u8], quantity: u16) -> Vec<bool> {
    (0..quantity).map(|index| bit(data, index)).collect()
}
