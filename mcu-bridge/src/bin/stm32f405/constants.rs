//! Every number that this board fixes, in one place.

/// Internal oscillator, in Hz.
pub const OSCILLATOR_HZ: u32 = 16_000_000;

/// Core clock from the PLL, in Hz.
pub const CORE_HZ: u32 = 168_000_000;

/// Times that a hardware flag is looked at before it is given up: some 50 ms at the speed before the PLL runs; a
/// crystal needs 2 ms, the PLL 300 us (data sheet, 6.3.8 and 6.3.10).
pub const HARDWARE_TRIES: u32 = 100_000;

/// Period of the tick that wakes the main loop, in us: no deadline is noticed later than this.
pub const TICK_US: u32 = 100;

/// The watchdog's period: its oscillator of nominally 32 kHz, divided by 16, counts so many steps: half a second.
pub const WATCHDOG_STEPS: u32 = 1000;

/// Channels of the converter in the order of the analog inputs: PA0, PA6, PA7, PB0.
pub const ADC_CHANNELS: [u32; 4] = [0, 6, 7, 8];

/// Longest time that a conversion of 5 us may take until the main loop sees it done, in us.
pub const ADC_LIMIT_US: u32 = 10_000;

/// Frames that wait between the CAN interrupt and the main loop, and one: longer than a transfer, some 2 ms at 1 Mbit/s.
pub const CAN_INCOMING: usize = 20;

/// Steps of an analog output over its whole range, negative limit to positive limit.
pub const OUTPUT_STEPS: u32 = 4095;

/// Step of an output that is off: the middle, 0 V or 0 mA behind the output stage.
pub const OUTPUT_OFF: u32 = OUTPUT_STEPS / 2;

/// Where the settings are stored: sectors 10 and 11, which `memory.x` keeps from the program.
pub const STORE_BASE: u32 = 0x080C_0000;

/// Number of the first of them.
pub const STORE_FIRST_SECTOR: u8 = 10;

/// Size of each.
pub const STORE_SECTOR: u32 = 128 * 1024;

/// Size of both.
pub const STORE_SIZE: u32 = 2 * STORE_SECTOR;

/// Longest time that the flash may be busy, in us: erasing a sector takes up to 2 s (data sheet, 6.3.12).
pub const FLASH_LIMIT_US: u32 = 4_000_000;

/// The watchdog's period while settings are stored: divided by 64, some eight seconds.
pub const WATCHDOG_STRETCHED_STEPS: u32 = 4095;
