//! The modelled peripherals wired together, without anything that runs them: registers, resets, bytes and the
//! passing of bus time go in; interrupt levels, bytes and the next deadline come out.

#[cfg(test)]
mod tests;

use crate::adapter::{Adapter, Request, SHORTEST_FRAME};
use crate::analog::{Adc, Dac, Pwm};
use crate::bus::{Bus, Event, IDLE_BITS};
use crate::bxcan::{BxCan, Interrupts};
use crate::control::{Control, Line, Query};
use crate::counter::Counter;
use crate::flash::{Change, Flash};
use crate::gpio::{Gpio, Level, Pin};
use crate::iwdg::Watchdog;
use crate::rcc::{Rcc, ResetCause};
use crate::usart::Usart;
use jointbus_protocol::can::Frame;
use jointbus_protocol::slcan::{self, LineReader};
use jointbus_protocol::time::Instant;

/// Bytes of the longest line of the fault console.
const CONSOLE_LINE: usize = 64;

/// The pins that enable the RS485 drivers of USART2 and USART3.
const DRIVER_ENABLES: [&str; 2] = ["PA1", "PB12"];

/// The peripherals of one STM32F405 board, and the bus it is on.
#[derive(Debug, Clone)]
pub struct Board {
    rcc: Rcc,
    flash: Flash,
    watchdog: Watchdog,
    has_bitten: bool,
    /// Changes of the flash until the power goes, the one that it goes with included.
    changes_left: Option<u32>,
    gpio: Gpio,
    adc: Adc,
    dac: Dac,
    pwm: Pwm,
    counter: Counter,
    /// USART2 and USART3.
    usarts: [Usart; 2],
    can: BxCan,
    bus: Bus,
    adapter: Adapter,
    /// What the client said the bit rate is; without a word from it every rate is right.
    bit_rate: Option<u32>,
    console: LineReader<CONSOLE_LINE>,
    next_reset: ResetCause,
    can_output: Vec<u8>,
    console_output: Vec<u8>,
}

impl Default for Board {
    fn default() -> Self {
        Self {
            rcc: Rcc::new(),
            flash: Flash::new(),
            watchdog: Watchdog::new(),
            has_bitten: false,
            changes_left: None,
            gpio: Gpio::new(),
            adc: Adc::new(),
            dac: Dac::default(),
            pwm: Pwm::default(),
            counter: Counter::default(),
            usarts: Default::default(),
            can: BxCan::new(),
            bus: Bus::default(),
            adapter: Adapter::default(),
            bit_rate: None,
            console: LineReader::new(),
            next_reset: ResetCause::Software,
            can_output: Vec::new(),
            console_output: Vec::new(),
        }
    }
}

/// The processor's side.
impl Board {
    /// A board after power-on.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Resets the peripherals at a moment in nanoseconds, for the cause that the fault console has chosen or by software.
    /// What surrounds the processor stays as it is: faults, the client, its frames, the crystal.
    pub fn reset(&mut self, now: u64) {
        let bitten = std::mem::take(&mut self.has_bitten);
        self.rcc.reset(if bitten { ResetCause::IndependentWatchdog } else { self.next_reset });
        self.flash.reset();
        self.watchdog = Watchdog::new();
        self.gpio.reset(now);
        self.adc.reset();
        (self.dac, self.pwm, self.counter) = (Dac::default(), Pwm::default(), Counter::default());
        self.usarts.iter_mut().for_each(Usart::reset);
        self.reset_can();
    }

    /// The pins.
    pub const fn gpio(&mut self) -> &mut Gpio {
        &mut self.gpio
    }

    /// The first converter.
    pub const fn adc(&mut self) -> &mut Adc {
        &mut self.adc
    }

    /// The analog outputs.
    pub const fn dac(&mut self) -> &mut Dac {
        &mut self.dac
    }

    /// Timer 3.
    pub const fn pwm(&mut self) -> &mut Pwm {
        &mut self.pwm
    }

    /// Timer 5, and the frequency of its clock.
    pub fn counter(&mut self) -> (&mut Counter, u32) {
        let hz = self.rcc.timclk1_hz();
        (&mut self.counter, hz)
    }

    /// USART2 or USART3, by its index 0 or 1, and the frequency of its clock.
    ///
    /// # Panics
    /// With another index.
    pub fn usart(&mut self, index: usize) -> (&mut Usart, u32) {
        let hz = self.rcc.pclk1_hz();
        (&mut self.usarts[index], hz)
    }

    /// Does what is due at a USART; what has left it then, if its driver was enabled: without it nothing gets onto the
    /// line.
    ///
    /// # Panics
    /// With another index than 0 or 1.
    pub fn step_usart(&mut self, index: usize, now: u64) -> Vec<u8> {
        let is_enabled =
            Pin::parse(DRIVER_ENABLES[index]).is_some_and(|pin| self.gpio.drives(pin) == Level(Some(true)));
        let (usart, hz) = self.usart(index);
        usart.step(now, hz);
        let sent = usart.outgoing();
        if is_enabled { sent } else { Vec::new() }
    }

    /// Reads a register of the clock control.
    #[must_use]
    pub fn read_rcc(&self, offset: u32) -> u32 {
        self.rcc.read(offset)
    }

    /// Writes a register of the clock control.
    pub fn write_rcc(&mut self, offset: u32, value: u32) {
        self.rcc.write(offset, value);
        if self.rcc.can1_is_reset() {
            self.reset_can();
        }
    }

    /// The flash controller and its sectors.
    #[must_use]
    pub const fn flash(&self) -> &Flash {
        &self.flash
    }

    /// Puts what the flash held before into it.
    pub fn load_flash(&mut self, content: &[u8]) {
        self.flash.load(content);
    }

    /// Writes a register of the flash controller; tells what has changed in the sectors.
    pub fn write_flash_register(&mut self, offset: u32, value: u32) -> Option<Change> {
        self.flash.write_register(offset, value)
    }

    /// Programs bytes of the flash; tells what has changed.
    pub fn program_flash(&mut self, offset: u32, value: u32, size: u32) -> Option<Change> {
        self.flash.program(offset, value, size)
    }

    /// The flash changes; whether the power goes meanwhile.
    pub fn power_goes(&mut self) -> bool {
        self.changes_left = self.changes_left.map(|left| left.saturating_sub(1));
        self.changes_left == Some(0)
    }

    /// Reads a register of the watchdog.
    #[must_use]
    pub const fn read_watchdog(&self, offset: u32) -> u32 {
        self.watchdog.read(offset)
    }

    /// Writes a register of the watchdog; where that starts or feeds it: the nanoseconds after which it bites.
    pub fn write_watchdog(&mut self, offset: u32, value: u32) -> Option<u64> {
        self.watchdog.write(offset, value)
    }

    /// The watchdog bites: the reset that follows is its.
    pub const fn watchdog_bites(&mut self) {
        self.has_bitten = true;
    }

    /// Reads a register of the CAN controller; 0 without its clock.
    pub fn read_can(&mut self, offset: u32) -> u32 {
        if self.rcc.can1_is_clocked() { self.can.read(offset) } else { 0 }
    }

    /// Writes a register of the CAN controller; ignored without its clock and in reset.
    pub fn write_can(&mut self, offset: u32, value: u32) {
        if self.rcc.can1_is_clocked() && !self.rcc.can1_is_reset() {
            self.can.write(offset, value);
        }
    }

    /// Levels of the CAN controller's interrupt lines.
    #[must_use]
    pub fn interrupts(&self) -> Interrupts {
        self.can.interrupts()
    }

    /// Frequency of the processor's clock.
    #[must_use]
    pub fn sysclk_hz(&self) -> u32 {
        self.rcc.sysclk_hz()
    }

    fn reset_can(&mut self) {
        self.can.reset();
        self.bus.controller_reset();
    }
}

/// Time on the bus.
impl Board {
    /// If something is to happen on the bus: the nanoseconds after which [`Self::step`] is due, unless a step has
    /// been announced already.
    #[must_use]
    pub fn idle_ns(&self) -> Option<u64> {
        self.bus.is_busy(&self.can).then(|| self.nanoseconds(IDLE_BITS))
    }

    /// The announced time has passed. Returns the nanoseconds until the next step, if there is one.
    pub fn step(&mut self) -> Option<u64> {
        self.bus.faults.bit_rates_differ = self.bit_rate.is_some_and(|rate| !self.controller_runs_at(rate));
        let Self { bus, can, adapter, can_output, .. } = self;
        let bits = bus.step(can, |event| adapter.report(event, can_output))?;
        Some(self.nanoseconds(bits))
    }

    fn nanoseconds(&self, bits: u32) -> u64 {
        let clocks = u64::from(bits) * u64::from(self.can.clocks_per_bit());
        clocks * 1_000_000_000 / u64::from(self.rcc.pclk1_hz().max(1))
    }

    /// Whether the controller's bit rate is within one percent of this one.
    fn controller_runs_at(&self, rate: u32) -> bool {
        let own = self.rcc.pclk1_hz() / self.can.clocks_per_bit();
        own.abs_diff(rate) <= rate / 100
    }
}

/// The client's side.
impl Board {
    /// A client has connected: what the one before it had set is forgotten.
    pub fn can_client_connected(&mut self) {
        self.adapter = Adapter::default();
        self.bit_rate = None;
        self.can_output.clear();
    }

    /// Bytes that the client may send without a frame being lost.
    #[must_use]
    pub fn can_room(&self) -> usize {
        self.bus.room().saturating_sub(1) * SHORTEST_FRAME
    }

    /// Takes bytes from the client, no more than there is [room](Self::can_room) for.
    pub fn take_can_bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            match self.adapter.take(byte, &mut self.can_output) {
                Some(Request::Send(frame)) => self.offer(frame),
                Some(Request::BitRate(rate)) => self.bit_rate = Some(rate),
                None => {}
            }
        }
    }

    /// Bytes for the client.
    pub fn can_output(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.can_output)
    }

    /// Takes bytes from the user of the fault console.
    pub fn take_console_bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            let byte = if byte == b'\n' { b'\r' } else { byte };
            let line = match self.console.feed(&mut &[byte][..], Instant::default()) {
                None | Some(slcan::Event::Frame([])) => continue,
                Some(slcan::Event::Frame(line)) => str::from_utf8(line).ok().and_then(Line::parse),
                Some(slcan::Event::Dropped(_)) => None,
            };
            let answer = match line {
                Some(Line::Control(control)) => {
                    self.apply(control);
                    "ok".into()
                }
                Some(Line::Query(query)) => format!("ok {}", self.ask(query)).trim_end().to_owned(),
                None => "?".into(),
            };
            self.console_output.extend_from_slice(answer.as_bytes());
            self.console_output.push(b'\n');
        }
    }

    /// Bytes for the user of the fault console.
    pub fn console_output(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.console_output)
    }

    /// Changes the surroundings of the processor.
    pub fn apply(&mut self, control: Control) {
        let faults = &mut self.bus.faults;
        match control {
            Control::Acknowledge(on) => faults.no_acknowledgement = !on,
            Control::Bus(works) => faults.stuck = !works,
            Control::BitErrors(count) => faults.bit_errors = count,
            Control::ArbitrationLosses(count) => faults.arbitration_losses = count,
            Control::Room(waits) => faults.hasty = !waits,
            Control::Crystal(fitted) => self.rcc.set_crystal(fitted),
            Control::Cause(cause) => self.next_reset = cause,
            Control::Pin(pin, level) => self.gpio.connect(pin, level),
            Control::Analog(channel, value) => {
                self.adc.connect(channel, value);
            }
            Control::Converter(works) => self.adc.set_working(works),
            Control::Flaw(index, flaw) => {
                self.usarts.get_mut(index).into_iter().for_each(|usart| usart.spoil(flaw));
            }
            Control::PowerCut(changes) => self.changes_left = Some(changes),
            Control::Forget => {
                self.gpio.forget();
                self.usarts.iter_mut().for_each(Usart::forget);
            }
        }
    }

    fn ask(&self, query: Query) -> String {
        let joined = |words: Vec<String>| words.join(" ");
        match query {
            Query::Level(pin) => self.gpio.drives(pin).to_string(),
            Query::Changes(pin) => {
                joined(self.gpio.changes(pin).iter().map(|(at, level)| format!("{at}:{level}")).collect())
            }
            Query::Sent(index) => {
                let sent = self.usarts.get(index).into_iter().flat_map(Usart::sent);
                joined(sent.map(|sent| format!("{}-{}", sent.start, sent.end)).collect())
            }
            Query::Dac(number) => {
                self.dac.output(number).map_or_else(|| "off".into(), |value| value.to_string())
            }
            Query::Pwm(number) => {
                let duty = self.pwm.output(number);
                duty.map_or_else(|| "off".into(), |(high, period)| format!("{high} {period}"))
            }
        }
    }

    fn offer(&mut self, frame: Frame) {
        if !self.bus.offer(frame) {
            self.adapter.report(Event::Unacknowledged(frame), &mut self.can_output);
        }
    }
}
