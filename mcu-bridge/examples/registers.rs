//! Writes the page `REGISTERS.md` from the table of the bridge's own unit:
//! `cargo run --package jointbus-mcu-bridge --example registers > mcu-bridge/REGISTERS.md`.

#[path = "../tests/registers/page.rs"]
mod page;

fn main() {
    print!("{}", page::page());
}
