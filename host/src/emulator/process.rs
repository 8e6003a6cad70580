//! QEMU as a child process, and what it says on its standard error.

use anyhow::Result;
use std::io::Read;
use std::os::fd::RawFd;
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, mpsc};
use std::thread;
use std::time::Instant;

/// Starts QEMU from a thread that lives as long as it does: the operating system ends a child with the *thread* that
/// started it, and that is to be the end of this process, not of the test that called.
pub(super) fn start(mut command: Command, inherited: RawFd) -> Result<(Child, Messages)> {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    // SAFETY: between fork and exec only functions are called that are safe in a signal handler.
    unsafe { command.pre_exec(move || prepare_child(inherited)) };
    let messages = Messages::default();
    let kept = messages.clone();
    let (sender, receiver) = mpsc::channel();
    thread::Builder::new().name("qemu".into()).spawn(move || {
        let spawned = command.spawn().map(|mut child| (child.stderr.take(), child));
        let stderr = match spawned {
            Ok((stderr, child)) => {
                let _ = sender.send(Ok(child));
                stderr
            }
            Err(error) => {
                let _ = sender.send(Err(error));
                None
            }
        };
        kept.collect(stderr);
    })?;
    let child = receiver.recv()??;
    Ok((child, messages))
}

/// In the child: lets it have the monitor, and has it end with its parent.
fn prepare_child(inherited: RawFd) -> std::io::Result<()> {
    // SAFETY: the descriptor is open; clearing its flags touches no memory.
    if unsafe { libc::fcntl(inherited, libc::F_SETFD, 0) } < 0 {
        return Err(std::io::Error::last_os_error());
    }
    #[cfg(target_os = "linux")]
    // SAFETY: only this process's own setting changes.
    if unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) } < 0 {
        return Err(std::io::Error::last_os_error());
    }
    Ok(())
}

/// What QEMU says on its standard error.
#[derive(Debug, Clone, Default)]
pub(super) struct Messages(Arc<(Mutex<Collected>, Condvar)>);

#[derive(Debug, Default)]
pub(super) struct Collected {
    pub(super) bytes: Vec<u8>,
    pub(super) ended: bool,
}

impl Messages {
    /// Reads to the end, that is, until QEMU ends.
    fn collect(&self, stderr: Option<ChildStderr>) {
        let mut chunk = [0; 1024];
        if let Some(mut stderr) = stderr {
            while let Ok(length @ 1..) = stderr.read(&mut chunk) {
                lock(&self.0.0).bytes.extend_from_slice(&chunk[..length]);
            }
        }
        lock(&self.0.0).ended = true;
        self.0.1.notify_all();
    }

    pub(super) fn wait_for_end(&self, deadline: Instant) {
        let left = deadline.saturating_duration_since(Instant::now());
        drop(self.0.1.wait_timeout_while(lock(&self.0.0), left, |collected| !collected.ended));
    }

    pub(super) fn text(&self) -> String {
        String::from_utf8_lossy(&lock(&self.0.0).bytes).into_owned()
    }

    /// To be put behind an error.
    pub(super) fn quoted(&self) -> String {
        let text = self.text();
        if text.is_empty() { ", without a word".into() } else { format!(": {}", text.trim_end()) }
    }
}

/// A thread that panicked with the lock held has left nothing half done here.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}
