//! The NXI-6201 dispatcher.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::device::Nxi);
