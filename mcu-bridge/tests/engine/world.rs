//! An engine with devices on its buses, in virtual time: every call goes on to the engine's next deadline.

use jointbus_mcu_bridge::board::Port;
use jointbus_mcu_bridge::boards::stm32f405::{CAN, Engine, RS485_A, RS485_B};
use jointbus_mcu_bridge::engine::{Action, Identity, ResetCause};
use jointbus_protocol::can::Frame;
use jointbus_protocol::modbus::{self, ascii, rtu};
use jointbus_protocol::ndam9010::{Layout, RamModule, Station};
use jointbus_protocol::nst::can::{Outcome, Reassembler};
use jointbus_protocol::nst::{self, Daq, RamHardware, Sample, SignEncoding};
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::Writer;

pub(crate) const SAMPLE: Sample = Sample([1000, -2000, 3000, -4, 5, -6]);

pub(crate) struct World {
    pub(crate) engine: Engine,
    pub(crate) now: Instant,
    pub(crate) can_daq: Daq<RamHardware>,
    pub(crate) serial_daq: Daq<RamHardware>,
    pub(crate) station: Station<RamModule, 1>,
    /// Ports whose devices don't answer.
    pub(crate) unplugged: Vec<Port>,
    /// Answers are kept back instead of sent.
    pub(crate) held_back: Option<Vec<(Port, Vec<u8>)>>,
    /// What the engine asked for, but for frames to be given up.
    pub(crate) actions: Vec<Action>,
    /// CAN frames are to be given up.
    pub(crate) aborting: bool,
    /// Every frame that went onto a serial bus, and when.
    pub(crate) sent: Vec<(Instant, Port, Vec<u8>)>,
    /// Whether anybody acknowledges CAN frames.
    pub(crate) acknowledge: bool,
    /// The read reply has function code 0x10, as the manual prints it.
    pub(crate) quirk: bool,
    /// RS485 ports hear what they send, with this in place of it where it is not empty.
    pub(crate) echo: Option<Vec<u8>>,
    reassembler: Reassembler<1>,
    host: Vec<u8>,
}

impl World {
    pub(crate) fn new() -> Self {
        let daq = |factor: i32| {
            let mut hardware = RamHardware::new(1);
            hardware.sample = Sample(SAMPLE.0.map(|axis| axis * factor));
            Daq::new(hardware, SignEncoding::TwosComplement)
        };
        let layout = Layout { digital_inputs: 14, digital_outputs: 10, analog_inputs: 8, analog_outputs: 4 };
        let start = Instant::from_micros(1_000_000);
        let identity = Identity { version: [1, 2, 3], reset_cause: ResetCause::PowerOn };
        Self {
            engine: Engine::new(identity, start),
            now: start,
            can_daq: daq(1),
            serial_daq: daq(2),
            station: Station::new([RamModule::new(layout)], 1).unwrap(),
            unplugged: Vec::new(),
            held_back: None,
            actions: Vec::new(),
            aborting: false,
            sent: Vec::new(),
            acknowledge: true,
            quirk: false,
            echo: None,
            reassembler: Reassembler::new(1, Duration::from_millis(10)),
            host: Vec::new(),
        }
    }

    /// Sends bytes from the host and lets `span` pass; what came back.
    pub(crate) fn exchange(&mut self, bytes: &[u8], span: Duration) -> Vec<u8> {
        self.engine.receive(Port::HOST, bytes, self.now);
        self.pass(span);
        std::mem::take(&mut self.host)
    }

    /// Lets time pass, from deadline to deadline.
    pub(crate) fn pass(&mut self, span: Duration) {
        let end = self.now.saturating_add(span);
        loop {
            self.settle();
            match self.engine.poll_at().filter(|deadline| *deadline <= end) {
                Some(deadline) => {
                    // buses take turns here, so one may hold another up for the length of a frame or two
                    assert!(
                        self.now.saturating_duration_since(deadline) < Duration::from_millis(5),
                        "nothing is done about {deadline:?}"
                    );
                    self.now = self.now.max(deadline).saturating_add(Duration::from_micros(1));
                }
                None => break,
            }
            self.poll();
        }
        self.now = end;
        self.poll();
        self.settle();
    }

    /// Lets the engine do what is due, and notes what it asks for.
    pub(crate) fn poll(&mut self) {
        while let Some(action) = self.engine.poll(self.now) {
            match action {
                Action::AbortCan(CAN) => self.aborting = true,
                other => self.actions.push(other),
            }
        }
    }

    /// Takes what the engine asked for since this was asked last, but for outputs that were written.
    pub(crate) fn take_actions(&mut self) -> Vec<Action> {
        self.poll();
        let mut actions = std::mem::take(&mut self.actions);
        actions.retain(|action| *action != Action::Outputs);
        actions
    }

    /// Carries bytes and frames until nothing moves.
    fn settle(&mut self) {
        loop {
            self.poll();
            let mut moved = self.host_output();
            for port in [RS485_A, RS485_B] {
                moved |= self.serial_bus(port);
            }
            moved |= self.can_bus();
            if !moved {
                break;
            }
        }
    }

    fn host_output(&mut self) -> bool {
        let pending = self.engine.output(Port::HOST).to_vec();
        self.engine.advance(Port::HOST, pending.len());
        self.host.extend_from_slice(&pending);
        !pending.is_empty()
    }

    fn serial_bus(&mut self, port: Port) -> bool {
        let mut frame = Vec::new();
        while let pending @ [_, ..] = self.engine.output(port) {
            // as much as a driver's queue happens to take
            let taken = pending.len().min(7 + frame.len() % 5);
            frame.extend_from_slice(&pending[..taken]);
            self.engine.advance(port, taken);
        }
        if frame.is_empty() {
            return false;
        }
        self.tick(frame.len() as u64 * 87);
        if let Some(other) = &self.echo {
            let echo = if other.is_empty() { &frame } else { other };
            self.engine.receive(port, echo, self.now);
        }
        self.engine.transmit_complete(port, self.now);
        self.sent.push((self.now, port, frame.clone()));
        let mut out = [0; 600];
        let reply = match port {
            RS485_A => self.serial_daq.serve_serial(&frame, &mut out).ok(),
            _ if frame.first() == Some(&b':') => {
                let mut content = [0; ascii::CONTENT_MAX + 1];
                let frame = ascii::Frame::decode(&frame, &mut content).expect("an ASCII frame");
                self.station.serve_ascii(&frame, &mut out).ok()
            }
            _ => self.station.serve(&frame, &mut out).ok(),
        };
        let Some(reply) = reply.map(<[u8]>::to_vec).filter(|_| !self.unplugged.contains(&port)) else {
            return true;
        };
        if let Some(held_back) = &mut self.held_back {
            held_back.push((port, reply));
            return true;
        }
        // in two pieces, as a driver hands them over
        let (first, rest) = reply.split_at(reply.len() / 2);
        self.tick(first.len() as u64 * 87);
        self.engine.receive(port, first, self.now);
        self.tick(rest.len() as u64 * 87);
        self.engine.receive(port, rest, self.now);
        true
    }

    fn can_bus(&mut self) -> bool {
        if std::mem::take(&mut self.aborting) {
            self.engine.frames_aborted(CAN, self.now);
            return true;
        }
        let Some(frame) = self.engine.next_frame(CAN) else { return false };
        if !self.acknowledge {
            return true;
        }
        self.tick(130);
        self.engine.frame_sent(CAN, self.now);
        if self.unplugged.contains(&CAN) {
            return true;
        }
        let (mut data, mut out) = ([0; 250], [0; 252]);
        let Some(Outcome::Complete { source, body, .. }) = self.reassembler.push(&frame, self.now).outcome
        else {
            return true;
        };
        let address = self.can_daq.address();
        if let Ok(reply) = self.can_daq.serve(address, body, &mut data) {
            let mut writer = Writer::new(&mut out);
            reply.encode(&mut writer).unwrap();
            let length = writer.finish().len();
            if self.quirk {
                out[0] = 0x10;
            }
            let frames: Vec<Frame> = nst::can::segment(address, source, &out[..length]).unwrap().collect();
            for frame in frames {
                self.tick(130);
                self.engine.receive_frame(CAN, &frame, self.now);
            }
        }
        true
    }

    fn tick(&mut self, micros: u64) {
        self.now = self.now.saturating_add(Duration::from_micros(micros));
    }

    /// A request in Modbus RTU, and the data unit of the response; empty for silence.
    pub(crate) fn modbus(&mut self, unit: u8, pdu: &[u8], span: Duration) -> Vec<u8> {
        let response = self.exchange(&modbus(unit, pdu), span);
        if response.is_empty() {
            return response;
        }
        let frame = rtu::Frame::decode(&response).expect("one whole frame");
        assert_eq!(frame.unit, unit);
        frame.pdu.to_vec()
    }

    /// A request in NST, and the body of the reply; empty for silence.
    pub(crate) fn nst(&mut self, unit: u8, body: &[u8], span: Duration) -> Vec<u8> {
        let response = self.exchange(&modbus(unit, body), span);
        if response.is_empty() {
            return response;
        }
        let frame = nst::serial::Frame::decode(&response).expect("one whole frame");
        assert_eq!(frame.address, unit);
        frame.body.to_vec()
    }
}

/// A frame for the host port: unit, content, CRC, in both dialects.
pub(crate) fn modbus(unit: u8, content: &[u8]) -> Vec<u8> {
    let request =
        modbus::Request::Other { function: modbus::FunctionCode::from_code(content[0]), data: &content[1..] };
    rtu::encode_request(unit, &request, &mut [0; 300]).unwrap().to_vec()
}
