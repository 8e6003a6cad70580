//! The firmware's image on the emulated STM32F405, with simulated devices on its ports.

#![cfg(unix)]

#[path = "../common/mod.rs"]
mod common;

mod can;
mod memory;
mod pins;
mod ports;
mod replies;
mod resets;
mod settings;

use jointbus::bench::{Bench, Bridge, CAN_UNIT, RS485_A_UNIT, RS485_B_UNIT};
use jointbus::bridge::{self, Limits, port};
use jointbus::client::{Client, Error};
use jointbus::emulator::{Debugger, Emulator, Options, Port};
use jointbus_protocol::checksum::crc16;
use jointbus_protocol::modbus::{ExceptionCode, Request, rtu};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// Only a hang reaches it.
const PATIENCE: Duration = Duration::from_secs(120);

/// Unit of the board's own inputs and outputs.
const IO_UNIT: u8 = 40;

fn options() -> Options {
    Options::new(common::image(), common::plugin())
}

/// The image in time that is counted by instructions, so that no time that it takes depends on the host. Devices seem
/// slow then.
fn counted() -> Options {
    Options { icount: Some(3), skip_idle: true, ..options() }
}

fn emulator(bench: &Bench) -> &Emulator {
    match &bench.bridge {
        Bridge::Emulated(emulator) => emulator,
        Bridge::InProcess(_) => unreachable!("these tests run the image"),
    }
}

/// The image without devices: a test answers in their place.
struct Bare {
    emulator: Emulator,
    client: Client<TcpStream>,
}

impl Bare {
    fn start(limits: &Limits) -> Self {
        let emulator = Emulator::launch(&options()).unwrap();
        let stream = emulator.connect(Port::Usart1).unwrap();
        jointbus::client::prepare(&stream).unwrap();
        let mut client = Client::new(stream, Duration::from_millis(500));
        bridge::wait(&mut client, PATIENCE).unwrap();
        client.set_timeout(PATIENCE);
        bridge::set_limits(&mut client, limits).unwrap();
        Self { emulator, client }
    }

    /// A connection to a port, to be read and written in a device's place.
    fn device(&self, port: Port) -> TcpStream {
        let stream = self.emulator.connect(port).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream
    }
}

/// Reads so many bytes.
fn take<const N: usize>(device: &mut TcpStream) -> [u8; N] {
    let mut bytes = [0; N];
    device.read_exact(&mut bytes).unwrap();
    bytes
}

/// A frame of either protocol: its content and the CRC of that.
fn frame(content: &[u8]) -> Vec<u8> {
    [content, &crc16(content).to_le_bytes()].concat()
}

/// Where an emulator's debugger listens. No TCP port: another test may take one that was free a moment ago.
struct DebuggerSocket(PathBuf);

impl Drop for DebuggerSocket {
    fn drop(&mut self) {
        // it is there only where the emulator was started
        let _ = std::fs::remove_file(&self.0);
    }
}

/// Options with the emulator's debugger port, and where that listens.
fn debuggable(options: Options) -> (Options, DebuggerSocket) {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let (process, count) = (std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    let path = std::env::temp_dir().join(format!("jointbus-debugger-{process}-{count}"));
    let socket = format!("socket,id=debugger,path={},server=on,wait=off", path.display());
    let arguments = ["-chardev", &socket, "-gdb", "chardev:debugger"].map(Into::into).to_vec();
    (Options { arguments, ..options }, DebuggerSocket(path))
}

fn stop(debugger: &DebuggerSocket) -> Debugger {
    Debugger::stop(&debugger.0, PATIENCE).unwrap()
}

fn until(mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !reached() {
        assert!(Instant::now() < deadline, "not reached in {PATIENCE:?}");
    }
}
