//! mbus-server over a transport in memory, with queues of one place, as its documentation advises for small parts.

use core::cell::UnsafeCell;

use heapless::Vec;
use mbus_core::data_unit::common::MAX_ADU_FRAME_LEN;
use mbus_core::errors::MbusError;
use mbus_core::models::coil::CoilState;
use mbus_core::transport::{
    ModbusConfig, ModbusSerialConfig, SerialMode, Transport, TransportError, TransportType, UnitIdOrSlaveAddr,
};
use mbus_server::{
    ResilienceConfig, ServerCoilHandler, ServerDiagnosticsHandler, ServerDiscreteInputHandler,
    ServerExceptionHandler, ServerFifoHandler, ServerFileRecordHandler, ServerHoldingRegisterHandler,
    ServerInputRegisterHandler, ServerServices,
};

use super::{BITS, REGISTERS, range};
use crate::{FRAME_MAX, Kind, Subject};

/// Where the transport finds the request and leaves the answer: the server keeps the transport to itself.
struct Mailbox(UnsafeCell<Mail>);

struct Mail {
    request: [u8; FRAME_MAX],
    /// 0 for no request: the line was silent, which ends a frame.
    request_length: usize,
    answer: [u8; FRAME_MAX],
    /// 0 for no answer.
    answer_length: usize,
}

// SAFETY: the programs that measure have one thread.
unsafe impl Sync for Mailbox {}

static MAILBOX: Mailbox = Mailbox(UnsafeCell::new(Mail {
    request: [0; FRAME_MAX],
    request_length: 0,
    answer: [0; FRAME_MAX],
    answer_length: 0,
}));

impl Mailbox {
    fn with<T>(&self, user: impl FnOnce(&mut Mail) -> T) -> T {
        // SAFETY: one thread, and no user calls another.
        user(unsafe { &mut *self.0.get() })
    }
}

struct Memory;

impl Transport for Memory {
    type Error = TransportError;
    const TRANSPORT_TYPE: TransportType = TransportType::StdSerial(SerialMode::Rtu);

    fn connect(&mut self, _: &ModbusConfig) -> Result<(), TransportError> {
        Ok(())
    }

    fn disconnect(&mut self) -> Result<(), TransportError> {
        Ok(())
    }

    fn send(&mut self, frame: &[u8]) -> Result<(), TransportError> {
        MAILBOX.with(|mail| {
            let place = mail.answer.get_mut(..frame.len()).ok_or(TransportError::BufferTooSmall)?;
            place.copy_from_slice(frame);
            mail.answer_length = frame.len();
            Ok(())
        })
    }

    fn recv(&mut self) -> Result<Vec<u8, MAX_ADU_FRAME_LEN>, TransportError> {
        MAILBOX.with(|mail| {
            let request = &mail.request[..core::mem::take(&mut mail.request_length)];
            match request {
                [] => Err(TransportError::FramingError),
                request => Vec::from_slice(request).map_err(|_| TransportError::BufferTooSmall),
            }
        })
    }

    fn is_connected(&self) -> bool {
        true
    }
}

/// The tables.
struct Tables {
    coils: [u8; BITS / 8],
    discrete_inputs: [u8; BITS / 8],
    holding_registers: [u16; REGISTERS],
    input_registers: [u16; REGISTERS],
}

/// Packs bits of a table.
fn read_bits(table: &[u8], first: u16, count: u16, out: &mut [u8]) -> Result<u8, MbusError> {
    let bits = range(first, count.into());
    let length = bits.len().div_ceil(8);
    if bits.end > 8 * table.len() || length > out.len() {
        return Err(MbusError::InvalidAddress);
    }
    out[..length].fill(0);
    for (index, bit) in bits.enumerate() {
        out[index / 8] |= (table[bit / 8] >> (bit % 8) & 1) << (index % 8);
    }
    Ok(length as u8)
}

fn read_registers(table: &[u16], first: u16, count: u16, out: &mut [u8]) -> Result<u8, MbusError> {
    let words = table.get(range(first, count.into())).ok_or(MbusError::InvalidAddress)?;
    let out = out.get_mut(..2 * words.len()).ok_or(MbusError::InvalidAddress)?;
    out.chunks_exact_mut(2).zip(words).for_each(|(place, word)| place.copy_from_slice(&word.to_be_bytes()));
    Ok(out.len() as u8)
}

impl ServerExceptionHandler for Tables {}
impl ServerFifoHandler for Tables {}
impl ServerFileRecordHandler for Tables {}
impl ServerDiagnosticsHandler for Tables {}

impl ServerCoilHandler for Tables {
    fn read_coils_request(
        &mut self,
        _: u16,
        _: UnitIdOrSlaveAddr,
        first: u16,
        count: u16,
        out: &mut [u8],
    ) -> Result<u8, MbusError> {
        read_bits(&self.coils, first, count, out)
    }

    fn write_single_coil_request(
        &mut self,
        number: u16,
        unit: UnitIdOrSlaveAddr,
        first: u16,
        state: CoilState,
    ) -> Result<(), MbusError> {
        self.write_multiple_coils_request(number, unit, first, 1, &[u8::from(state == CoilState::On)])
    }

    fn write_multiple_coils_request(
        &mut self,
        _: u16,
        _: UnitIdOrSlaveAddr,
        first: u16,
        count: u16,
        values: &[u8],
    ) -> Result<(), MbusError> {
        let bits = range(first, count.into());
        if bits.end > BITS || values.len() < bits.len().div_ceil(8) {
            return Err(MbusError::InvalidAddress);
        }
        for (index, bit) in bits.enumerate() {
            let (place, mask) = (&mut self.coils[bit / 8], 1 << (bit % 8));
            let value = values[index / 8] >> (index % 8) & 1;
            *place = if value == 1 { *place | mask } else { *place & !mask };
        }
        Ok(())
    }
}

impl ServerDiscreteInputHandler for Tables {
    fn read_discrete_inputs_request(
        &mut self,
        _: u16,
        _: UnitIdOrSlaveAddr,
        first: u16,
        count: u16,
        out: &mut [u8],
    ) -> Result<u8, MbusError> {
        read_bits(&self.discrete_inputs, first, count, out)
    }
}

impl ServerHoldingRegisterHandler for Tables {
    fn read_multiple_holding_registers_request(
        &mut self,
        _: u16,
        _: UnitIdOrSlaveAddr,
        first: u16,
        count: u16,
        out: &mut [u8],
    ) -> Result<u8, MbusError> {
        read_registers(&self.holding_registers, first, count, out)
    }

    fn write_single_register_request(
        &mut self,
        number: u16,
        unit: UnitIdOrSlaveAddr,
        first: u16,
        value: u16,
    ) -> Result<(), MbusError> {
        self.write_multiple_registers_request(number, unit, first, &[value])
    }

    fn write_multiple_registers_request(
        &mut self,
        _: u16,
        _: UnitIdOrSlaveAddr,
        first: u16,
        values: &[u16],
    ) -> Result<(), MbusError> {
        let places = self.holding_registers.get_mut(range(first, values.len()));
        places.ok_or(MbusError::InvalidAddress)?.copy_from_slice(values);
        Ok(())
    }
}

impl ServerInputRegisterHandler for Tables {
    fn read_multiple_input_registers_request(
        &mut self,
        _: u16,
        _: UnitIdOrSlaveAddr,
        first: u16,
        count: u16,
        out: &mut [u8],
    ) -> Result<u8, MbusError> {
        read_registers(&self.input_registers, first, count, out)
    }
}

/// The server.
pub struct Mbus(ServerServices<Memory, Tables, 1>);

impl Subject for Mbus {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        let tables = Tables {
            coils: [0; BITS / 8],
            discrete_inputs: [0; BITS / 8],
            holding_registers: [0; REGISTERS],
            input_registers: [0; REGISTERS],
        };
        let config = ModbusConfig::Serial(ModbusSerialConfig::default());
        let unit = UnitIdOrSlaveAddr::new(1).expect("1 is a unit");
        let resilience = ResilienceConfig::default();
        let mut server = ServerServices::with_queue_depth(Memory, tables, config, unit, resilience);
        server.connect().expect("memory is always connected");
        Self(server)
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        // what it has not answered it keeps, until the transport tells of the end of the frame
        if MAILBOX.with(|mail| mail.answer_length == 0) {
            self.0.poll();
        }
        MAILBOX.with(|mail| {
            mail.request[..frame.len()].copy_from_slice(frame);
            (mail.request_length, mail.answer_length) = (frame.len(), 0);
        });
        self.0.poll();
        MAILBOX.with(|mail| {
            let length = mail.answer_length;
            out[..length].copy_from_slice(&mail.answer[..length]);
            length
        })
    }
}
