//! Responses that may still come although their requests were given up.

use super::request::{Expected, Request};
use heapless::Vec;
use jointbus_protocol::time::{Duration, Instant};

/// Late responses of one kind.
#[derive(Debug, Clone, Copy)]
struct LateResponse {
    expected: Expected,
    /// How many may still come.
    responses: u8,
    /// When they are waited for no longer.
    until: Instant,
    unit: u8,
    /// The unit was probed, and leaves quarantine where its response comes longer than this before `until`.
    probed: Option<Duration>,
}

/// How many kinds of late response a bus can wait for; while it waits for that many, it starts no transaction.
pub(super) const LATE_MAX: usize = 4;

/// Late responses that a bus waits for, one for each attempt that timed out. Devices number nothing: until such a
/// response has come, or its window has passed, it could be taken for the response to a request like its own.
#[derive(Debug)]
pub(super) struct PendingLate(Vec<LateResponse, LATE_MAX>);

impl PendingLate {
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// Waits for the responses to attempts at a request that timed out, the last of which was sent at `sent`.
    pub(super) fn add(&mut self, request: &Request, expected: Expected, responses: u8, sent: Instant) {
        if responses > 0 {
            let until = sent.saturating_add(request.late_response_window);
            let before = |window| until.saturating_duration_since(sent.saturating_add(window));
            let probed = request.probe_window().map(before);
            // a transaction starts only while there is room, and adds at most once
            let _ = self.0.push(LateResponse { expected, responses, until, unit: request.unit, probed });
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Tells whether no further one could be remembered.
    pub(super) fn is_full(&self) -> bool {
        self.0.is_full()
    }

    /// Forgets the responses whose window has passed; tells whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        if before > 0 {
            self.keep_from(now);
        }
        self.0.len() < before
    }

    /// Keeps what may still come at `now`.
    fn keep_from(&mut self, now: Instant) {
        self.0.retain(|late| late.responses > 0 && now < late.until);
    }

    /// Tells whether a request has to wait for one.
    pub(super) fn holds(&self, request: &Request, now: Instant) -> bool {
        request.expected.is_some_and(|asked| {
            let could_answer = |late: &Expected| match request.is_split {
                true => late.could_answer_part(&asked),
                false => late.could_answer(&asked),
            };
            self.0.iter().any(|late| now < late.until && could_answer(&late.expected))
        })
    }

    /// Takes a late response; tells the unit where it was probed and would have been in time otherwise.
    pub(super) fn settle(&mut self, index: usize, now: Instant) -> Option<u8> {
        let late = self.0.get_mut(index)?;
        late.responses = late.responses.saturating_sub(1);
        let left = late.until.saturating_duration_since(now);
        let back = late.probed.filter(|before| left > *before).map(|_| late.unit);
        self.keep_from(Instant::default());
        back
    }

    /// When the first of them is forgotten.
    pub(super) fn deadline(&self) -> Instant {
        self.0.iter().fold(Instant::MAX, |first, late| first.min(late.until))
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Expected> {
        self.0.iter().map(|late| &late.expected)
    }
}
