//! The general server over tables in memory, in all its framings: they answer alike, an answer fits its request, and
//! who is refused has changed nothing.
#![no_main]

use jointbus_fuzz::{Script, check_response, sealed};
use jointbus_protocol::checksum;
use jointbus_protocol::modbus::identification::{ConformityLevel, ObjectId};
use jointbus_protocol::modbus::server::{
    self, BitWriter, Bits, NoResponse, RamTables, RegisterWriter, Registers, Server,
};
use jointbus_protocol::modbus::{
    AddressRange, BROADCAST, DiagnosticSubfunction, ExceptionCode, FunctionCode, PDU_MAX, ascii, rtu, tcp,
};
use libfuzzer_sys::fuzz_target;

const UNIT: u8 = 7;

/// Every function code that there is, over tables with odd ends.
#[derive(Clone, PartialEq, Debug)]
struct Everything {
    tables: RamTables<17, 250, 130, 260>,
    text: Vec<u8>,
}

impl Server for Everything {
    fn supports(&self, function: FunctionCode) -> bool {
        !matches!(function, FunctionCode::Unknown(_))
    }
    fn read_coils(&mut self, range: AddressRange, bits: &mut BitWriter<'_>) -> Result<(), ExceptionCode> {
        self.tables.read_coils(range, bits)
    }
    fn read_discrete_inputs(
        &mut self,
        range: AddressRange,
        bits: &mut BitWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.tables.read_discrete_inputs(range, bits)
    }
    fn read_holding_registers(
        &mut self,
        range: AddressRange,
        all: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.tables.read_holding_registers(range, all)
    }
    fn read_input_registers(
        &mut self,
        range: AddressRange,
        all: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.tables.read_input_registers(range, all)
    }
    fn write_coils(&mut self, range: AddressRange, bits: Bits<'_>) -> Result<(), ExceptionCode> {
        assert_eq!(bits.len(), range.quantity);
        self.tables.write_coils(range, bits)
    }
    fn write_registers(
        &mut self,
        range: AddressRange,
        registers: Registers<'_>,
    ) -> Result<(), ExceptionCode> {
        assert_eq!(registers.len(), usize::from(range.quantity));
        self.tables.write_registers(range, registers)
    }
    fn mask_write_register(&mut self, address: u16, and: u16, or: u16) -> Result<(), ExceptionCode> {
        self.tables.mask_write_register(address, and, or)
    }
    fn read_write_registers(
        &mut self,
        write: AddressRange,
        values: Registers<'_>,
        read: AddressRange,
        registers: &mut RegisterWriter<'_>,
    ) -> Result<(), ExceptionCode> {
        self.tables.read_write_registers(write, values, read, registers)
    }
    fn exception_status(&mut self) -> Result<u8, ExceptionCode> {
        Ok(0x5A)
    }
    fn diagnostics(
        &mut self,
        what: DiagnosticSubfunction,
        data: Registers<'_>,
    ) -> Result<Option<u16>, ExceptionCode> {
        assert_ne!(what, DiagnosticSubfunction::ForceListenOnly);
        assert!(what == DiagnosticSubfunction::ReturnQueryData || data.len() == 1);
        match what {
            DiagnosticSubfunction::Unknown(_) => Err(ExceptionCode::IllegalFunction),
            DiagnosticSubfunction::BusMessageCount => Ok(Some(77)),
            _ => Ok(None),
        }
    }
    fn comm_event_counter(&mut self) -> Result<(u16, u16), ExceptionCode> {
        Ok((0xFFFF, 9))
    }
    fn server_id(&mut self) -> Result<&[u8], ExceptionCode> {
        Ok(&self.text)
    }
    fn conformity(&self) -> ConformityLevel {
        ConformityLevel::ExtendedIndividual
    }
    fn identification(&self, object: ObjectId) -> Option<&[u8]> {
        match object.code() {
            0..=4 | 0x80..=0x90 => Some(&self.text),
            _ => None,
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let mut script = Script(data);
    let tables =
        RamTables { discrete_inputs: [0xA5; 250], input_registers: [0x1234; 260], ..RamTables::new() };
    let mut server = Everything { tables, text: script.record().to_vec() };
    while !script.is_empty() {
        let (way, room) = (script.byte(), script.byte());
        let pdu = script.record();
        let pdu = &pdu[..pdu.len().min(PDU_MAX)];
        let before = server.clone();
        if way & 0x0F == 0 {
            // broadcast, too little room, or no frame at all
            let mut out = vec![0xEE; room.into()];
            let to = if way & 0x10 == 0 { BROADCAST } else { UNIT };
            let outcome = match way & 0x20 {
                0 => server::rtu(&mut server, UNIT, &sealed(&[&[to][..], pdu].concat()), &mut out),
                _ => server::rtu_with(checksum::crc16_small, &mut server, UNIT, pdu, &mut out),
            };
            match outcome {
                Ok(reply) => drop((way & 0x20 == 0).then(|| check_response(UNIT, pdu, reply))),
                Err(NoResponse::Broadcast(None)) => assert_eq!(to, BROADCAST),
                Err(_) => assert_eq!(server, before, "silence, and yet a change"),
            }
            continue;
        }
        all_framings(&mut server, &before, pdu);
    }
    server.tables.input_registers[0] = 0xABCD;
    let mut out = [0; 300];
    let reply = server::rtu(&mut server, UNIT, &sealed(&[UNIT, 4, 0, 0, 0, 1]), &mut out);
    assert_eq!(reply, Ok(&sealed(&[UNIT, 4, 2, 0xAB, 0xCD])[..]));
});

/// The same request in every framing, each to a server in the same state.
fn all_framings(server: &mut Everything, before: &Everything, pdu: &[u8]) {
    let (mut bare, mut over_tcp, mut over_ascii) = (before.clone(), before.clone(), before.clone());
    let (mut a, mut b, mut c, mut d) = ([0; 300], [0; 300], [0; 300], [0; 600]);
    let expected = server::respond(&mut bare, pdu, &mut a).map(<[u8]>::to_vec);
    let tcp_reply = server::tcp(&mut over_tcp, &tcp::Frame { transaction: 3, unit: UNIT, pdu }, &mut b);
    let ascii_reply = server::ascii(&mut over_ascii, UNIT, &ascii::Frame { unit: UNIT, pdu }, &mut d);
    let rtu_reply = server::rtu(server, UNIT, &sealed(&[&[UNIT][..], pdu].concat()), &mut c);
    assert_eq!(tcp_reply.map(|reply| reply[tcp::HEADER_LENGTH..].to_vec()), expected);
    let mut bytes = [0; 300];
    let ascii_reply = ascii_reply.map(|frame| ascii::Frame::decode(frame, &mut bytes).unwrap().pdu.to_vec());
    assert_eq!(ascii_reply, expected);
    if pdu.is_empty() {
        assert!(rtu_reply.is_err());
        return;
    }
    assert_eq!(rtu_reply.map(|frame| rtu::Frame::decode(frame).unwrap().pdu.to_vec()), expected);
    assert!(*server == bare && bare == over_tcp && over_tcp == over_ascii);
    match expected {
        Ok(reply) => {
            assert!(reply.len() <= PDU_MAX);
            let refused = check_response(UNIT, pdu, &sealed(&[&[UNIT][..], &reply].concat()));
            let reads = matches!(pdu[0], 1..=4 | 7 | 8 | 0x0B | 0x11 | 0x2B);
            if refused || reads {
                assert_eq!(server, before);
            }
        }
        Err(silence) => {
            assert_eq!(silence, NoResponse::NoRequest);
            assert_eq!(server, before);
        }
    }
}
