//! Linker arguments of the firmware; the library needs none.

fn main() {
    println!("cargo:rerun-if-changed=../memory.x");
    println!("cargo:rerun-if-changed=build.rs");
    // memory.x lies at the root of the workspace, where cargo runs the linker
    println!("cargo:rustc-link-arg-bin=stm32f405=-Tlink.x");
    println!("cargo:rustc-link-arg-bin=stm32f405=--nmagic");
}
