//! What a person sees while something takes its time: a bar on a terminal, lines elsewhere.

use std::io::{IsTerminal, stdout};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Time between two lines about the same thing.
const REPEAT: Duration = Duration::from_secs(20);
/// Time between two pictures of a bar.
const REDRAW: Duration = Duration::from_millis(100);

/// Does something, and says what, how long it is expected to take, and how long it has.
pub(crate) fn during<T>(what: &str, expected: Duration, action: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = if stdout().is_terminal() {
        with_bar(what, expected, action)
    } else {
        println!("setup: {what} (about {})", shown(expected));
        with_lines(what, expected, action)
    };
    println!("setup: {what}: {}", shown(start.elapsed()));
    result
}

fn with_bar<T>(what: &str, expected: Duration, action: impl FnOnce() -> T) -> T {
    let style = ProgressStyle::with_template("setup: {msg} [{bar:20}] {elapsed} of about {len}s")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = ProgressBar::new(expected.as_secs().max(1)).with_style(style).with_message(what.to_owned());
    let result = meanwhile(REDRAW, |elapsed| bar.set_position(elapsed.as_secs()), action);
    bar.finish_and_clear();
    result
}

fn with_lines<T>(what: &str, expected: Duration, action: impl FnOnce() -> T) -> T {
    let say = |elapsed| println!("setup: {what}: {} of about {}", shown(elapsed), shown(expected));
    meanwhile(REPEAT, say, action)
}

/// Does something, and something else every so often until it is done.
fn meanwhile<T>(every: Duration, say: impl Fn(Duration) + Send, action: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let (done, waiting) = channel::<()>();
    thread::scope(|scope| {
        scope.spawn(move || {
            while let Err(RecvTimeoutError::Timeout) = waiting.recv_timeout(every) {
                say(start.elapsed());
            }
        });
        let result = action();
        drop(done);
        result
    })
}

/// A span of time for people: `8 s`, `2 min 5 s`.
pub(crate) fn shown(span: Duration) -> String {
    let seconds = (span.as_secs_f64()).round() as u64;
    match seconds {
        0 => format!("{:.1} s", span.as_secs_f64()),
        1..60 => format!("{seconds} s"),
        _ => format!("{} min {} s", seconds / 60, seconds % 60),
    }
}

/// A command's way through several builds and set-ups, each announced by its number.
pub(crate) struct Plan {
    start: Instant,
    /// What is expected of each step.
    steps: Vec<Duration>,
    done: usize,
}

impl Plan {
    /// So many steps, each with the time that it takes on two cores the first time.
    pub(crate) fn new(seconds: &[u64]) -> Self {
        Self {
            start: Instant::now(),
            steps: seconds.iter().copied().map(Duration::from_secs).collect(),
            done: 0,
        }
    }

    /// The next step begins.
    pub(crate) fn step(&mut self, what: &str) {
        let expected = self.steps.get(self.done).copied().unwrap_or_default();
        self.done += 1;
        println!("{}", headline(self.done, self.steps.len(), what, expected, self.start.elapsed()));
    }
}

fn headline(number: usize, of: usize, what: &str, expected: Duration, elapsed: Duration) -> String {
    format!("[{number}/{of}] {what} (the first time about {}; {} so far)", shown(expected), shown(elapsed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU32, Ordering};

    #[test]
    fn spans_are_written_for_people() {
        assert_eq!(shown(Duration::from_millis(250)), "0.2 s");
        assert_eq!(shown(Duration::from_secs(59)), "59 s");
        assert_eq!(shown(Duration::from_secs(125)), "2 min 5 s");
    }

    #[test]
    fn something_is_said_until_it_is_done() {
        let said = AtomicU32::new(0);
        let result = meanwhile(
            Duration::from_millis(1),
            |_| {
                said.fetch_add(1, Ordering::Relaxed);
            },
            || {
                let deadline = Instant::now() + Duration::from_secs(30);
                while said.load(Ordering::Relaxed) < 2 && Instant::now() < deadline {
                    thread::sleep(Duration::from_millis(1));
                }
                7
            },
        );
        assert!(result == 7 && said.load(Ordering::Relaxed) >= 2);
    }

    #[test]
    fn a_step_says_where_it_stands() {
        let line = headline(2, 5, "building the image", Duration::from_secs(60), Duration::from_secs(9));
        assert_eq!(line, "[2/5] building the image (the first time about 1 min 0 s; 9 s so far)");
    }
}
