//! The README's commands on a system that has just been installed, as an ordinary user who has Rust and nothing else of
//! ours: what set-up forgets shows here, and not on a machine where it was installed by hand long ago.

use std::env;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};

use crate::progress::{self, shown};
use crate::workspace::Workspace;
use crate::{run, setup};

/// What the README asks of a Debian system beside Rust itself.
const PREREQUISITES: &str = "ca-certificates,g++,git";

/// The ordinary user.
const USER: &str = "joint";
const USER_ID: u32 = 1000;

/// A bare system, a clone of this repository in it, and a Rust toolchain.
const LIMIT: Duration = Duration::from_secs(1800);

/// What the user's programs are told of the network here, if anything.
const NETWORK: [&str; 10] = [
    "http_proxy",
    "https_proxy",
    "no_proxy",
    "SSL_CERT_FILE",
    "CARGO_HTTP_CAINFO",
    "CARGO_HTTP_PROXY",
    "PIP_CERT",
    "PIP_INDEX_URL",
    "RUSTUP_DIST_SERVER",
    "RUSTUP_UPDATE_ROOT",
];

/// A release of Debian.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Suite {
    /// Debian 12
    Bookworm,
    /// Debian 13
    Trixie,
}

/// Which system to make.
#[derive(Args)]
pub(crate) struct Manner {
    /// The release of Debian
    suite: Suite,
    /// Run these arguments of `cargo xtask` there instead of the README's two commands
    #[arg(last = true)]
    instead: Vec<String>,
}

impl Suite {
    const fn name(self) -> &'static str {
        match self {
            Self::Bookworm => "bookworm",
            Self::Trixie => "trixie",
        }
    }
}

/// Makes the system anew and runs the commands in it.
pub(crate) fn fresh(workspace: &Workspace, manner: &Manner) -> Result<()> {
    let start = Instant::now();
    let user = run::output(Command::new("id").arg("-u"))?;
    ensure!(
        user.trim() == "0",
        "a bare system can only be made by root: run this as root, or in a container"
    );
    let root = workspace.target.join("fresh").join(manner.suite.name());
    let system = System { root };
    progress::during("making a bare system", Duration::from_secs(60), || {
        system.make(workspace, manner.suite)
    })?;
    progress::during("installing Rust for its user", Duration::from_secs(60), || {
        system.install_rust(workspace)
    })?;
    progress::during("cloning the repository into it", Duration::from_secs(5), || system.clone(workspace))?;
    let readme: [&[&str]; 2] = [&["demo", "--seconds", "10"], &["test"]];
    let instead: Vec<&str> = manner.instead.iter().map(String::as_str).collect();
    let commands = if instead.is_empty() { &readme[..] } else { &[&instead[..]][..] };
    for arguments in commands {
        let last = system.xtask(arguments)?;
        if arguments.contains(&"demo") && !arguments.contains(&"--in-process") {
            ensure!(last.contains("the firmware image"), "the demonstration ran without the image: {last}");
        }
    }
    println!("\n{}: passed on a bare system in {}", manner.suite.name(), shown(start.elapsed()));
    Ok(())
}

/// A system in a folder.
struct System {
    root: PathBuf,
}

impl System {
    fn make(&self, workspace: &Workspace, suite: Suite) -> Result<()> {
        if self.root.exists() {
            // Never beyond it, whatever an interrupted run has left mounted.
            let mut command = Command::new("rm");
            run::quiet(command.args(["-rf", "--one-file-system"]).arg(&self.root), LIMIT)?;
        }
        fs::create_dir_all(&self.root)?;
        let mut command = setup::debootstrap(workspace)?;
        command.args(["--variant=minbase", &format!("--include={PREREQUISITES}"), suite.name()]);
        run::quiet(command.arg(&self.root).arg(setup::debian_mirror(workspace)?), LIMIT)?;
        for file in ["etc/resolv.conf", "etc/hosts", "etc/ssl/certs/ca-certificates.crt"] {
            let here = Path::new("/").join(file);
            if here.exists() {
                fs::copy(&here, self.root.join(file))
                    .with_context(|| format!("cannot copy {}", here.display()))?;
            }
        }
        // How packages are reached is the same as here; everything else is as it is on a new system.
        let settings = run::output(Command::new("apt-config").args(["dump", "Acquire"]))?;
        let settings: String =
            settings.lines().filter(|line| line.contains("::")).flat_map(|line| [line, "\n"]).collect();
        fs::write(self.root.join("etc/apt/apt.conf.d/90network"), settings)?;
        self.inside(0, &format!("useradd --create-home --shell /bin/sh --uid {USER_ID} {USER}"), LIMIT)
    }

    /// Rustup and the stable toolchain that is active here; any other one is for set-up to bring.
    fn install_rust(&self, workspace: &Workspace) -> Result<()> {
        let rustup = run::find("rustup").context("rustup is not here; the bare system gets a copy of it")?;
        let sysroot = run::output(workspace.command("rustc").args(["--print", "sysroot"]))?;
        let toolchain = Path::new(sysroot.trim());
        let name = toolchain.file_name().context("the toolchain has no name")?;
        let (programs, toolchains) = (self.home().join(".cargo/bin"), self.home().join(".rustup/toolchains"));
        fs::create_dir_all(&programs)?;
        fs::create_dir_all(&toolchains)?;
        for proxy in
            ["rustup", "cargo", "rustc", "rustdoc", "cargo-fmt", "rustfmt", "cargo-clippy", "cargo-miri"]
        {
            fs::copy(&rustup, programs.join(proxy))?;
        }
        let mut command = Command::new("cp");
        run::quiet(command.arg("--archive").arg(toolchain).arg(toolchains.join(name)), LIMIT)?;
        self.inside(0, &format!("chown --recursive {USER}: /home/{USER}"), LIMIT)?;
        self.inside(USER_ID, &format!("rustup default {}", name.display()), LIMIT)
    }

    /// What is committed.
    fn clone(&self, workspace: &Workspace) -> Result<()> {
        let clone = self.home().join("jointbus");
        let mut command = Command::new("git");
        command.args(["clone", "--quiet", "--no-hardlinks"]).arg(&workspace.root).arg(&clone);
        run::quiet(&mut command, LIMIT)?;
        self.inside(0, &format!("chown --recursive {USER}: /home/{USER}/jointbus"), LIMIT)
    }

    /// A command of the README; its last line.
    fn xtask(&self, arguments: &[&str]) -> Result<String> {
        let line = format!("cargo xtask {}", arguments.join(" "));
        println!("\n$ {line}");
        let mut command = self.enter(USER_ID, &format!("cd jointbus && {line}"));
        let mut log = File::create(self.root.with_extension("log"))?;
        // One pipe for both, so that their lines stay in order.
        let (reader, writer) = std::io::pipe()?;
        command.stdin(Stdio::null()).stdout(writer.try_clone()?).stderr(writer);
        let mut child = command.spawn().context("cannot enter the bare system")?;
        drop(command);
        let mut last = String::new();
        for read in BufReader::new(reader).lines() {
            let read = read.unwrap_or_default();
            println!("{read}");
            writeln!(log, "{read}")?;
            if !read.trim().is_empty() {
                last = read;
            }
        }
        let status = child.wait()?;
        if !status.success() {
            bail!("`{line}` ended with {status} on the bare system, {}", self.root.display());
        }
        Ok(last)
    }

    fn inside(&self, user: u32, line: &str, limit: Duration) -> Result<()> {
        run::quiet(&mut self.enter(user, line), limit)
    }

    /// A shell in the system, which has its devices and processes only as long as it runs.
    fn enter(&self, user: u32, line: &str) -> Command {
        let root = run::quoted(&self.root.to_string_lossy());
        let home = if user == 0 { "/root".into() } else { format!("/home/{USER}") };
        let path = format!("{home}/.cargo/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin");
        let network = NETWORK.iter().filter_map(|name| {
            let value = env::var_os(name)?;
            Some(format!("{name}={}", run::quoted(&value.to_string_lossy())))
        });
        let variables = network.collect::<Vec<_>>().join(" ");
        let script = format!(
            "mount -t proc proc {root}/proc && mount --rbind /dev {root}/dev && \
             exec chroot --userspec={user}:{user} {root} env -i HOME={home} PATH={path} {variables} sh -c {}",
            run::quoted(&format!("cd {home} && {line}"))
        );
        let mut command = Command::new("unshare");
        command.args(["--mount", "--pid", "--fork", "--kill-child", "sh", "-c", &script]);
        command
    }

    fn home(&self) -> PathBuf {
        self.root.join("home").join(USER)
    }
}
