//! Running other programs: with a line that can be repeated by hand, or silently until something fails.

use std::env;
use std::ffi::OsStr;
use std::io::{Read, Seek};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

/// How often a program with a time limit is asked whether it has ended.
const POLL_EVERY: Duration = Duration::from_millis(50);

/// Shows the command, runs it with its output visible, and fails if it does.
pub(crate) fn shown(command: &mut Command) -> Result<()> {
    let line = line(command);
    println!("$ {line}");
    let status = command.status().with_context(|| format!("cannot start `{line}`"))?;
    if !status.success() {
        bail!("`{line}` ended with {status}");
    }
    Ok(())
}

/// Runs the command without a word; when it fails or takes longer than `limit`, the error holds what it printed.
pub(crate) fn quiet(command: &mut Command, limit: Duration) -> Result<()> {
    let line = line(command);
    // A file, not a pipe: nobody has to read along while we wait.
    let mut log = tempfile::tempfile().context("cannot make a temporary file")?;
    command.stdin(Stdio::null()).stdout(log.try_clone()?).stderr(log.try_clone()?);
    let mut child = command.spawn().with_context(|| format!("cannot start `{line}`"))?;
    let outcome = match wait(&mut child, limit)? {
        Some(status) if status.success() => return Ok(()),
        Some(status) => status.to_string(),
        None => format!("no answer within {} s", limit.as_secs()),
    };
    let mut printed = Vec::new();
    log.rewind()?;
    log.read_to_end(&mut printed)?;
    // What a program prints need not be UTF-8.
    bail!("`{line}`: {outcome}\n{}", String::from_utf8_lossy(&printed).trim_end());
}

/// What the command prints to standard output; an error if it cannot be started or fails.
pub(crate) fn output(command: &mut Command) -> Result<String> {
    let line = line(command);
    let output = command.stdin(Stdio::null()).output().with_context(|| format!("cannot start `{line}`"))?;
    if !output.status.success() {
        bail!("`{line}`: {}\n{}", output.status, String::from_utf8_lossy(&output.stderr).trim_end());
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// As [`output`], from a program that may not take longer than `limit`.
pub(crate) fn output_within(command: &mut Command, limit: Duration) -> Result<String> {
    let printed = tempfile::NamedTempFile::new().context("cannot make a temporary file")?;
    let line = line(command);
    command.stdin(Stdio::null()).stdout(printed.reopen()?).stderr(Stdio::null());
    let mut child = command.spawn().with_context(|| format!("cannot start `{line}`"))?;
    match wait(&mut child, limit)? {
        Some(status) if status.success() => Ok(std::fs::read_to_string(printed.path())?),
        Some(status) => bail!("`{line}`: {status}"),
        None => bail!("`{line}`: no answer within {} s", limit.as_secs()),
    }
}

/// An error and its causes, one below the other.
pub(crate) fn explain(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).collect::<Vec<_>>().join("\n  because: ")
}

/// Where in `PATH` a program is, if it is.
pub(crate) fn find(program: &str) -> Option<PathBuf> {
    find_in(&env::var_os("PATH")?, program)
}

/// Where in a list of folders a program is, if it is.
pub(crate) fn find_in(path: &OsStr, program: &str) -> Option<PathBuf> {
    env::split_paths(path).map(|folder| folder.join(program)).find(|path| is_program(path))
}

/// Waits for the end of a program, and ends it when it takes longer than `limit` (the answer is then `None`).
fn wait(child: &mut Child, limit: Duration) -> Result<Option<ExitStatus>> {
    let start = Instant::now();
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        if start.elapsed() >= limit {
            child.kill()?;
            child.wait()?;
            return Ok(None);
        }
        thread::sleep(POLL_EVERY);
    }
}

/// The command as a line for a shell: the variables that were set for it, then the program and its arguments.
fn line(command: &Command) -> String {
    let variables = command.get_envs().filter_map(|(name, value)| {
        let value = value?.to_string_lossy();
        Some(format!("{}={}", name.to_string_lossy(), shorten_path(name, &value)))
    });
    let own_cargo = env::var_os("CARGO");
    let program = match own_cargo {
        Some(cargo) if cargo == command.get_program() => "cargo".to_owned(),
        _ => quoted(&command.get_program().to_string_lossy()),
    };
    let arguments = command.get_args().map(|argument| quoted(&argument.to_string_lossy()));
    variables.chain([program]).chain(arguments).collect::<Vec<_>>().join(" ")
}

/// The value of a variable, a `PATH` with something in front written the short way.
fn shorten_path(name: &OsStr, value: &str) -> String {
    let inherited = env::var("PATH").unwrap_or_default();
    match value.strip_suffix(&inherited) {
        Some(front) if name == "PATH" && !inherited.is_empty() => format!("{front}$PATH"),
        _ => quoted(value),
    }
}

/// The word as a shell wants it.
pub(crate) fn quoted(word: &str) -> String {
    let plain = |character: char| character.is_ascii_alphanumeric() || "-_./:=,+@%".contains(character);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// A file that may be executed; elsewhere than on Unix any file will do.
fn is_program(path: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        path.metadata().is_ok_and(|about| about.is_file() && about.permissions().mode() & 0o111 != 0)
    }
    #[cfg(not(unix))]
    {
        path.is_file()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_can_be_pasted_into_a_shell() {
        let mut command = Command::new("program");
        command.env("FLAGS", "-D warnings").env_remove("GONE").args(["--to", "a'b", ""]);
        assert_eq!(line(&command), r"FLAGS='-D warnings' program --to 'a'\''b' ''");
    }

    #[test]
    fn a_longer_path_is_shown_by_its_front() {
        let mut command = Command::new("program");
        command.env("PATH", format!("/first:{}", env::var("PATH").unwrap()));
        assert_eq!(line(&command), "PATH=/first:$PATH program");
    }

    #[test]
    fn a_failure_shows_what_was_printed() {
        let mut command = Command::new("sh");
        command.args(["-c", "echo out; echo err >&2; exit 3"]);
        let error = quiet(&mut command, Duration::from_secs(10)).unwrap_err().to_string();
        assert!(error.contains("exit status: 3") && error.ends_with("out\nerr"), "{error}");
    }

    #[test]
    fn a_program_that_hangs_is_ended() {
        let start = Instant::now();
        let error = quiet(Command::new("sleep").arg("60"), Duration::from_millis(100)).unwrap_err();
        assert!(error.to_string().contains("no answer"), "{error}");
        assert!(start.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn causes_stand_below_the_error() {
        let error = anyhow::anyhow!("cause").context("advice\n  more advice");
        assert_eq!(explain(&error), "advice\n  more advice\n  because: cause");
    }

    #[test]
    fn only_what_exists_is_found() {
        assert!(find("sh").is_some());
        assert!(find("a-program-that-nobody-has").is_none());
    }
}
