//! A USART behind an interrupt: bytes in and out through the port's rings, and the RS485 driver around them.

use crate::pins::OutputPin;
use crate::time;
use core::ops::Deref;
use jointbus_mcu_bridge::board::{Parity, PortConfig};
use jointbus_mcu_bridge::boards::stm32f405::uart_clock;
use jointbus_mcu_bridge::io::serial::{IsrHalf, TransmitterSide};
use stm32f4xx_hal::pac::usart1::RegisterBlock;

/// The driver-enable pin of an RS485 port; a port without one is full duplex.
pub type DriverEnable = Option<&'static OutputPin>;

/// The registers of a USART, of one type for all of them, so that the code of a port is there once.
#[derive(Clone, Copy)]
pub struct Registers(*const RegisterBlock);

// SAFETY: interrupt and main loop share it, which `configure` allows for
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

/// Bits of SR (RM0090, 30.6.1).
mod sr {
    pub(super) const PARITY: u16 = 1;
    pub(super) const FRAMING: u16 = 1 << 1;
    pub(super) const NOISE: u16 = 1 << 2;
    pub(super) const OVERRUN: u16 = 1 << 3;
    pub(super) const RECEIVED: u16 = 1 << 5;
    pub(super) const COMPLETE: u16 = 1 << 6;
    pub(super) const EMPTY: u16 = 1 << 7;
    pub(super) const ERRORS: u16 = PARITY | FRAMING | NOISE | OVERRUN;
}

/// Sets baud rate and format of a USART that runs on `bus_hz` (RM0090, 30.6); its interrupt must not come meanwhile.
pub fn configure(usart: Registers, bus_hz: u32, config: &PortConfig) {
    let divisor = uart_clock(bus_hz).divisor(config.baud());
    let parity = config.parity != Parity::None;
    let stop = if config.stop_bits == 2 { 0b10 } else { 0b00 };
    usart.cr1().modify(|_, w| w.ue().clear_bit());
    // SAFETY: values in the range of their fields
    usart.brr().write(|w| unsafe { w.bits(divisor as u16) });
    // SAFETY: as above
    usart.cr2().write(|w| unsafe { w.stop().bits(stop) });
    usart.cr1().write(|w| {
        w.m().bit(parity);
        w.pce().bit(parity);
        w.ps().bit(config.parity == Parity::Odd);
        w.te().set_bit();
        w.re().set_bit();
        w.rxneie().set_bit();
        w.ue().set_bit()
    });
}

/// A port with room for `IN` received bytes, owned by its interrupt.
pub struct Uart<const IN: usize> {
    usart: Registers,
    queues: IsrHalf<'static, IN>,
    driver_enable: DriverEnable,
}

impl<const IN: usize> Uart<IN> {
    /// Takes a USART whose pins are set; [`configure`] starts it.
    pub fn new(usart: Registers, driver_enable: DriverEnable, queues: IsrHalf<'static, IN>) -> Self {
        drive(driver_enable, false);
        Self { usart, queues, driver_enable }
    }

    /// The interrupt, also pended by the main loop when it has something to send. Nothing is called on the way of a
    /// byte that is well, which is to be short.
    #[inline(always)]
    pub fn on_interrupt(&mut self) {
        let status = self.usart.sr().read().bits();
        if status & (sr::RECEIVED | sr::OVERRUN) != 0 {
            // reading the data clears all that the status says
            let byte = self.usart.dr().read().bits() as u8;
            let taken = if status & sr::ERRORS == 0 {
                Some(byte)
            } else {
                on_error(self.queues.transmitter(), status, byte)
            };
            if let Some(byte) = taken {
                self.queues.received(byte, time::micros());
            }
        }
        if self.queues.is_sending() {
            send(self.usart, self.queues.transmitter(), self.driver_enable);
        }
    }
}

// these are handed what they need piece by piece: where nobody has the address of a port, its constants stay constants

/// Not all went well with what came; tells the byte that is to be taken nevertheless.
fn on_error(mut queues: TransmitterSide<'_>, status: u16, byte: u8) -> Option<u8> {
    if status & sr::OVERRUN != 0 {
        // the byte in the register is well, the one behind it is lost
        queues.overrun();
    }
    if status & sr::RECEIVED == 0 {
        return None;
    }
    if status & (sr::PARITY | sr::FRAMING) != 0 {
        return Some(queues.framing_error(byte));
    }
    if status & sr::NOISE != 0 {
        queues.noise_error();
    }
    Some(byte)
}

/// Feeds the transmitter, and releases the driver after the last stop bit.
fn send(usart: Registers, mut queues: TransmitterSide<'_>, driver_enable: DriverEnable) {
    // bounded by what the queue holds; the chip takes two bytes at a time, the emulator all
    while usart.sr().read().bits() & sr::EMPTY != 0 {
        let Some(byte) = queues.next_byte() else { break };
        if !queues.set_driving(true) {
            drive(driver_enable, true);
        }
        // SAFETY: any nine bits can be sent
        usart.dr().write(|w| unsafe { w.dr().bits(byte.into()) });
    }
    let drained = queues.is_drained();
    let mut driving = queues.is_driving();
    if drained && (!driving || usart.sr().read().bits() & sr::COMPLETE != 0) {
        drive(driver_enable, false);
        driving = false;
        // what was put down for sending may have been sent before that was told
        if queues.set_driving(false) {
            queues.transmitted(time::micros());
        } else {
            queues.stop();
        }
    }
    usart.cr1().modify(|_, w| {
        w.txeie().bit(driving && !drained);
        w.tcie().bit(driving && drained)
    });
}

fn drive(driver_enable: DriverEnable, on: bool) {
    if let Some(pin) = driver_enable {
        pin.set(on);
    }
}
