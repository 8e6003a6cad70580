//! modbus-core.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::others::modbus_core::ModbusCore);
