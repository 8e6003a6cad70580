//! The general server with the CRC tables of 2 KiB.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::server::WithSlices);
