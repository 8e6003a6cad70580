//! A routing table with one route.
#![no_std]
#![no_main]

jointbus_bench_m4::image!(jointbus_bench_subjects::routes::Routes<1>);
