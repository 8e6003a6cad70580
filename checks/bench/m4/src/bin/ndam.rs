//! The NDAM-9010 dispatcher.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::device::Ndam);
