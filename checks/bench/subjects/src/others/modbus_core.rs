//! modbus-core, which takes frames apart and puts them together; tables and dispatch are ours.

use modbus_core::rtu::server::encode_response;
use modbus_core::rtu::{Header, ResponseAdu, extract_frame};
use modbus_core::{Coils, Data, Exception, ExceptionResponse, FunctionCode, Request, Response, ResponsePdu};

use super::{BITS, REGISTERS, range};
use crate::{FRAME_MAX, Kind, Subject};

/// A server around the codec. It packs bits from a slice of `bool`, so that is what the tables are.
pub struct ModbusCore {
    coils: [bool; BITS],
    discrete_inputs: [bool; BITS],
    holding_registers: [u16; REGISTERS],
    input_registers: [u16; REGISTERS],
}

impl ModbusCore {
    fn answer<'a>(
        &mut self,
        request: Request<'a>,
        pdu: &'a [u8],
        data: &'a mut [u8; FRAME_MAX],
    ) -> Result<Response<'a>, Exception> {
        let read_bits = |table: &[bool], first, count: u16, data| {
            let bits = table.get(range(first, count.into())).ok_or(Exception::IllegalDataAddress)?;
            Coils::from_bools(bits, data).map_err(|_| Exception::IllegalDataValue)
        };
        let read_registers = |table: &[u16], first, count: u16, data| {
            let words = table.get(range(first, count.into())).ok_or(Exception::IllegalDataAddress)?;
            Data::from_words(words, data).map_err(|_| Exception::IllegalDataValue)
        };
        Ok(match request {
            Request::ReadCoils(first, count) => {
                Response::ReadCoils(read_bits(&self.coils, first, count, data)?)
            }
            Request::ReadDiscreteInputs(first, count) => {
                Response::ReadDiscreteInputs(read_bits(&self.discrete_inputs, first, count, data)?)
            }
            Request::ReadHoldingRegisters(first, count) => {
                Response::ReadHoldingRegisters(read_registers(&self.holding_registers, first, count, data)?)
            }
            Request::ReadInputRegisters(first, count) => {
                Response::ReadInputRegisters(read_registers(&self.input_registers, first, count, data)?)
            }
            Request::WriteSingleCoil(first, state) => {
                *self.coils.get_mut(usize::from(first)).ok_or(Exception::IllegalDataAddress)? = state;
                // its own `Response::WriteSingleCoil` leaves the value out, which is no Modbus: the request comes back
                Response::Custom(FunctionCode::WriteSingleCoil, &pdu[1..])
            }
            Request::WriteSingleRegister(first, value) => {
                let place = self.holding_registers.get_mut(usize::from(first));
                *place.ok_or(Exception::IllegalDataAddress)? = value;
                Response::WriteSingleRegister(first, value)
            }
            Request::WriteMultipleCoils(first, coils) => {
                let places = self.coils.get_mut(range(first, coils.len()));
                let places = places.ok_or(Exception::IllegalDataAddress)?;
                places.iter_mut().zip(coils).for_each(|(place, coil)| *place = coil);
                Response::WriteMultipleCoils(first, coils.len() as u16)
            }
            Request::WriteMultipleRegisters(first, words) => {
                let places = self.holding_registers.get_mut(range(first, words.len()));
                let places = places.ok_or(Exception::IllegalDataAddress)?;
                places.iter_mut().zip(words).for_each(|(place, word)| *place = word);
                Response::WriteMultipleRegisters(first, words.len() as u16)
            }
            _ => return Err(Exception::IllegalFunction),
        })
    }
}

impl Subject for ModbusCore {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self {
            coils: [false; BITS],
            discrete_inputs: [false; BITS],
            holding_registers: [0; REGISTERS],
            input_registers: [0; REGISTERS],
        }
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        let Some(length) = frame.len().checked_sub(3) else { return 0 };
        let Ok(Some(decoded)) = extract_frame(frame, length) else { return 0 };
        let hdr = Header { slave: decoded.slave };
        if hdr.slave != 1 {
            return 0;
        }
        let Ok(request) = Request::try_from(decoded.pdu) else { return 0 };
        let mut data = [0; FRAME_MAX];
        let response = self.answer(request, decoded.pdu, &mut data);
        let pdu = response
            .map_err(|exception| ExceptionResponse { function: FunctionCode::from(request), exception });
        encode_response(ResponseAdu { hdr, pdu: ResponsePdu(pdu) }, out).unwrap_or(0)
    }
}
