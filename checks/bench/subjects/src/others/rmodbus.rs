//! rmodbus with its storage, the answer in a vector of `heapless`.

use heapless::Vec;
use rmodbus::ModbusProto;
use rmodbus::server::ModbusFrame;
use rmodbus::server::storage::ModbusStorage;

use super::{BITS, REGISTERS};
use crate::{FRAME_MAX, Kind, Subject};

/// The server, which is no more than its storage.
pub struct Rmodbus(ModbusStorage<BITS, BITS, REGISTERS, REGISTERS>);

impl Subject for Rmodbus {
    const KIND: Kind = Kind::Server;

    fn new() -> Self {
        Self(ModbusStorage::new())
    }

    fn serve(&mut self, frame: &[u8], out: &mut [u8; FRAME_MAX]) -> usize {
        let mut response = Vec::<u8, FRAME_MAX>::new();
        let mut frame = ModbusFrame::new(1, frame, ModbusProto::Rtu, &mut response);
        if frame.parse().is_err() {
            return 0;
        }
        if frame.processing_required {
            let processed =
                if frame.readonly { frame.process_read(&self.0) } else { frame.process_write(&mut self.0) };
            if processed.is_err() {
                return 0;
            }
        }
        if !frame.response_required || frame.finalize_response().is_err() {
            return 0;
        }
        out[..response.len()].copy_from_slice(&response);
        response.len()
    }
}
