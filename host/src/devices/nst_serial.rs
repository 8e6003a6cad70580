use super::{Motion, Sensor, SerialLine, Wiring};
use jointbus_protocol::decode::{Event, FrameDecoder, FrameEvent, STRAY_MAX};
use jointbus_protocol::nst::serial::{REQUEST_MAX, RESPONSE_MAX, RequestFraming};
use jointbus_protocol::time::{Duration, Instant};

/// NST sensors on one RS485 line. A sensor ignores what is for others; two at one address both answer.
#[derive(Debug)]
pub struct NstSerial {
    decoder: FrameDecoder<{ REQUEST_MAX + STRAY_MAX }>,
    sensors: Vec<Sensor>,
}

impl NstSerial {
    /// A line with nothing on it, on which `silence` ends what is no request.
    #[must_use]
    pub const fn new(silence: Duration) -> Self {
        Self { decoder: FrameDecoder::new(silence), sensors: Vec::new() }
    }

    /// Puts a sensor at `address` on the line, its motion the one of that number.
    #[must_use]
    pub fn with_sensor(self, address: u8) -> Self {
        self.with(Sensor::new(address, Wiring::Rs485, Motion::new(address)))
    }

    /// Puts this sensor on the line.
    #[must_use]
    pub fn with(mut self, sensor: Sensor) -> Self {
        self.sensors.push(sensor);
        self
    }

    /// The sensors, in the order in which they were put on.
    pub const fn sensors(&mut self) -> &mut Vec<Sensor> {
        &mut self.sensors
    }

    /// The first sensor that uses this address.
    pub fn sensor(&mut self, address: u8) -> Option<&mut Sensor> {
        self.sensors.iter_mut().find(|sensor| sensor.address() == address)
    }
}

/// Adds what the sensors answer to a frame.
fn answer(sensors: &mut [Sensor], event: FrameEvent<'_>, now: Instant, out: &mut Vec<u8>) {
    let Event::Frame(frame) = event else { return };
    let body = frame.get(1..frame.len() - 2).unwrap_or_default();
    for sensor in sensors {
        let mut reply = [0; RESPONSE_MAX];
        let reply = sensor.answer(body, now, |daq| daq.serve_serial(frame, &mut reply).map(<[u8]>::to_vec));
        out.extend(reply.unwrap_or_default());
    }
}

impl SerialLine for NstSerial {
    fn receive(&mut self, mut bytes: &[u8], now: Instant) -> Vec<u8> {
        let mut out = Vec::new();
        while let Some(event) = self.decoder.feed(&RequestFraming, &mut bytes, now) {
            answer(&mut self.sensors, event, now, &mut out);
        }
        out
    }

    fn poll(&mut self, now: Instant) -> Vec<u8> {
        let mut out = Vec::new();
        if let Some(event) = self.decoder.poll(&RequestFraming, now) {
            answer(&mut self.sensors, event, now, &mut out);
        }
        out
    }

    fn deadline(&self) -> Option<Instant> {
        self.decoder.deadline()
    }
}
