//! Settings: staged, stored, and cut off while they are.

use super::*;
use jointbus_mcu_bridge::registers::{self, command};
use std::path::PathBuf;

/// Probe period in ms, which the tests of the store change and look for.
const PROBE_PERIOD: u16 = registers::PROBE_PERIOD.address;

/// A file for the flash, gone when it is dropped.
struct FlashFile(PathBuf);

impl FlashFile {
    fn new(name: &str) -> Self {
        Self(std::env::temp_dir().join(format!("jointbus-{name}-{}", std::process::id())))
    }

    fn options(&self) -> Options {
        Options { flash: Some(self.0.clone()), ..options() }
    }
}

impl Drop for FlashFile {
    fn drop(&mut self) {
        // it may never have been made
        let _ = std::fs::remove_file(&self.0);
    }
}

#[test]
fn saved_settings_outlive_the_power() {
    let file = FlashFile::new("saved");
    let bench = Bench::emulated(&file.options()).unwrap();
    let mut client = bench.client().unwrap();
    client.modbus(bridge::UNIT).write_register(PROBE_PERIOD, 777).unwrap();
    client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::SAVE).unwrap();
    drop(bench);
    let bench = Bench::emulated(&file.options()).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 0);
    assert_eq!(client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap(), [777]);
    client.nst(CAN_UNIT).sample().unwrap();
}

#[test]
fn a_power_cut_while_settings_are_saved_leaves_the_former_or_the_new_ones() {
    let file = FlashFile::new("cut");
    let mut known = 1000;
    for round in 1..=8u16 {
        let bench = Bench::emulated(&file.options()).unwrap();
        let mut client = bench.client().unwrap();
        assert_eq!(bridge::about(&mut client).unwrap().health, 0, "the store is readable");
        let found = client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap()[0];
        assert!(found == known || found == known + 1, "{found} is neither {known} nor the next");
        if round == 1 {
            client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::SAVE).unwrap();
        }
        known = found;
        client.modbus(bridge::UNIT).write_register(PROBE_PERIOD, known + 1).unwrap();
        let save = Request::WriteSingleRegister { address: registers::COMMAND.address, value: command::SAVE };
        let mut frame = [0; 8];
        client.send(rtu::encode_request(bridge::UNIT, &save, &mut frame).unwrap()).unwrap();
        // the moment of the cut is left to chance and spread a little
        std::thread::sleep(Duration::from_micros(u64::from(round) * 700));
        drop(bench);
    }
}

#[test]
fn an_unreadable_store_gives_the_defaults_and_says_so() {
    let file = FlashFile::new("unreadable");
    std::fs::write(&file.0, [0x5A; 2 * 128 * 1024]).unwrap();
    let bench = Bench::emulated(&file.options()).unwrap();
    let mut client = bench.client().unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 1 << 3);
    assert_eq!(client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap(), [1000]);
    client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::SAVE).unwrap();
    drop(bench);
    let bench = Bench::emulated(&file.options()).unwrap();
    assert_eq!(bridge::about(&mut bench.client().unwrap()).unwrap().health, 0);
}

#[test]
fn the_reboot_command_is_answered_and_then_carried_out() {
    let bench = Bench::emulated(&options()).unwrap();
    let mut client = bench.client().unwrap();
    client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::REBOOT).unwrap();
    client.set_timeout(Duration::from_millis(500));
    until(|| matches!(bridge::about(&mut client), Ok(about) if about.reset_cause == 3));
}

#[test]
fn whichever_change_of_the_flash_the_power_cut_meets_the_former_or_the_new_settings_are_there() {
    let file = FlashFile::new("counted");
    let mut known = 1000;
    // a save is some ninety words; what is more than it has is not met, and the save is answered
    for change in (1..=8).chain((9..130).step_by(12)) {
        let bench = Bench::emulated(&file.options()).unwrap();
        let mut client = bench.client().unwrap();
        assert_eq!(bridge::about(&mut client).unwrap().health, 0, "readable, cut before change {change}");
        let found = client.modbus(bridge::UNIT).read_holding_registers(PROBE_PERIOD, 1).unwrap()[0];
        assert!(found == known || found == known + 1, "{found} is neither {known} nor the next");
        if change == 1 {
            client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::SAVE).unwrap();
        }
        known = found;
        client.modbus(bridge::UNIT).write_register(PROBE_PERIOD, known + 1).unwrap();
        emulator(&bench).fault(&format!("cut {change}")).unwrap();
        if client.modbus(bridge::UNIT).write_register(registers::COMMAND.address, command::SAVE).is_ok() {
            assert!(change > 8, "a save changes more than {change} words");
            known += 1;
        }
    }
}

#[test]
fn a_change_without_confirmation_is_taken_back_and_one_with_it_stays() {
    /// Route 3, to the station: its first remote address.
    const REMOTE: u16 = registers::ROUTE_FIRST_ADDRESS.at(3);
    let mut bench = Bench::emulated(&options()).unwrap();
    bench.client().unwrap().modbus(RS485_B_UNIT).read_coils(0x0200, 8).unwrap();
    bench
        .set_limits(&Limits { read_ms: 300, retries: 0, late_response_window_ms: 1, ..Limits::GENEROUS })
        .unwrap();
    let mut client = bench.client().unwrap();
    let mut own = client.modbus(bridge::UNIT);
    own.write_register(REMOTE, 50).unwrap();
    own.write_register(registers::COMMAND.address, command::APPLY).unwrap();
    assert_eq!(bridge::about(&mut client).unwrap().health, 1 << 4, "not confirmed yet");
    let refused = client.modbus(RS485_B_UNIT).read_coils(0x0200, 8);
    assert!(matches!(refused, Err(Error::Exception(_))), "nobody has address 50: {refused:?}");
    until(|| bridge::about(&mut client).unwrap().health == 0);
    assert_eq!(client.modbus(bridge::UNIT).read_holding_registers(REMOTE, 1).unwrap(), [1]);
    until(|| client.modbus(RS485_B_UNIT).read_coils(0x0200, 8).is_ok());

    let mut own = client.modbus(bridge::UNIT);
    own.write_register(REMOTE, 50).unwrap();
    own.write_register(registers::COMMAND.address, command::APPLY).unwrap();
    own.write_register(registers::COMMAND.address, command::CONFIRM).unwrap();
    let start = bridge::about(&mut client).unwrap().uptime_us;
    until(|| bridge::about(&mut client).unwrap().uptime_us > start + 11_000_000);
    assert_eq!(client.modbus(bridge::UNIT).read_holding_registers(REMOTE, 1).unwrap(), [50]);
}
