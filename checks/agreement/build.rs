//! Links against the system's libmodbus.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rustc-link-lib=modbus");
}
