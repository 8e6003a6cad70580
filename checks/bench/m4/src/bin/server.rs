//! The general server with the CRC table of 512 bytes.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::server::WithTable);
