//! The reference board: an STM32F405 with a host port, two RS485 buses, a CAN bus, and inputs and outputs of its own.

use crate::board::{
    Board, Description, Identification, InputsOutputs, Limits, LocalUnits, Outputs, Port, PortConfig,
    PortDescription, PortKind, Protocol, Route, Target, UartClock,
};
use crate::engine;
use jointbus_protocol::ndam9010::Layout;

/// First RS485 bus.
pub const RS485_A: Port = Port::new(1);
/// Second RS485 bus.
pub const RS485_B: Port = Port::new(2);
/// CAN bus.
pub const CAN: Port = Port::new(3);

/// The board's two DAC and two PWM channels, as an NXI-6201.
pub const OUTPUTS: Target = Target::Local(0);
/// The board's inputs and outputs, as an NDAM module.
pub const INPUTS_OUTPUTS: Target = Target::Local(1);

/// Channels of the board as an NDAM module.
pub const LAYOUT: Layout =
    Layout { digital_inputs: 8, digital_outputs: 8, analog_inputs: 4, analog_outputs: 0 };

/// The board's own units.
pub type Units = (Outputs, InputsOutputs<8, 8, 4>);

/// The reference board.
#[derive(Debug, Clone, Copy)]
pub struct Stm32f405;

/// What it says of itself.
pub const BOARD: &Description = Stm32f405::DESCRIPTION;

/// Its engine.
pub type Engine = engine::Engine<Stm32f405, { BOARD.serial_buses() }, { BOARD.can_buses() }>;

/// Memory for its engine.
pub type Storage = engine::Storage<Stm32f405, { BOARD.serial_buses() }, { BOARD.can_buses() }>;

/// The clock of USART2 and USART3 in Hz where the crystal works; that of USART1 is twice as fast.
pub const PCLK1_HZ: u32 = 42_000_000;

/// A USART that runs on `hz`: its divisor has 16 bits, and the smallest value is 16 (RM0090, 30.6.3).
#[must_use]
pub const fn uart_clock(hz: u32) -> UartClock {
    UartClock { hz, divisor_min: 16, divisor_max: 0xFFFF }
}

const fn serial(name: &'static str, hz: u32, default: PortConfig) -> PortDescription {
    PortDescription { name, kind: PortKind::Serial { clock: uart_clock(hz) }, default }
}

impl Board for Stm32f405 {
    const DESCRIPTION: &'static Description = &Description {
        number: 1,
        name: "stm32f405",
        identification: Identification::JOINTBUS,
        ports: &[
            serial("host", 2 * PCLK1_HZ, PortConfig::serial(921_600, 0)),
            serial("rs485-a", PCLK1_HZ, PortConfig::serial(115_200, 0)),
            // an NDAM station delimits frames by 10 ms
            serial("rs485-b", PCLK1_HZ, PortConfig::serial(19_200, 110)),
            PortDescription { name: "can", kind: PortKind::Can, default: PortConfig::can(1000, 127) },
        ],
        local: Units::KINDS,
        routes: &[
            Route::remote(1, 15, Target::Bus(CAN), Protocol::NstOverCan, 1),
            Route::remote(16, 30, Target::Bus(RS485_A), Protocol::Nst, 1),
            Route::local(31, OUTPUTS),
            Route::remote(32, 39, Target::Bus(RS485_B), Protocol::ModbusRtu, 1),
            Route::local(40, INPUTS_OUTPUTS),
            Route::local(247, Target::Bridge),
        ],
        limits: Limits::DEFAULT,
    };
    type Units = Units;
}
