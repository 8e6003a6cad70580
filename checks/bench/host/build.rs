//! Links against the system's libmodbus where the servers of others are measured.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    if std::env::var_os("CARGO_FEATURE_OTHERS").is_some() {
        println!("cargo:rustc-link-lib=modbus");
    }
}
