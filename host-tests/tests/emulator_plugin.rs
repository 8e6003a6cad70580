//! The emulator's plugin in a real QEMU, without any firmware: a dozen instructions put the CAN controller on the
//! bus, the rest is asked from outside.
//!
//! The plugin is `JOINTBUS_EMULATOR_PLUGIN`, or the one that was built with the tests.
#![cfg(unix)]

use anyhow::{Context, Result, ensure};
use jointbus::emulator::{Capture, Emulator, Options, Port};
use std::path::PathBuf;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(30);

/// Vectors and code: enables CAN1's clock, requests initialisation and leaves it again.
const IMAGE: [u32; 10] = [
    0x2000_1000, // initial stack pointer
    0x0800_0009, // reset: the next word, Thumb
    0x4905_4804, // ldr r0, [0x1c]; ldr r1, [0x20]
    0x4805_6001, // str r1, [r0]; ldr r0, [0x24]
    0x6001_2101, // movs r1, #1; str r1, [r0]
    0x6001_2100, // movs r1, #0; str r1, [r0]
    0xbf00_e7fe, // b .; nop
    0x4002_3840, // RCC_APB1ENR
    1 << 25,     // CAN1EN
    0x4000_6400, // CAN1_MCR
];

/// The image as a file that is gone at the end of the test.
struct ImageFile(PathBuf);

impl ImageFile {
    fn write(name: &str) -> Result<Self> {
        let path = std::env::temp_dir().join(format!("jointbus-{}-{name}.bin", std::process::id()));
        std::fs::write(&path, IMAGE.map(u32::to_le_bytes).concat())?;
        Ok(Self(path))
    }
}

impl Drop for ImageFile {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

fn plugin() -> Result<PathBuf> {
    if let Some(path) = std::env::var_os("JOINTBUS_EMULATOR_PLUGIN") {
        return Ok(path.into());
    }
    let test = std::env::current_exe()?;
    let beside = test.ancestors().nth(2).context("a test has a folder")?.join("libjointbus_emulator.so");
    ensure!(beside.exists(), "no {}: cargo build -p jointbus-emulator", beside.display());
    Ok(beside)
}

/// Sends frames until the controller is there to acknowledge one.
fn wait_for_controller(can: &Capture) -> Result<()> {
    for _ in 0..1000 {
        can.send(b"t1230\r")?;
        if can.wait_for(b"z\r", Duration::from_millis(20)).is_ok() {
            return Ok(());
        }
    }
    can.wait_for(b"z\r", PATIENCE).map(drop)
}

#[test]
fn the_adapter_answers_while_the_machine_stands_still() -> Result<()> {
    let image = ImageFile::write("paused")?;
    let mut options = Options::new(&image.0, plugin()?);
    options.paused = true;
    let mut emulator = Emulator::launch(&options)?;
    let can = emulator.capture(Port::Can)?;
    can.send(b"C\rO\rV\rt1230\r")?;
    can.wait_for(b"\r\rV0100\r", PATIENCE)?;
    assert_eq!(can.take(), b"");
    emulator.resume()?;
    wait_for_controller(&can)?;
    assert_eq!(emulator.messages(), "");
    emulator.quit()
}

#[test]
fn the_controller_acknowledges_unless_the_bus_is_stuck() -> Result<()> {
    let image = ImageFile::write("stuck")?;
    let mut emulator = Emulator::launch(&Options::new(&image.0, plugin()?))?;
    let can = emulator.capture(Port::Can)?;
    wait_for_controller(&can)?;
    emulator.fault("bus 0")?;
    emulator.reset()?;
    can.send(b"T000000010\r")?;
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(can.take(), b"", "nothing passes a stuck bus");
    emulator.fault("bus 1")?;
    wait_for_controller(&can)?;
    assert!(emulator.fault("no such fault").is_err());
    emulator.check()
}

#[test]
fn it_counts_instructions_where_asked_to() -> Result<()> {
    let image = ImageFile::write("icount")?;
    let mut options = Options::new(&image.0, plugin()?);
    options.icount = Some(3);
    let emulator = Emulator::launch(&options)?;
    wait_for_controller(&emulator.capture(Port::Can)?)?;
    emulator.quit()
}

#[test]
fn another_machine_is_refused_with_a_word() -> Result<()> {
    let image = ImageFile::write("machine")?;
    let mut options = Options::new(&image.0, plugin()?);
    options.arguments = vec!["-M".into(), "lm3s6965evb".into()];
    let error = Emulator::launch(&options).unwrap_err().to_string();
    assert!(error.contains("no STM32F405"), "{error}");
    Ok(())
}

#[test]
fn qemu_ends_with_the_emulator() -> Result<()> {
    let image = ImageFile::write("drop")?;
    let emulator = Emulator::launch(&Options::new(&image.0, plugin()?))?;
    let process = PathBuf::from(format!("/proc/{}", emulator.id()));
    assert!(process.exists() || !cfg!(target_os = "linux"));
    drop(emulator);
    assert!(!process.exists());
    Ok(())
}
