//! Programs from the system's packages.

use anyhow::{Context, Result, bail};

use super::apt;
use crate::run;

/// A program, and what it is called where people install it.
#[derive(Clone, Copy)]
pub(crate) struct Tool {
    /// The name in `PATH`.
    program: &'static str,
    /// Debian's package.
    package: &'static str,
    /// What to look for elsewhere.
    elsewhere: &'static str,
}

/// Runs the image.
pub(crate) const QEMU: Tool = Tool {
    program: "qemu-system-arm",
    package: "qemu-system-arm",
    elsewhere: "QEMU's system emulator for Arm, built with plugin support",
};

/// A Modbus master on the command line.
pub(crate) const MBPOLL: Tool =
    Tool { program: "mbpoll", package: "mbpoll", elsewhere: "mbpoll, the command-line Modbus master" };

/// Joins sockets and pseudo-terminals.
pub(crate) const SOCAT: Tool =
    Tool { program: "socat", package: "socat", elsewhere: "socat, the relay between sockets and terminals" };

/// Counts the instructions of a program.
pub(crate) const VALGRIND: Tool =
    Tool { program: "valgrind", package: "valgrind", elsewhere: "Valgrind with callgrind" };

/// Compiles the fuzzer's runtime.
pub(crate) const CXX: Tool = Tool { program: "c++", package: "g++", elsewhere: "a C++ compiler called c++" };

/// Installs those of the programs that are missing.
pub(crate) fn ensure(tools: &[Tool]) -> Result<()> {
    let missing = missing(tools);
    if missing.is_empty() {
        return Ok(());
    }
    let packages: Vec<_> = missing.iter().map(|tool| tool.package).collect();
    apt::install(&packages).with_context(|| advice(&missing))?;
    let still = self::missing(tools);
    if !still.is_empty() {
        bail!("apt-get installed the packages, but PATH does not lead to them\n{}", advice(&still));
    }
    Ok(())
}

/// Those that `PATH` does not lead to.
fn missing(tools: &[Tool]) -> Vec<Tool> {
    tools.iter().copied().filter(|tool| run::find(tool.program).is_none()).collect()
}

/// What a person should install.
fn advice(tools: &[Tool]) -> String {
    let list = |name: fn(&Tool) -> &'static str, between: &str| -> String {
        tools.iter().map(name).collect::<Vec<_>>().join(between)
    };
    format!(
        "missing: {}\n  Debian and Ubuntu: apt-get install {}\n  elsewhere: {}",
        list(|tool| tool.program, ", "),
        list(|tool| tool.package, " "),
        list(|tool| tool.elsewhere, "; "),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const ABSENT: Tool = Tool {
        program: "a-program-that-nobody-has",
        package: "absent-package",
        elsewhere: "absent, anywhere",
    };
    const PRESENT: Tool = Tool { program: "sh", package: "dash", elsewhere: "a shell" };

    #[test]
    fn only_absent_programs_are_missing() {
        let names: Vec<_> = missing(&[PRESENT, ABSENT]).iter().map(|tool| tool.program).collect();
        assert_eq!(names, ["a-program-that-nobody-has"]);
    }

    #[test]
    fn the_advice_names_the_package_and_the_thing() {
        let text = advice(&[ABSENT, PRESENT]);
        assert!(text.contains("apt-get install absent-package dash\n"), "{text}");
        assert!(text.ends_with("elsewhere: absent, anywhere; a shell"), "{text}");
    }
}
