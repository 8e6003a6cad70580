//! Set-up on systems that are made for the test: one whose packages are in the way, one without `apt-get`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, ffi::OsString};

use tempfile::TempDir;

use super::toolbox::{Toolbox, write_script};
use super::tools::{self, Tool};

/// What is missing on both systems.
const PROGRAM: &str = "a-program-that-nobody-has";

/// A system with the package `in-the-way`, which its `apt-get` removes whenever it installs something.
struct Fake {
    folder: TempDir,
}

impl Fake {
    fn new() -> Self {
        let fake = Self { folder: tempfile::tempdir().unwrap() };
        for folder in ["programs", "installed", "build"] {
            fs::create_dir(fake.path(folder)).unwrap();
        }
        fs::write(fake.package(), "").unwrap();
        let (log, package) = (fake.path("log"), fake.package());
        fake.program(
            "apt-get",
            &format!(
                "echo \"$*\" >> {log}\n\
                 case \" $* \" in\n\
                 *' --download-only '*) : > \"$(sed -n 's/^Dir::Cache::archives \"\\(.*\\)\";/\\1/p' \"$APT_CONFIG\")/a_1.deb\" ;;\n\
                 *' install '*) rm {package} ;;\n\
                 esac",
                log = log.display(),
                package = package.display()
            ),
        );
        fake.program("apt-config", "echo 'Acquire::Retries \"3\";'");
        fake.program("dpkg-query", "echo libc6 amd64 2.36");
        fake.program(
            "dpkg-deb",
            &format!(
                "mkdir -p \"$3/usr/bin\"\nprintf '#!/bin/sh\\nexit 0\\n' > \"$3/usr/bin/{PROGRAM}\"\n\
                 chmod +x \"$3/usr/bin/{PROGRAM}\""
            ),
        );
        fake
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn package(&self) -> PathBuf {
        self.path("installed").join("in-the-way")
    }

    fn program(&self, name: &str, script: &str) {
        write_script(&self.path("programs").join(name), &format!("#!/bin/sh\n{script}\n")).unwrap();
    }

    /// Its programs, before those of the real system that scripts are made of.
    fn toolbox(&self) -> Toolbox {
        let mut path = OsString::from(self.path("programs"));
        path.push(":");
        path.push(env::var_os("PATH").unwrap());
        Toolbox::fake(&self.path("build"), path)
    }

    /// What its `apt-get` was asked for.
    fn asked(&self) -> String {
        fs::read_to_string(self.path("log")).unwrap_or_default()
    }
}

fn is_there(path: &Path) -> bool {
    Command::new(path).status().is_ok_and(|status| status.success())
}

#[test]
fn the_fake_removes_what_is_in_the_way() {
    let fake = Fake::new();
    let toolbox = fake.toolbox();
    assert!(toolbox.command("apt-get").unwrap().args(["install", "tool"]).status().unwrap().success());
    assert!(!fake.package().exists());
}

#[test]
fn a_system_where_apt_would_remove_a_package_stays_as_it_is() {
    let fake = Fake::new();
    let toolbox = fake.toolbox();
    let tool = Tool::example(PROGRAM, Some("tool"));
    tools::ensure(&toolbox, &[tool]).unwrap();
    assert!(is_there(&toolbox.programs().join(PROGRAM)));
    assert!(fake.package().exists(), "{}", fake.asked());
    for line in fake.asked().lines() {
        assert!(line == "update" || line.contains("--download-only"), "{line}");
    }
    // what is there is not fetched again
    let before = fake.asked();
    tools::ensure(&toolbox, &[tool]).unwrap();
    assert_eq!(fake.asked(), before);
}

#[test]
fn a_program_of_the_system_is_used_as_it_is() {
    let fake = Fake::new();
    fake.program(PROGRAM, "exit 0");
    let toolbox = fake.toolbox();
    tools::ensure(&toolbox, &[Tool::example(PROGRAM, Some("tool"))]).unwrap();
    assert_eq!(fake.asked(), "");
    assert!(!toolbox.programs().join(PROGRAM).exists());
}

#[test]
fn a_program_that_does_not_work_is_passed_over() {
    let fake = Fake::new();
    fake.program(PROGRAM, "exit 1");
    let toolbox = fake.toolbox();
    tools::ensure(&toolbox, &[Tool::example(PROGRAM, Some("tool"))]).unwrap();
    assert!(is_there(&toolbox.programs().join(PROGRAM)));
}

#[test]
fn a_system_without_apt_gets_one_message() {
    let folder = tempfile::tempdir().unwrap();
    let toolbox = Toolbox::fake(folder.path(), folder.path());
    let error = tools::ensure(&toolbox, &[tools::SOCAT]).unwrap_err();
    let message = crate::run::explain(&error);
    for part in [
        "missing: socat, the relay between sockets and terminals, for the tests with real clients",
        "Debian, Ubuntu: sudo apt-get install socat",
        "Fedora:         sudo dnf install socat",
        "Arch:           sudo pacman -S socat",
        "macOS:          brew install socat",
        "there is no apt-get here",
    ] {
        assert!(message.contains(part), "no {part:?} in:\n{message}");
    }
    assert_eq!(message.matches("missing:").count(), 1, "{message}");
}
