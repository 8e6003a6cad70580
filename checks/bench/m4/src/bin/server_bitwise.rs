//! The general server without a CRC table.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::server::WithoutTable);
