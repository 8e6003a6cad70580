use super::{Log, Order, SerialLine, motion};
use jointbus_protocol::decode::{Event, FrameDecoder, STRAY_MAX};
use jointbus_protocol::modbus::BROADCAST;
use jointbus_protocol::modbus::rtu::{FRAME_MAX, Frame, RequestFraming};
use jointbus_protocol::ndam9010::{CHANNELS_MAX, Layout, RamModule, Station, StationError};
use jointbus_protocol::time::{Duration, Instant};

/// The inputs of a module at a moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Inputs {
    /// Unit address of the module that was asked.
    pub unit: u8,
    /// Digital inputs, DI0 in bit 0; channels that the module lacks read 0 at the host.
    pub digital: u16,
    /// Analog inputs from AI0, 0 to 65535 over the channel's range.
    pub analog: [u16; CHANNELS_MAX as usize],
}

/// An NDAM-9010 station with `N` equal modules on an RS485 line, Modbus RTU. Its inputs follow [`motion`].
#[derive(Debug)]
pub struct NdamLine<const N: usize> {
    decoder: FrameDecoder<{ FRAME_MAX + STRAY_MAX }>,
    station: Station<RamModule, N>,
    start_id: u8,
    plugged: bool,
    spelling: bool,
    told: Log<Inputs>,
    orders: Log<(u8, Order)>,
}

impl<const N: usize> NdamLine<N> {
    /// A station whose modules have `layout`, the first one at unit `start_id`; `silence` ends what is no request.
    ///
    /// # Errors
    /// [`StationError`] where a station can't have so many modules there.
    pub fn new(layout: Layout, start_id: u8, silence: Duration) -> Result<Self, StationError> {
        let station = Station::new(std::array::from_fn(|_| RamModule::new(layout)), start_id)?;
        let decoder = FrameDecoder::new(silence);
        let (told, orders) = (Log::default(), Log::default());
        Ok(Self { decoder, station, start_id, plugged: true, spelling: false, told, orders })
    }

    /// Has the analog inputs spell the moment, as [`motion::spelling_inputs`] says.
    #[must_use]
    pub const fn spelling(mut self) -> Self {
        self.spelling = true;
        self
    }

    /// The module with this index: its outputs as they are set, its layout, its faults.
    pub fn module(&mut self, index: usize) -> Option<&mut RamModule> {
        self.station.modules().get_mut(index)
    }

    /// Takes the station's plug out (`false`): it hears nothing; or puts it in again.
    pub const fn set_plugged(&mut self, plugged: bool) {
        self.plugged = plugged;
    }

    /// Whether it is plugged in.
    #[must_use]
    pub const fn is_plugged(&self) -> bool {
        self.plugged
    }

    /// The inputs at the moment of each request that was answered.
    #[must_use]
    pub const fn told(&self) -> &Log<Inputs> {
        &self.told
    }

    /// The writes that were carried out, each with the unit that was meant; 0 is the broadcast.
    #[must_use]
    pub const fn orders(&self) -> &Log<(u8, Order)> {
        &self.orders
    }

    fn answer(&mut self, frame: &[u8], now: Instant, out: &mut Vec<u8>) {
        if !self.plugged {
            return;
        }
        for (index, module) in self.station.modules().iter_mut().enumerate() {
            module.inputs = motion::digital_inputs(index, now);
            module.analog_inputs = match self.spelling {
                false => motion::analog_inputs(index, now),
                true => motion::spelling_inputs(index, now),
            };
        }
        let mut reply = [0; FRAME_MAX];
        let result = self.station.serve(frame, &mut reply);
        let accepted = match &result {
            // an exception has the top bit of the function code set
            Ok(reply) => reply.get(1).is_some_and(|code| code & 0x80 == 0),
            Err(_) => frame.first() == Some(&BROADCAST),
        };
        if accepted
            && let Ok(frame) = Frame::decode(frame)
            && let Some(order) = Order::of_modbus(frame.pdu)
        {
            self.orders.push(now, (frame.unit, order));
        }
        let Ok(reply) = result else { return };
        out.extend_from_slice(reply);
        let Some(&unit) = reply.first() else { return };
        let index = usize::from(unit.saturating_sub(self.start_id));
        if let Some(module) = self.station.modules().get(index) {
            let inputs = Inputs { unit, digital: module.inputs, analog: module.analog_inputs };
            self.told.push(now, inputs);
        }
    }
}

impl<const N: usize> SerialLine for NdamLine<N> {
    fn receive(&mut self, mut bytes: &[u8], now: Instant) -> Vec<u8> {
        let mut out = Vec::new();
        // the frame is copied out of the decoder, because answering needs the whole line
        while let Some(event) = self.decoder.feed(&RequestFraming, &mut bytes, now) {
            if let Event::Frame(frame) = event {
                let frame = frame.to_vec();
                self.answer(&frame, now, &mut out);
            }
        }
        out
    }

    fn poll(&mut self, now: Instant) -> Vec<u8> {
        let mut out = Vec::new();
        if let Some(Event::Frame(frame)) = self.decoder.poll(&RequestFraming, now) {
            let frame = frame.to_vec();
            self.answer(&frame, now, &mut out);
        }
        out
    }

    fn deadline(&self) -> Option<Instant> {
        self.decoder.deadline()
    }
}
