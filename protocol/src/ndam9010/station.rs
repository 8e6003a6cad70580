use super::{MODULES_MAX, Module, UNIT_MAX, dispatcher};
use crate::error::error_text;
use crate::modbus::server::{Destination, Failure, NoResponse, serve_ascii, serve_rtu};
use crate::modbus::{BROADCAST, Request, ascii};
use crate::wire::Writer;

/// Function code, address, and value or quantity.
const WRITE_RESPONSE: usize = 5;

/// Why a station can't be configured so.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StationError {
    /// A station has one to eight modules.
    Modules,
    /// The start ID is 0 or the last module's unit would pass 247.
    StartId,
}

/// A station: up to eight modules, each a unit of its own from the start ID on. The station itself has no address.
#[derive(Debug, Clone)]
pub struct Station<M, const N: usize> {
    modules: [M; N],
    start_id: u8,
}

impl<M: Module, const N: usize> Station<M, N> {
    /// A station whose first module is unit `start_id`, 1 to 247.
    ///
    /// # Errors
    /// [`StationError`] where there are too many modules or a unit passes 247.
    pub fn new(modules: [M; N], start_id: u8) -> Result<Self, StationError> {
        if N == 0 || N > MODULES_MAX {
            return Err(StationError::Modules);
        }
        let steps = u8::try_from(N.saturating_sub(1)).map_err(|_| StationError::Modules)?;
        match start_id.checked_add(steps) {
            Some(last) if start_id > 0 && last <= UNIT_MAX => Ok(Self { modules, start_id }),
            _ => Err(StationError::StartId),
        }
    }

    /// The modules, module ID 1 first.
    pub const fn modules(&mut self) -> &mut [M; N] {
        &mut self.modules
    }

    /// Answers an RTU frame into `out`.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve<'b>(&mut self, frame: &[u8], out: &'b mut [u8]) -> Result<&'b [u8], NoResponse> {
        let (start, modules) = (self.start_id, &mut self.modules);
        serve_rtu(
            frame,
            |unit| audience(start, N, unit),
            |unit, request, writer| answer(start, modules, unit, request, writer),
            out,
        )
    }

    /// Answers a frame of Modbus ASCII into `out`: the whole frame in characters.
    ///
    /// # Errors
    /// [`NoResponse`]: why there is no answer.
    pub fn serve_ascii<'b>(
        &mut self,
        frame: &ascii::Frame<'_>,
        out: &'b mut [u8],
    ) -> Result<&'b [u8], NoResponse> {
        let (start, modules) = (self.start_id, &mut self.modules);
        serve_ascii(
            frame,
            |unit| audience(start, N, unit),
            |unit, request, writer| answer(start, modules, unit, request, writer),
            out,
        )
    }
}

/// Place of a unit's module.
fn place(start: u8, unit: u8) -> Option<usize> {
    unit.checked_sub(start).map(usize::from)
}

fn audience(start: u8, modules: usize, unit: u8) -> Destination {
    match place(start, unit) {
        _ if unit == BROADCAST => Destination::Broadcast,
        Some(place) if place < modules => Destination::Unit,
        _ => Destination::Other,
    }
}

fn answer<M: Module>(
    start: u8,
    modules: &mut [M],
    unit: u8,
    request: &Request<'_>,
    writer: &mut Writer<'_>,
) -> Result<(), Failure> {
    match place(start, unit).and_then(|place| modules.get_mut(place)) {
        Some(module) => dispatcher::answer(module, request, writer),
        None => broadcast(modules, request),
    }
}

/// Every module checks a broadcast for itself; the last refusal is told.
fn broadcast<M: Module>(modules: &mut [M], request: &Request<'_>) -> Result<(), Failure> {
    let mut result = Ok(());
    for module in modules {
        // nobody gets to see the response
        let mut unseen = [0; WRITE_RESPONSE];
        if let refused @ Err(_) = dispatcher::answer(module, request, &mut Writer::new(&mut unseen)) {
            result = refused;
        }
    }
    result
}

error_text! {
    StationError {
        StationError::Modules => ("a station has one to eight modules"),
        StationError::StartId => ("the units are not within 1 to 247"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::rtu;
    use crate::ndam9010::{Layout, RamModule};

    fn station() -> Station<RamModule, 3> {
        let layout = Layout { digital_outputs: 8, ..Layout::default() };
        Station::new([(); 3].map(|()| RamModule::new(layout)), 5).unwrap()
    }

    #[test]
    fn units_follow_the_start_id_and_end_at_247() {
        let layout = Layout::default();
        let make = |start| Station::new([(); 8].map(|()| RamModule::new(layout)), start).err();
        assert_eq!(make(0), Some(StationError::StartId));
        assert_eq!(make(1), None);
        assert_eq!(make(240), None);
        assert_eq!(make(241), Some(StationError::StartId));
        assert_eq!(Station::<RamModule, 0>::new([], 1).err(), Some(StationError::Modules));
        assert_eq!(
            Station::new([(); 9].map(|()| RamModule::new(layout)), 1).err(),
            Some(StationError::Modules)
        );
    }

    #[test]
    fn each_module_is_a_unit_and_a_broadcast_reaches_all() {
        let mut station = station();
        let (mut frame, mut out) = ([0; 16], [0; 16]);
        let request = Request::WriteSingleCoil { address: 0x0200, value: 0xFF00 };
        let sent = rtu::encode_request(6, &request, &mut frame).unwrap();
        assert_eq!(station.serve(sent, &mut out), Ok(sent));
        assert_eq!(station.modules().each_ref().map(|module| module.outputs), [0, 1, 0]);
        for unit in [4, 8] {
            let sent = rtu::encode_request(unit, &request, &mut frame).unwrap();
            assert_eq!(station.serve(sent, &mut out), Err(NoResponse::OtherUnit));
        }
        let sent = rtu::encode_request(0, &request, &mut frame).unwrap();
        assert_eq!(station.serve(sent, &mut out), Err(NoResponse::Broadcast(None)));
        assert_eq!(station.modules().each_ref().map(|module| module.outputs), [1, 1, 1]);
        let read = Request::ReadCoils(crate::modbus::AddressRange::new(0x0200, 1));
        let sent = rtu::encode_request(0, &read, &mut frame).unwrap();
        assert_eq!(station.serve(sent, &mut out), Err(NoResponse::BroadcastRead));
    }

    #[test]
    fn in_ascii_it_answers_the_same() {
        let mut station = station();
        let (mut characters, mut content, mut out) = ([0; 32], [0; 16], [0; 32]);
        let request = Request::WriteSingleCoil { address: 0x0200, value: 0xFF00 };
        let sent = ascii::encode_request(6, &request, &mut characters).unwrap();
        assert_eq!(sent, b":06050200FF00F4\r\n");
        let frame = ascii::Frame::decode(sent, &mut content).unwrap();
        assert_eq!(station.serve_ascii(&frame, &mut out), Ok(sent));
        assert_eq!(station.modules().each_ref().map(|module| module.outputs), [0, 1, 0]);
        let frame = ascii::Frame { unit: 9, ..frame };
        assert_eq!(station.serve_ascii(&frame, &mut out), Err(NoResponse::OtherUnit));
        let response = ascii::Frame { unit: 6, pdu: &[0x83, 2] };
        assert_eq!(station.serve_ascii(&response, &mut out), Err(NoResponse::NoRequest));
    }
}
