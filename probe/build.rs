//! Linker arguments of the image that runs; the other one needs none.

fn main() {
    println!("cargo:rerun-if-changed=../memory.x");
    println!("cargo:rerun-if-changed=build.rs");
    // memory.x lies at the root of the workspace, where cargo runs the linker
    println!("cargo:rustc-link-arg-bin=measure=-Tlink.x");
    println!("cargo:rustc-link-arg-bin=measure=--nmagic");
}
