//! The registers of pins, converters, timers 3 and 5 and serial ports, and the character devices `usart2` and `usart3`.
//!
//! What QEMU hands back as `opaque` is the index of the port or USART.

use super::machine::{MACHINE, forget, overlay, qemu, resume, update};
use super::part::Part;
use super::port::{Handlers, Port, received};
use super::qemu::{
    CHARDEV_CLOSED, CHARDEV_OPENED, CLOCK_VIRTUAL, Pointer, Qemu, RegionOps, SCALE_NS, opaque_structure,
};
use super::state::with;
use crate::{analog, counter, gpio, usart};
use std::ffi::{CStr, c_int, c_uint};
use std::ptr;

const GPIO_BASE: u64 = 0x4002_0000;
const ADC_BASE: u64 = 0x4001_2000;
const DAC_BASE: u64 = 0x4000_7400;
const TIM3_BASE: u64 = 0x4000_0400;
const TIM5_BASE: u64 = 0x4000_0C00;
const USART_BASES: [u64; 2] = [0x4000_4400, 0x4000_4800];
pub(super) const USART_INTERRUPTS: [c_int; 2] = [38, 39];
const USART_DEVICES: [&CStr; 2] = [c"usart2", c"usart3"];

static GPIO_OPS: RegionOps = RegionOps::new(read_gpio, write_gpio, 1);
static ADC_OPS: RegionOps = RegionOps::new(read_adc, write_adc, 4);
static DAC_OPS: RegionOps = RegionOps::new(read_dac, write_dac, 4);
static TIM3_OPS: RegionOps = RegionOps::new(read_pwm, write_pwm, 2);
static TIM5_OPS: RegionOps = RegionOps::new(read_counter, write_counter, 2);
static USART_OPS: RegionOps = RegionOps::new(read_usart, write_usart, 2);
static USART_HANDLERS: Handlers =
    Handlers { room: usart_room, read: usart_read, event: usart_event, writable: usart_writable };

/// A serial port whose bytes take their time.
pub(super) struct Serial {
    port: Port,
    interrupt: Pointer,
    timer: Pointer,
}

impl Serial {
    /// Takes the character device of a USART; where there is none, the USART stays QEMU's.
    pub(super) fn find(qemu: &Qemu, index: usize, processor: Pointer) -> Option<Self> {
        let port = Port::open(qemu, USART_DEVICES[index], &USART_HANDLERS, opaque(index))?;
        // SAFETY: the processor is a device with a line for each interrupt.
        let interrupt = unsafe { (qemu.qdev_get_gpio_in)(processor, USART_INTERRUPTS[index]) };
        Some(Self { port, interrupt, timer: opaque_structure() })
    }

    pub(super) fn start(&self, qemu: &Qemu, index: usize) {
        let (none, opaque) = (ptr::null_mut(), opaque(index));
        // SAFETY: the timer's memory is large enough and lives as long as the process, like the function.
        unsafe { (qemu.timer_init_full)(self.timer, none, CLOCK_VIRTUAL, SCALE_NS, 0, tick, opaque) };
        overlay(qemu, USART_BASES[index], usart::SIZE, &USART_OPS, opaque, c"jointbus.usart");
        self.port.start(qemu, &USART_HANDLERS);
    }

    pub(super) fn apply(&self, qemu: &Qemu, effects: &SerialEffects) {
        if let Some(level) = effects.line {
            // SAFETY: the line is an input of the processor.
            unsafe { (qemu.qemu_set_irq)(self.interrupt, c_int::from(level)) };
        }
        if let Some(deadline) = effects.deadline {
            let deadline = i64::try_from(deadline).unwrap_or(i64::MAX);
            // SAFETY: the timer was initialised before anything could set it.
            unsafe { (qemu.timer_mod_ns)(self.timer, deadline) };
        }
        if !effects.output.is_empty() {
            self.port.send(qemu, &effects.output);
        }
    }

    pub(super) const fn port(&self) -> &Port {
        &self.port
    }
}

/// What changes while the machine runs.
#[derive(Default)]
pub(super) struct SerialState {
    level: bool,
    announced: Option<u64>,
    output: Vec<u8>,
}

/// What an update has to tell QEMU of a serial port.
pub(super) struct SerialEffects {
    line: Option<bool>,
    deadline: Option<u64>,
    output: Vec<u8>,
}

impl SerialState {
    pub(super) fn effects(&mut self, usart: &usart::Usart) -> SerialEffects {
        let level = usart.interrupt();
        let line = (std::mem::replace(&mut self.level, level) != level).then_some(level);
        let due = usart.deadline();
        let deadline = due.filter(|_| self.announced != due);
        self.announced = due;
        SerialEffects { line, deadline, output: std::mem::take(&mut self.output) }
    }
}

/// Lays the registers over what QEMU has in their place.
pub(super) fn start(qemu: &Qemu) {
    let none = ptr::null_mut();
    for index in 0..gpio::PORTS {
        let base = GPIO_BASE + u64::from(gpio::SIZE) * index as u64;
        overlay(qemu, base, gpio::SIZE, &GPIO_OPS, opaque(index), c"jointbus.gpio");
    }
    overlay(qemu, ADC_BASE, analog::ADC_SIZE, &ADC_OPS, none, c"jointbus.adc");
    overlay(qemu, DAC_BASE, analog::DAC_SIZE, &DAC_OPS, none, c"jointbus.dac");
    overlay(qemu, TIM3_BASE, analog::TIMER_SIZE, &TIM3_OPS, none, c"jointbus.tim3");
    overlay(qemu, TIM5_BASE, counter::SIZE, &TIM5_OPS, none, c"jointbus.tim5");
}

/// The machine's time in nanoseconds.
pub(super) fn now() -> u64 {
    // SAFETY: the clock is one of QEMU's.
    let now = unsafe { (qemu().qemu_clock_get_ns)(CLOCK_VIRTUAL) };
    u64::try_from(now).unwrap_or(0)
}

fn opaque(index: usize) -> Pointer {
    ptr::without_provenance_mut(index)
}

fn serial(opaque: Pointer) -> Option<&'static Serial> {
    MACHINE.get()?.serial.get(opaque.addr())?.as_ref()
}

extern "C" fn read_gpio(opaque: Pointer, offset: u64, size: c_uint) -> u64 {
    let part = Part::of(offset, size);
    u64::from(part.read(with(|state| state.board.gpio().read(opaque.addr(), part.register))))
}

extern "C" fn write_gpio(opaque: Pointer, offset: u64, value: u64, size: c_uint) {
    let (part, now) = (Part::of(offset, size), now());
    with(|state| {
        let gpio = state.board.gpio();
        let whole = part.write(gpio.read(opaque.addr(), part.register), value as u32);
        gpio.write(opaque.addr(), part.register, whole, now);
    });
}

extern "C" fn read_adc(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(with(|state| state.board.adc().read(offset as u32)))
}

extern "C" fn write_adc(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    with(|state| state.board.adc().write(offset as u32, value as u32));
}

extern "C" fn read_dac(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(with(|state| state.board.dac().read(offset as u32)))
}

extern "C" fn write_dac(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    with(|state| state.board.dac().write(offset as u32, value as u32));
}

extern "C" fn read_pwm(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(with(|state| state.board.pwm().read(offset as u32)))
}

extern "C" fn write_pwm(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    with(|state| state.board.pwm().write(offset as u32, value as u32));
}

extern "C" fn read_counter(_opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    let now = now();
    u64::from(with(|state| {
        let (counter, hz) = state.board.counter();
        counter.read(offset as u32, now, hz)
    }))
}

extern "C" fn write_counter(_opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    let now = now();
    with(|state| {
        let (counter, hz) = state.board.counter();
        counter.write(offset as u32, value as u32, now, hz);
    });
}

extern "C" fn read_usart(opaque: Pointer, offset: u64, _size: c_uint) -> u64 {
    u64::from(update(|state| state.board.usart(opaque.addr()).0.read(offset as u32)))
}

extern "C" fn write_usart(opaque: Pointer, offset: u64, value: u64, _size: c_uint) {
    let now = now();
    update(|state| {
        let (usart, hz) = state.board.usart(opaque.addr());
        usart.write(offset as u32, value as u32, now, hz);
    });
}

extern "C" fn tick(opaque: Pointer) {
    let now = now();
    update(|state| {
        let index = opaque.addr();
        let sent = state.board.step_usart(index, now);
        let serial = &mut state.serial[index];
        serial.announced = None;
        serial.output.extend(sent);
    });
}

extern "C" fn usart_room(opaque: Pointer) -> c_int {
    with(|state| state.board.usart(opaque.addr()).0.room() as c_int)
}

extern "C" fn usart_read(opaque: Pointer, bytes: *const u8, length: c_int) {
    let now = now();
    // SAFETY: QEMU hands over that many bytes for the time of the call.
    let bytes = unsafe { received(bytes, length) };
    update(|state| {
        let (usart, hz) = state.board.usart(opaque.addr());
        usart.receive(bytes, now, hz);
    });
}

extern "C" fn usart_event(opaque: Pointer, event: c_int) {
    if let CHARDEV_OPENED | CHARDEV_CLOSED = event {
        forget(|_| serial(opaque).map(Serial::port));
    }
}

extern "C" fn usart_writable(_unused: Pointer, _condition: c_uint, opaque: Pointer) -> c_int {
    resume(|_| serial(opaque).map(Serial::port))
}
