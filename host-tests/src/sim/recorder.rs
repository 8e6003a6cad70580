//! A recording that Wireshark opens: pcapng with one interface for each wire.
//!
//! | interface | link type | shows |
//! |---|---|---|
//! | a serial port, such as `host` and `rs485-a` | 250, RTAC serial | what was heard, cut where the line paused or the direction changed |
//! | a CAN port, such as `can` | 227, SocketCAN | frames that somebody acknowledged |
//!
//! Interfaces have the numbers and the names of the board's ports.
//!
//! Wireshark does not know by itself what a serial line carries: *Decode As…*, field *RTAC Serial*, Modbus RTU. On the
//! command line: `tshark -r FILE -d rtacser.data,mbrtu`. NST frames have the same CRC and show up as Modbus as well.

use super::moment::{MICROS, Moment, Nanos, SECONDS};
use jointbus_mcu_bridge::board::{Description, Port, PortKind, Topology};
use jointbus_protocol::can::{Frame, Id};

/// Link types.
const SOCKETCAN: u16 = 227;
const RTAC_SERIAL: u16 = 250;

/// Blocks of pcapng.
const SECTION_HEADER: u32 = 0x0A0D_0D0A;
const INTERFACE: u32 = 1;
const ENHANCED_PACKET: u32 = 6;

/// Options of an interface: its name, its time stamps in powers of ten.
const OPTION_NAME: u16 = 2;
const OPTION_RESOLUTION: u16 = 9;
const NANOSECONDS: u8 = 9;

/// Events of an RTAC serial capture: data sent, data received.
const SENT: u8 = 1;
const RECEIVED: u8 = 2;

/// Bits of a SocketCAN identifier.
const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;

/// Bytes in one direction without a pause.
#[derive(Debug, Default)]
struct Chunk {
    bytes: Vec<u8>,
    from_master: bool,
    start: Moment,
    last: Moment,
}

/// Collects what happens on the wires.
#[derive(Debug)]
pub struct Recorder {
    file: Vec<u8>,
    /// The chunk of each port, and the pause that ends one.
    chunks: Vec<(Chunk, Nanos)>,
}

impl Recorder {
    /// An empty recording of a board whose ports have these settings.
    #[must_use]
    pub fn new(board: &Description, network: &Topology) -> Self {
        let mut file = Vec::new();
        // byte order, version 1.0, length unknown
        let section = [&0x1A2B_3C4Du32.to_le_bytes()[..], &[1, 0, 0, 0], &u64::MAX.to_le_bytes()].concat();
        block(&mut file, SECTION_HEADER, &section);
        for port in board.ports {
            let link_type = if port.kind == PortKind::Can { SOCKETCAN } else { RTAC_SERIAL };
            let mut body = [&link_type.to_le_bytes()[..], &[0; 6]].concat();
            option(&mut body, OPTION_NAME, port.name.as_bytes());
            option(&mut body, OPTION_RESOLUTION, &[NANOSECONDS]);
            body.extend([0; 4]);
            block(&mut file, INTERFACE, &body);
        }
        // three and a half characters of ten bits
        let chunk = |baud: u32| (Chunk::default(), 35 * SECONDS / Nanos::from(baud.max(1)));
        let ports = network.ports.iter().take(board.ports.len());
        Self { file, chunks: ports.map(|port| chunk(port.baud())).collect() }
    }

    /// Bytes that ended at `now` on the line of a serial port.
    pub fn bytes(&mut self, port: Port, from_master: bool, now: Moment, bytes: &[u8]) {
        let index = port.index();
        let (chunk, pause) = &self.chunks[index];
        if chunk.from_master != from_master || now.saturating_duration_since(chunk.last) > *pause {
            self.flush(index);
        }
        let (chunk, _) = &mut self.chunks[index];
        if chunk.bytes.is_empty() {
            (chunk.start, chunk.from_master) = (now, from_master);
        }
        chunk.bytes.extend_from_slice(bytes);
        chunk.last = now;
    }

    /// A frame that ended at `now` on the bus of a CAN port.
    pub fn frame(&mut self, port: Port, now: Moment, frame: &Frame) {
        let id = match frame.id() {
            Id::Standard(id) => id.into(),
            Id::Extended(id) => id | EXTENDED,
        };
        let id = if frame.is_remote() { id | REMOTE } else { id };
        let mut packet = id.to_be_bytes().to_vec();
        packet.extend([frame.dlc().min(8), 0, 0, 0]);
        packet.extend(frame.data());
        self.packet(port, now, &packet);
    }

    /// The file so far.
    pub fn file(&mut self) -> &[u8] {
        (0..self.chunks.len()).for_each(|index| self.flush(index));
        &self.file
    }

    fn flush(&mut self, index: usize) {
        let chunk = std::mem::take(&mut self.chunks[index].0);
        if chunk.bytes.is_empty() {
            return;
        }
        let micros = chunk.start.as_nanos() / MICROS;
        let seconds = u32::try_from(micros / 1_000_000).unwrap_or(u32::MAX);
        let mut packet = seconds.to_be_bytes().to_vec();
        packet.extend(((micros % 1_000_000) as u32).to_be_bytes());
        // event, control lines, footer
        packet.extend([if chunk.from_master { SENT } else { RECEIVED }, 0, 0, 0]);
        packet.extend(chunk.bytes);
        self.packet(Port::new(index as u8), chunk.start, &packet);
    }

    fn packet(&mut self, port: Port, at: Moment, packet: &[u8]) {
        let [high, low] = [(at.as_nanos() >> 32) as u32, at.as_nanos() as u32];
        let length = u32::try_from(packet.len()).unwrap_or(u32::MAX);
        let mut body: Vec<u8> = [u32::from(port.number()), high, low, length, length]
            .iter()
            .flat_map(|field| field.to_le_bytes())
            .collect();
        body.extend_from_slice(packet);
        pad(&mut body);
        block(&mut self.file, ENHANCED_PACKET, &body);
    }
}

fn block(file: &mut Vec<u8>, kind: u32, body: &[u8]) {
    let length = (body.len() as u32 + 12).to_le_bytes();
    file.extend(kind.to_le_bytes());
    file.extend(length);
    file.extend_from_slice(body);
    file.extend(length);
}

fn option(body: &mut Vec<u8>, code: u16, value: &[u8]) {
    body.extend(code.to_le_bytes());
    body.extend((value.len() as u16).to_le_bytes());
    body.extend_from_slice(value);
    pad(body);
}

fn pad(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}

#[cfg(test)]
mod tests {
    use super::*;
    use jointbus_mcu_bridge::boards::stm32f405::{BOARD, CAN, RS485_A};

    /// The blocks of a file: kind and body.
    fn blocks(mut file: &[u8]) -> Vec<(u32, Vec<u8>)> {
        let mut blocks = Vec::new();
        while let Some((head, _)) = file.split_first_chunk::<8>() {
            let [kind, length] =
                [&head[..4], &head[4..]].map(|field| u32::from_le_bytes(field.try_into().unwrap()));
            let (block, rest) = file.split_at(length as usize);
            assert_eq!(block[block.len() - 4..], length.to_le_bytes());
            assert_eq!(length % 4, 0);
            blocks.push((kind, block[8..block.len() - 4].to_vec()));
            file = rest;
        }
        blocks
    }

    #[test]
    fn a_pause_or_the_other_direction_ends_a_packet() {
        let mut network = Topology::of(BOARD);
        network.ports[RS485_A.index()].rate = 10_000;
        let mut recorder = Recorder::new(BOARD, &network);
        let at = |micros: u64| Moment::from_nanos(micros * MICROS);
        recorder.bytes(RS485_A, true, at(10), &[1, 2]);
        recorder.bytes(RS485_A, true, at(30), &[3]);
        recorder.bytes(RS485_A, false, at(40), &[4]);
        recorder.bytes(RS485_A, false, at(90), &[5]);
        let frame = Frame::data_frame(Id::Extended(0x007F_0110), &[9; 3]).unwrap();
        recorder.frame(CAN, at(100), &frame);
        let blocks = blocks(recorder.file());
        assert_eq!(blocks[0].0, SECTION_HEADER);
        assert!(blocks[1..5].iter().all(|(kind, _)| *kind == INTERFACE));
        let packets: Vec<_> = blocks[5..].iter().map(|(_, body)| body.clone()).collect();
        let captured = |packet: &[u8]| packet[20..][..packet[12].into()].to_vec();
        assert_eq!(packets.len(), 4);
        assert_eq!(captured(&packets[0])[8..], [SENT, 0, 0, 0, 1, 2, 3]);
        assert_eq!(captured(&packets[1])[8..], [RECEIVED, 0, 0, 0, 4]);
        assert_eq!(captured(&packets[2]), [0x80, 0x7F, 0x01, 0x10, 3, 0, 0, 0, 9, 9, 9]);
        assert_eq!(captured(&packets[3])[12..], [5]);
    }
}
