//! A USART behind an interrupt: bytes in and out through the port's queues, and the RS485 driver around them.

use crate::pins::OutputPin;
use core::ops::Deref;
use jointbus_mcu_bridge::engine::config::{Parity, PortConfig};
use jointbus_mcu_bridge::io::serial::InterruptSide;
use stm32f4xx_hal::pac::usart1::RegisterBlock;

/// The driver-enable pin of an RS485 port; a port without one is full duplex.
pub type DriverEnable = Option<OutputPin>;

/// The registers of a USART, of one type for all of them, so that the code of a port is there once.
pub struct Registers(*const RegisterBlock);

// SAFETY: whoever made it owned the USART, and it goes where the port goes
unsafe impl Send for Registers {}

impl Registers {
    /// Takes a USART.
    pub fn of(usart: impl Deref<Target = RegisterBlock>) -> Self {
        Self(&raw const *usart)
    }
}

impl Deref for Registers {
    type Target = RegisterBlock;

    fn deref(&self) -> &RegisterBlock {
        // SAFETY: the peripheral exists as long as the chip runs
        unsafe { &*self.0 }
    }
}

/// A port, owned by its interrupt.
pub struct Uart {
    usart: Registers,
    bus_hz: u32,
    driver_enable: DriverEnable,
    queues: InterruptSide<'static>,
    sending: bool,
}

impl Uart {
    /// Takes a USART whose clock `bus_hz` runs and whose pins are set.
    pub fn new(
        usart: Registers,
        bus_hz: u32,
        driver_enable: DriverEnable,
        queues: InterruptSide<'static>,
        config: &PortConfig,
    ) -> Self {
        let mut uart = Self { usart, bus_hz, driver_enable, queues, sending: false };
        uart.drive(false);
        uart.configure(config);
        uart
    }

    /// Sets baud rate and format (RM0090, 30.6).
    pub fn configure(&mut self, config: &PortConfig) {
        let baud = config.baud().max(1);
        let divider = ((self.bus_hz + baud / 2) / baud).clamp(16, 0xFFFF);
        let parity = config.parity != Parity::None;
        let stop = if config.stop_bits == 2 { 0b10 } else { 0b00 };
        self.usart.cr1().modify(|_, w| w.ue().clear_bit());
        // SAFETY: values in the range of their fields
        self.usart.brr().write(|w| unsafe { w.bits(divider as u16) });
        // SAFETY: as above
        self.usart.cr2().write(|w| unsafe { w.stop().bits(stop) });
        self.usart.cr1().write(|w| {
            w.m().bit(parity);
            w.pce().bit(parity);
            w.ps().bit(config.parity == Parity::Odd);
            w.te().set_bit();
            w.re().set_bit();
            w.rxneie().set_bit();
            w.ue().set_bit()
        });
    }

    /// The interrupt, also pended by the main loop when it has something to send; `micros` is the low half of the
    /// microseconds since boot.
    pub fn on_interrupt(&mut self, micros: u32) {
        let status = self.usart.sr().read();
        if status.rxne().bit_is_set() || status.ore().bit_is_set() {
            // reading the data clears both
            let byte = self.usart.dr().read().dr().bits() as u8;
            if status.ore().bit_is_set() {
                self.queues.lost();
            }
            if status.rxne().bit_is_set() {
                self.queues.received(byte, micros);
            }
        }
        self.send();
    }

    /// Whether the last stop bit of all that was to be sent has left.
    pub fn is_quiet(&self) -> bool {
        !self.sending && self.queues.is_drained()
    }

    /// Feeds the transmitter, and releases the driver after the last stop bit.
    fn send(&mut self) {
        // bounded by what the queue holds; the chip takes two bytes at a time, the emulator all
        while self.usart.sr().read().txe().bit_is_set() {
            let Some(byte) = self.queues.next_byte() else { break };
            if !self.sending {
                self.sending = true;
                self.drive(true);
            }
            // SAFETY: any nine bits can be sent
            self.usart.dr().write(|w| unsafe { w.dr().bits(byte.into()) });
        }
        let drained = self.queues.is_drained();
        if self.sending && drained && self.usart.sr().read().tc().bit_is_set() {
            self.sending = false;
            self.drive(false);
            self.queues.transmitted();
        }
        let sending = self.sending;
        self.usart.cr1().modify(|_, w| {
            w.txeie().bit(sending && !drained);
            w.tcie().bit(sending && drained)
        });
    }

    fn drive(&mut self, on: bool) {
        if let Some(pin) = self.driver_enable {
            pin.set(on);
        }
    }
}
