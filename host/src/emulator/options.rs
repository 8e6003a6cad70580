//! What to emulate, and how: QEMU's command line.

use super::Port;
use anyhow::{Context, Result};
use std::env;
use std::ffi::{OsStr, OsString};
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::os::fd::RawFd;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

/// Environment variable that names the QEMU to run.
pub const QEMU: &str = "JOINTBUS_QEMU";

/// Where a port listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Endpoint {
    /// On 127.0.0.1, wherever there is room; [`Emulator::address`](super::Emulator::address) says where.
    #[default]
    Free,
    /// Here.
    At(SocketAddr),
}

/// What to emulate, and how.
#[derive(Debug, Clone)]
pub struct Options {
    /// The firmware, as an ELF file.
    pub image: PathBuf,
    /// The plugin's library.
    pub plugin: PathBuf,
    /// QEMU: a path, or a name to look for in `PATH`. At first the one that the environment names ([`QEMU`]), else
    /// `qemu-system-arm`.
    pub qemu: PathBuf,
    /// The host's port.
    pub usart1: Endpoint,
    /// The first RS-485 bus.
    pub usart2: Endpoint,
    /// The second RS-485 bus.
    pub usart3: Endpoint,
    /// The CAN bus.
    pub can: Endpoint,
    /// The fault console.
    pub faults: Endpoint,
    /// Whether the board has its crystal.
    pub crystal: bool,
    /// Whether the CAN controller answers.
    pub can_controller: bool,
    /// Whether the independent watchdog bites. In wall time a machine that is busy otherwise lets it starve, so this wants
    /// [`Options::icount`].
    pub watchdog: bool,
    /// File that keeps the flash's sectors 10 and 11, whatever ends QEMU; without one they are erased at the start.
    pub flash: Option<PathBuf>,
    /// With this, an instruction takes 2^N ns of the machine's time, however long the host needs for it.
    pub icount: Option<u8>,
    /// With [`Options::icount`]: time in which the processor sleeps passes at once. The machine's time then owes nothing to
    /// the host's clock, and whoever answers it from outside seems slow.
    pub skip_idle: bool,
    /// Hold the machine before its first instruction, until [`Emulator::resume`](super::Emulator::resume), so that no port misses anything.
    pub paused: bool,
    /// Time that QEMU has to start, and to answer. Generous, for machines that have other things to do.
    pub patience: Duration,
    /// Further arguments for QEMU.
    pub arguments: Vec<OsString>,
}

impl Options {
    /// An image and the plugin; all ports free, a crystal, running in wall time.
    pub fn new(image: impl Into<PathBuf>, plugin: impl Into<PathBuf>) -> Self {
        Self {
            image: image.into(),
            plugin: plugin.into(),
            qemu: env::var_os(QEMU).map_or_else(|| "qemu-system-arm".into(), PathBuf::from),
            usart1: Endpoint::Free,
            usart2: Endpoint::Free,
            usart3: Endpoint::Free,
            can: Endpoint::Free,
            faults: Endpoint::Free,
            crystal: true,
            can_controller: true,
            watchdog: false,
            flash: None,
            icount: None,
            skip_idle: false,
            paused: false,
            patience: Duration::from_secs(30),
            arguments: Vec::new(),
        }
    }

    const fn endpoint(&self, port: Port) -> Endpoint {
        match port {
            Port::Usart1 => self.usart1,
            Port::Usart2 => self.usart2,
            Port::Usart3 => self.usart3,
            Port::Can => self.can,
            Port::Faults => self.faults,
        }
    }

    pub(super) fn has_free_endpoints(&self) -> bool {
        Port::ALL.iter().any(|&port| self.endpoint(port) == Endpoint::Free)
    }

    /// An address for every port.
    pub(super) fn addresses(&self) -> Result<[SocketAddr; Port::ALL.len()]> {
        // All are held until all are chosen, so that they differ.
        let mut held = Vec::new();
        let mut addresses = [SocketAddr::from((Ipv4Addr::LOCALHOST, 0)); Port::ALL.len()];
        for (address, &port) in addresses.iter_mut().zip(&Port::ALL) {
            *address = match self.endpoint(port) {
                Endpoint::At(address) => address,
                Endpoint::Free => {
                    let listener = TcpListener::bind(*address).context("no free port on 127.0.0.1")?;
                    let address = listener.local_addr()?;
                    held.push(listener);
                    address
                }
            };
        }
        Ok(addresses)
    }

    /// QEMU's command line.
    pub(super) fn command(&self, addresses: &[SocketAddr], monitor: RawFd) -> Command {
        let mut command = Command::new(&self.qemu);
        command.args(["-M", "netduinoplus2", "-display", "none", "-monitor", "none", "-S"]);
        command.arg("-kernel").arg(&self.image);
        let mut plugin = escaped(self.plugin.as_os_str());
        plugin.push(if self.crystal { ",crystal=on" } else { ",crystal=off" });
        if !self.can_controller {
            plugin.push(",can=off");
        }
        if self.watchdog {
            plugin.push(",watchdog=on");
        }
        if let Some(flash) = &self.flash {
            plugin.push(",flash=");
            plugin.push(escaped(flash.as_os_str()));
        }
        command.arg("-plugin").arg(plugin);
        if let Some(shift) = self.icount {
            let sleep = if self.skip_idle { "off" } else { "on" };
            command.args(["-icount", &format!("shift={shift},sleep={sleep}")]);
        }
        command.args(["-chardev", &format!("socket,id=monitor,fd={monitor}")]);
        command.args(["-mon", "chardev=monitor,mode=control"]);
        for (port, address) in Port::ALL.iter().zip(addresses) {
            command.args(["-chardev", &listening(*port, *address)]);
            // the plugin takes the other two by their names
            if *port == Port::Usart1 {
                command.args(["-serial", &format!("chardev:{port}")]);
            }
        }
        command.args(&self.arguments);
        command
    }
}

/// A file name inside an option, where a comma would end it.
fn escaped(name: &OsStr) -> OsString {
    name.to_str().map_or_else(|| name.to_owned(), |name| name.replace(',', ",,").into())
}

fn listening(port: Port, address: SocketAddr) -> String {
    let (host, number) = (address.ip(), address.port());
    format!("socket,id={port},host={host},port={number},server=on,wait=off,nodelay=on")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_ports_differ_and_fixed_ones_stay() {
        let mut options = Options::new("image", "plugin");
        let fixed = SocketAddr::from((Ipv4Addr::LOCALHOST, 1));
        options.can = Endpoint::At(fixed);
        let addresses = options.addresses().unwrap();
        assert_eq!(addresses[Port::Can as usize], fixed);
        let mut ports: Vec<u16> = addresses.iter().map(SocketAddr::port).collect();
        ports.sort_unstable();
        ports.dedup();
        assert_eq!(ports.len(), Port::ALL.len());
        assert!(!ports.contains(&0));
    }

    #[test]
    fn the_command_line_is_as_documented() {
        let mut options = Options::new("image.elf", "a,b.so");
        options.icount = Some(3);
        options.crystal = false;
        let addresses = [SocketAddr::from((Ipv4Addr::LOCALHOST, 5000)); Port::ALL.len()];
        let command = options.command(&addresses, 9);
        let line: Vec<&str> = command.get_args().map(|argument| argument.to_str().unwrap()).collect();
        let line = line.join(" ");
        assert!(line.starts_with(
            "-M netduinoplus2 -display none -monitor none -S -kernel image.elf -plugin a,,b.so,crystal=off"
        ));
        assert!(line.contains("-icount shift=3,sleep=on"));
        assert!(line.contains(
            "-chardev socket,id=usart1,host=127.0.0.1,port=5000,server=on,wait=off,nodelay=on -serial chardev:usart1"
        ));
        assert!(
            line.ends_with(
                "-chardev socket,id=canctl,host=127.0.0.1,port=5000,server=on,wait=off,nodelay=on"
            )
        );
    }
}
