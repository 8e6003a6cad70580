//! Emulated STM32F405 peripherals.
