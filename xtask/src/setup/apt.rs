//! Installing packages with Debian's `apt-get`.

use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use anyhow::{Context, Result, bail};

use crate::run;

/// Enough for a slow mirror; without a limit a mirror that does not answer would hang the set-up for good.
const UPDATE_LIMIT: Duration = Duration::from_secs(300);
/// Enough for some hundred megabytes over a slow line.
const INSTALL_LIMIT: Duration = Duration::from_secs(1800);

/// Who we may be when we call `apt-get`.
#[derive(Clone, Copy)]
enum Privilege {
    /// We are root already.
    Root,
    /// `sudo` lets us without a password.
    Sudo,
}

/// Installs the packages, with a line that says so. Fails where there is no `apt-get` or no right to use it, and
/// rather than remove a package that is in the way.
pub(crate) fn install(packages: &[&str]) -> Result<()> {
    let privilege = privilege()?;
    update(privilege);
    println!("setup: installing {} with apt-get", packages.join(", "));
    let mut command = apt_get(privilege);
    command.args(["install", "--yes", "--no-install-recommends", "--no-remove"]).args(packages);
    run::quiet(&mut command, INSTALL_LIMIT)
}

/// Refreshes the package lists, once a run: lists of an image or of last month name files that are gone.
fn update(privilege: Privilege) {
    static DONE: OnceLock<()> = OnceLock::new();
    DONE.get_or_init(|| {
        println!("setup: refreshing the package lists with apt-get");
        if let Err(error) = run::quiet(apt_get(privilege).arg("update"), UPDATE_LIMIT) {
            // The old lists may do; if not, the installation says so and fails.
            println!("setup: going on with the old package lists: {error:#}");
        }
    });
}

/// `apt-get` as root, never asking, and waiting for another one to finish.
fn apt_get(privilege: Privilege) -> Command {
    let mut command = match privilege {
        Privilege::Root => Command::new("env"),
        Privilege::Sudo => {
            let mut command = Command::new("sudo");
            command.args(["-n", "env"]);
            command
        }
    };
    command.args(["DEBIAN_FRONTEND=noninteractive", "apt-get", "-o", "DPkg::Lock::Timeout=300"]);
    command
}

/// What we may do here, or why we may not.
fn privilege() -> Result<Privilege> {
    if run::find("apt-get").is_none() {
        bail!("there is no apt-get here");
    }
    let user = run::output(Command::new("id").arg("-u")).context("cannot tell who we are")?;
    if user.trim() == "0" {
        return Ok(Privilege::Root);
    }
    if run::find("sudo").is_none() {
        bail!("apt-get needs root, and there is no sudo");
    }
    match run::output(Command::new("sudo").args(["-n", "true"])) {
        Ok(_) => Ok(Privilege::Sudo),
        Err(_) => bail!("apt-get needs root, and sudo asks for a password"),
    }
}
