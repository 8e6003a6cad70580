//! Programs of others talk to the emulated image: mbpoll through a PTY, pymodbus over TCP, python-can on the CAN port.

#![cfg(unix)]

mod common;

use jointbus::bench::LAYOUT;
use jointbus::bridge::{self, Limits};
use jointbus::client::{self, Client};
use jointbus::clock::Clock;
use jointbus::devices::attach::{self, Attached};
use jointbus::devices::{NdamLine, PATIENT};
use jointbus_protocol::nst::{Sample, SignEncoding};
use jointbus_protocol::time::Instant;
use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// Only a hang reaches it.
const PATIENCE: Duration = Duration::from_secs(120);

/// A program that ends with its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // it may have ended by itself
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The image as `cargo xtask emulate` runs it.
struct Emulate {
    host: SocketAddr,
    rs485_b: SocketAddr,
    can: SocketAddr,
    _program: Running,
}

impl Emulate {
    fn start() -> Self {
        // kept until all are chosen, so that no two are the same
        let listeners: [TcpListener; 4] = std::array::from_fn(|_| TcpListener::bind("127.0.0.1:0").unwrap());
        let [host, rs485_a, rs485_b, can] =
            listeners.each_ref().map(|listener| listener.local_addr().unwrap());
        drop(listeners);
        let mut command = Command::new(env!("CARGO_BIN_EXE_emulate"));
        command.arg("--image").arg(common::image()).arg("--plugin").arg(common::plugin());
        for (name, address) in
            [("--host", host), ("--rs485-a", rs485_a), ("--rs485-b", rs485_b), ("--can", can)]
        {
            command.arg(name).arg(address.to_string());
        }
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        let program = Running(child);
        assert!(output.lines().any(|line| line.unwrap() == "ready"), "it ended before it was ready");
        let mut client = Client::new(client::connect(host).unwrap(), PATIENCE);
        bridge::set_limits(&mut client, &Limits::GENEROUS).unwrap();
        Self { host, rs485_b, can, _program: program }
    }

    /// The simulated station as anybody attaches it.
    fn station(&self) -> Attached<NdamLine<1>> {
        let line = NdamLine::new(LAYOUT, 1, PATIENT).unwrap();
        attach::serial(client::connect(self.rs485_b).unwrap(), line, Clock::default()).unwrap()
    }
}

/// Runs a program to its end, which must be a good one; what it printed.
fn finish(command: &mut Command) -> String {
    let mut child = Running(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    let deadline = std::time::Instant::now() + PATIENCE;
    let status = loop {
        match child.0.try_wait().unwrap() {
            Some(status) => break status,
            None if std::time::Instant::now() >= deadline => panic!("{command:?} does not end"),
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    let mut text = String::new();
    child.0.stdout.take().unwrap().read_to_string(&mut text).unwrap();
    child.0.stderr.take().unwrap().read_to_string(&mut text).unwrap();
    assert!(status.success(), "{command:?}: {status}\n{text}");
    text
}

#[test]
fn mbpoll_reads_the_station_through_a_pty() {
    let emulate = Emulate::start();
    let station = emulate.station();
    let analog: [u16; 3] = std::array::from_fn(|index| 0x1230 + index as u16);
    station.lock().module(0).unwrap().analog_outputs[..3].copy_from_slice(&analog);

    let link = std::env::temp_dir().join(format!("jointbus-mbpoll-{}", std::process::id()));
    let pty = format!("PTY,link={},raw,echo=0", link.display());
    let _socat =
        Running(Command::new("socat").arg(pty).arg(format!("TCP:{}", emulate.host)).spawn().unwrap());
    wait_for(&link);
    // holding registers of unit 32 from 0x0060, counted from 0, once, hexadecimal
    let text = finish(
        Command::new("mbpoll")
            .args(["-m", "rtu", "-a", "32", "-b", "19200", "-P", "none", "-0"])
            .args(["-t", "4:hex", "-r", "96", "-c", "3", "-1", "-o", "10"])
            .arg(&link),
    );
    for (index, value) in analog.iter().enumerate() {
        assert!(text.contains(&format!("[{}]: \t0x{value:04X}", 0x60 + index)), "{text}");
    }
}

#[test]
fn pymodbus_reads_and_writes_the_station_over_tcp() {
    let emulate = Emulate::start();
    let station = emulate.station();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/clients/poll_station.py");
    let text = finish(Command::new(common::python()).arg(script).arg(emulate.host.port().to_string()));
    assert!(text.contains("all as expected"), "{text}");
    let read = text.lines().find_map(|line| line.strip_prefix("AI ")).expect("a line with the analog inputs");
    let read: Vec<u16> = read.split(' ').map(|value| value.parse().unwrap()).collect();
    let mut line = station.lock();
    let ever = Instant::from_micros(u64::MAX);
    assert!(
        line.told().between(Instant::default(), ever).any(|(_, told)| told.analog[..8] == read),
        "{read:?}"
    );
    let module = line.module(0).unwrap();
    assert_eq!((module.outputs & 0x0F, &module.analog_outputs[..3]), (0b1101, &[11, 22, 33][..]));
}

#[test]
fn python_can_opens_the_can_port_and_answers_as_a_sensor() {
    let emulate = Emulate::start();
    let sample = Sample([1000, -2000, 3000, -4, 5, -6]);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/clients/answer_sensor.py");
    let mut sensor = Running(
        Command::new(common::python())
            .arg(script)
            .arg(emulate.can.port().to_string())
            .args(sample.encode(SignEncoding::TwosComplement).map(|byte| byte.to_string()))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap(),
    );
    let mut lines = BufReader::new(sensor.0.stdout.take().unwrap()).lines();
    assert_eq!(lines.next().unwrap().unwrap(), "listening");
    let mut client = Client::new(client::connect(emulate.host).unwrap(), PATIENCE);
    assert_eq!(client.nst(1).sample().unwrap(), sample);
    assert_eq!(lines.next().unwrap().unwrap(), "python-can: answered");
}

fn wait_for(path: &Path) {
    let deadline = std::time::Instant::now() + PATIENCE;
    while !path.exists() {
        assert!(std::time::Instant::now() < deadline, "{} does not appear", path.display());
        std::thread::sleep(Duration::from_millis(20));
    }
}
