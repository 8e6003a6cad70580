//! Asks all units in turn and compares every answer with what the device said or was told.

use jointbus::bench::{Bench, CAN_UNIT, LAYOUT, OUTPUTS_UNIT, RS485_A_UNIT, RS485_B_UNIT};
use jointbus::bridge::{self, port};
use jointbus::client::{Client, Error, WordOrder};
use jointbus::devices::{Inputs, Log};
use jointbus::share::{Share, Turn};
use jointbus_protocol::nst::{AXES, Sample};
use jointbus_protocol::time::Instant;
use std::collections::BTreeMap;
use std::fmt::Display;
use std::time::Duration;

/// Volts that channel 1 of the board's own outputs is set to.
const VOLTS: f32 = 2.5;
/// Register of channel 1's set value; its output switch follows.
const SET_VALUE: u16 = 4;
/// First digital output of the station's module.
const OUTPUT_BITS: u16 = 0x0200;
/// First analog input of the station's module.
const INPUT_REGISTERS: u16 = 0x0040;
/// First analog output of the station's module.
const OUTPUT_REGISTERS: u16 = 0x0060;
/// Complaints that are printed in the end.
const COMPLAINTS_MAX: usize = 10;

/// The newest decoded values; what has not been read yet is empty.
#[derive(Debug, Default)]
pub(crate) struct Readings {
    pub(crate) sensors: BTreeMap<u8, [f32; AXES]>,
    pub(crate) digital_inputs: Vec<bool>,
    pub(crate) analog_inputs: Vec<u16>,
    pub(crate) digital_outputs: Vec<bool>,
    pub(crate) analog_outputs: Vec<u16>,
    /// Volts of channel 1, and whether it is on.
    pub(crate) output: Option<(f32, bool)>,
    pub(crate) about: Option<bridge::About>,
    pub(crate) counters: [bridge::Counters; 4],
}

/// What one unit has done so far.
#[derive(Debug, Default)]
struct Tally {
    transactions: u64,
    timeouts: u64,
    wrong: u64,
}

/// The host of the demonstration.
pub(crate) struct Poller<'b> {
    bench: &'b Bench,
    share: &'b Share,
    patience: Duration,
    rounds: u32,
    tallies: BTreeMap<u8, Tally>,
    complaints: Vec<String>,
    readings: Readings,
    /// The bridge's uptime, and the frames it had from its host, when they were read last; own transactions since.
    uptime_us: u64,
    frames: u32,
    since: u32,
    gone: bool,
}

impl<'b> Poller<'b> {
    pub(crate) fn new(bench: &'b Bench, share: &'b Share) -> Self {
        let units = [CAN_UNIT, RS485_A_UNIT, OUTPUTS_UNIT, RS485_B_UNIT, bridge::UNIT];
        Self {
            bench,
            share,
            patience: bench.patience(),
            rounds: 0,
            tallies: units.into_iter().map(|unit| (unit, Tally::default())).collect(),
            complaints: Vec::new(),
            readings: Readings::default(),
            uptime_us: 0,
            frames: 0,
            since: 0,
            gone: false,
        }
    }

    pub(crate) const fn readings(&self) -> &Readings {
        &self.readings
    }

    /// Asks every unit once; whether the bridge is still there.
    pub(crate) fn round(&mut self) -> bool {
        self.sensor(CAN_UNIT);
        self.sensor(RS485_A_UNIT);
        self.inputs();
        self.digital_outputs();
        self.analog_outputs();
        self.own_output();
        self.own_unit();
        self.rounds = self.rounds.wrapping_add(1);
        !self.gone
    }

    /// One transaction, counted; and the span of time that it took.
    fn ask<T>(
        &mut self,
        unit: u8,
        question: impl FnOnce(&mut Client<Turn<'b>>) -> Result<T, Error>,
    ) -> Option<(T, Instant, Instant)> {
        let clock = self.bench.clock();
        let mut client = Client::new(self.share.turn(), self.patience);
        let start = clock.now();
        let result = question(&mut client);
        let end = clock.now();
        drop(client);
        let tally = self.tallies.entry(unit).or_default();
        tally.transactions += 1;
        self.since = self.since.wrapping_add(1);
        match result {
            Ok(answer) => Some((answer, start, end)),
            Err(error) => {
                match error {
                    Error::Timeout => tally.timeouts += 1,
                    _ => tally.wrong += 1,
                }
                self.gone |= matches!(error, Error::Stream(_));
                self.complain(unit, &error);
                None
            }
        }
    }

    /// Counts an answer as wrong unless it is `right`.
    fn expect(&mut self, unit: u8, right: bool, complaint: impl FnOnce() -> String) {
        if !right {
            self.tallies.entry(unit).or_default().wrong += 1;
            self.complain(unit, &complaint());
        }
    }

    fn complain(&mut self, unit: u8, complaint: &dyn Display) {
        if self.complaints.len() < COMPLAINTS_MAX {
            self.complaints.push(format!("unit {unit}, round {}: {complaint}", self.rounds));
        }
    }

    /// Six axes: the sensor must have sent just this during the question, and it must lie on its motion.
    fn sensor(&mut self, unit: u8) {
        let Some((sample, start, end)) = self.ask(unit, |client| client.nst(unit).sample()) else { return };
        let told = if unit == CAN_UNIT {
            let mut bus = self.bench.can.lock();
            bus.sensor(1).is_some_and(|sensor| on_motion(sensor.told(), sensor.motion(), sample, start, end))
        } else {
            let mut line = self.bench.rs485_a.lock();
            line.sensor(1).is_some_and(|sensor| on_motion(sensor.told(), sensor.motion(), sample, start, end))
        };
        self.expect(unit, told, || format!("the sensor has not measured {:?}", sample.0));
        self.readings.sensors.insert(unit, sample.newtons());
    }

    fn inputs(&mut self) {
        const DIGITAL: u16 = LAYOUT.digital_inputs as u16;
        let unit = RS485_B_UNIT;
        if let Some((bits, start, end)) =
            self.ask(unit, |client| client.modbus(unit).read_discrete_inputs(0, DIGITAL))
        {
            let told = self.told(start, end, |inputs| {
                bits.iter().enumerate().all(|(index, on)| *on == (inputs.digital >> index & 1 == 1))
            });
            self.expect(unit, told, || format!("the digital inputs were never {bits:?}"));
            self.readings.digital_inputs = bits;
        }
        const ANALOG: u16 = LAYOUT.analog_inputs as u16;
        if let Some((values, start, end)) =
            self.ask(unit, |client| client.modbus(unit).read_input_registers(INPUT_REGISTERS, ANALOG))
        {
            let told = self.told(start, end, |inputs| inputs.analog[..values.len()] == values);
            self.expect(unit, told, || format!("the analog inputs were never {values:?}"));
            self.readings.analog_inputs = values;
        }
    }

    /// Whether the station told such inputs in a span of time.
    fn told(&self, start: Instant, end: Instant, such: impl Fn(&Inputs) -> bool) -> bool {
        self.bench.rs485_b.lock().told().between(start, end).any(|(_, inputs)| such(inputs))
    }

    /// A light that runs along the digital outputs: written, compared at the device, read back.
    fn digital_outputs(&mut self) {
        let (unit, count) = (RS485_B_UNIT, usize::from(LAYOUT.digital_outputs));
        let wanted: Vec<bool> = (0..count).map(|index| index == self.rounds as usize % count).collect();
        let Some(_) = self.ask(unit, |client| client.modbus(unit).write_coils(OUTPUT_BITS, &wanted)) else {
            return;
        };
        let at_device = self.bench.rs485_b.lock().module(0).map(|module| module.outputs);
        let light = 1u16 << (self.rounds as usize % count);
        self.expect(unit, at_device == Some(light), || {
            format!("digital outputs {light:#06x} arrived as {at_device:x?}")
        });
        let read = self
            .ask(unit, |client| client.modbus(unit).read_coils(OUTPUT_BITS, LAYOUT.digital_outputs.into()));
        if let Some((bits, ..)) = read {
            self.expect(unit, bits == wanted, || format!("digital outputs {wanted:?} read {bits:?}"));
            self.readings.digital_outputs = bits;
        }
    }

    /// Ramps on the analog outputs: written, compared at the device, read back.
    fn analog_outputs(&mut self) {
        let (unit, count) = (RS485_B_UNIT, u16::from(LAYOUT.analog_outputs));
        let step = (self.rounds % 0x1_0000) as u16;
        let wanted: Vec<u16> = (0..count).map(|index| step.wrapping_mul(index + 1)).collect();
        let write = self.ask(unit, |client| client.modbus(unit).write_registers(OUTPUT_REGISTERS, &wanted));
        let Some(_) = write else { return };
        let at_device = self.bench.rs485_b.lock().module(0).map(|module| module.analog_outputs);
        let arrived = at_device.is_some_and(|values| values[..wanted.len()] == wanted);
        self.expect(unit, arrived, || format!("analog outputs {wanted:?} arrived as {at_device:?}"));
        let read =
            self.ask(unit, |client| client.modbus(unit).read_holding_registers(OUTPUT_REGISTERS, count));
        if let Some((values, ..)) = read {
            self.expect(unit, values == wanted, || format!("analog outputs {wanted:?} read {values:?}"));
            self.readings.analog_outputs = values;
        }
    }

    /// The board's own output: set and switched on in the first round, read back in each.
    fn own_output(&mut self) {
        let unit = OUTPUTS_UNIT;
        let wanted = [VOLTS.to_bits(), 1];
        if self.rounds == 0
            && self
                .ask(unit, |client| client.modbus(unit).write_values(SET_VALUE, &wanted, WordOrder::LowFirst))
                .is_none()
        {
            return;
        }
        if let Some((values, ..)) = self.ask(unit, |client| {
            client.modbus(unit).read_holding_values::<u32>(SET_VALUE, 2, WordOrder::LowFirst)
        }) {
            self.expect(unit, values == wanted, || format!("channel 1 reads {values:x?}"));
            if let [volts, on] = *values {
                self.readings.output = Some((f32::from_bits(volts), on == 1));
            }
        }
    }

    /// The bridge itself: versions, a clock that runs, and counters that have counted these questions.
    fn own_unit(&mut self) {
        let unit = bridge::UNIT;
        if let Some((about, ..)) = self.ask(unit, bridge::about) {
            let version = jointbus::version();
            self.expect(unit, about.map_version == bridge::MAP_VERSION, || {
                format!("map version {}", about.map_version)
            });
            self.expect(unit, about.version == version, || {
                format!("firmware version {:?}, expected {version:?}", about.version)
            });
            let before = std::mem::replace(&mut self.uptime_us, about.uptime_us);
            self.expect(unit, about.uptime_us > before, || {
                format!("uptime went from {before} us to {} us", about.uptime_us)
            });
            self.readings.about = Some(about);
        }
        for number in [port::HOST, port::RS485_A, port::RS485_B, port::CAN] {
            if let Some((counters, ..)) = self.ask(unit, |client| bridge::counters(client, number)) {
                if number == port::HOST {
                    // other programs may have asked as well
                    let asked = std::mem::take(&mut self.since);
                    let before = std::mem::replace(&mut self.frames, counters.received);
                    let counted = counters.received.wrapping_sub(before);
                    self.expect(unit, counted >= asked, || {
                        format!("the bridge counted {counted} of {asked} requests")
                    });
                }
                self.readings.counters[usize::from(number)] = counters;
            }
        }
    }

    /// Prints what was done; whether all of it was right and every device was read.
    pub(crate) fn summary(&self, elapsed: Duration) -> bool {
        println!("\nunit  transactions  timeouts  wrong");
        let mut total = Tally::default();
        let mut all_answered = true;
        for (unit, tally) in &self.tallies {
            println!("{unit:>4}  {:>12}  {:>8}  {:>5}", tally.transactions, tally.timeouts, tally.wrong);
            total.transactions += tally.transactions;
            total.timeouts += tally.timeouts;
            total.wrong += tally.wrong;
            all_answered &= tally.transactions > tally.timeouts;
        }
        for complaint in &self.complaints {
            println!("  {complaint}");
        }
        println!(
            "{} transactions in {:.1} s, {:.0} a second; {} timeouts, {} wrong",
            total.transactions,
            elapsed.as_secs_f64(),
            total.transactions as f64 / elapsed.as_secs_f64(),
            total.timeouts,
            total.wrong
        );
        let readings = &self.readings;
        let all_read = readings.sensors.len() == 2
            && !readings.digital_inputs.is_empty()
            && !readings.analog_inputs.is_empty()
            && !readings.digital_outputs.is_empty()
            && !readings.analog_outputs.is_empty()
            && readings.output.is_some()
            && readings.about.is_some();
        total.timeouts == 0 && total.wrong == 0 && all_answered && all_read
    }
}

/// Whether the sensor sent this sample during a span of time, and it lies on the motion at that moment.
fn on_motion(
    log: &Log<Sample>,
    motion: jointbus::devices::Motion,
    sample: Sample,
    start: Instant,
    end: Instant,
) -> bool {
    log.between(start, end).any(|(at, told)| *told == sample && motion.sample(*at) == sample)
}

#[cfg(test)]
mod tests {
    use super::*;
    use jointbus::bridge::Limits;
    use jointbus_protocol::nst::register::ZERO_POINTS;

    /// The outcome of two rounds with a bench that something was done to.
    fn outcome(prepare: impl FnOnce(&mut Bench)) -> (bool, Vec<u64>) {
        let mut bench = Bench::in_process().unwrap();
        prepare(&mut bench);
        let share = bench.share().unwrap();
        let mut poller = Poller::new(&bench, &share);
        assert!(poller.round() && poller.round());
        let right = poller.summary(Duration::from_secs(1));
        (right, poller.tallies.values().map(|tally| tally.wrong).collect())
    }

    #[test]
    fn all_is_right_with_all_devices() {
        assert_eq!(outcome(|_| {}), (true, vec![0; 5]));
    }

    #[test]
    fn a_station_without_its_plug_is_noticed() {
        let (right, wrong) = outcome(|bench| {
            bench.set_limits(&Limits { read_ms: 20, write_ms: 20, ..Limits::GENEROUS }).unwrap();
            bench.rs485_b.lock().set_plugged(false);
        });
        // the short limits may meet other devices as well, on a slow machine
        assert!(!right && wrong[3] == 8, "{wrong:?}");
    }

    #[test]
    fn a_sensor_that_is_off_its_motion_is_noticed() {
        let (right, wrong) = outcome(|bench| {
            let mut bus = bench.can.lock();
            let daq = bus.sensor(1).unwrap().daq();
            daq.hardware().settings.write(ZERO_POINTS.first, &[1]).unwrap();
            daq.restart();
        });
        assert_eq!((right, wrong), (false, vec![2, 0, 0, 0, 0]));
    }
}
