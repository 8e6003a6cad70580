//! Responses that may still come although their requests were given up.

use super::request::{Expected, Request};
use heapless::Vec;
use jointbus_protocol::time::{Duration, Instant};

/// Replies of one kind that may still come.
#[derive(Debug, Clone, Copy)]
struct LateResponse {
    expected: Expected,
    replies: u8,
    until: Instant,
    /// The unit, which was probed and is out of quarantine if its reply comes longer than that before.
    unit: u8,
    probed: Option<Duration>,
}

/// How many kinds of late response a bus can wait for; while it waits for that many, it starts no transaction.
pub(super) const LATE_MAX: usize = 4;

/// Replies that devices owe because they let an attempt time out. They number nothing, so until such a reply has come
/// or the hold-off has passed, it could be taken for the answer to a request like the one that it belongs to.
#[derive(Debug)]
pub(super) struct PendingLate(Vec<LateResponse, LATE_MAX>);

impl PendingLate {
    pub(super) const fn new() -> Self {
        Self(Vec::new())
    }

    /// So many attempts at a request timed out, the last of which was `sent` then.
    pub(super) fn add(&mut self, request: &Request, expected: Expected, replies: u8, sent: Instant) {
        if replies > 0 {
            let until = sent.saturating_add(request.late_response_window);
            let before = |window| until.saturating_duration_since(sent.saturating_add(window));
            let probed = request.probe_window().map(before);
            // a transaction starts only while there is room, and adds at most once
            let _ = self.0.push(LateResponse { expected, replies, until, unit: request.unit, probed });
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Whether no further timeout could be remembered.
    pub(super) fn is_full(&self) -> bool {
        self.0.is_full()
    }

    /// Forgets replies that are not to be expected any more; tells whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        if before > 0 {
            self.keep_from(now);
        }
        self.0.len() < before
    }

    /// Keeps what has replies left, and is not forgotten by then.
    fn keep_from(&mut self, now: Instant) {
        self.0.retain(|owed| owed.replies > 0 && now < owed.until);
    }

    /// Whether a request would have to wait for one.
    pub(super) fn holds(&self, request: &Request, now: Instant) -> bool {
        request.expected.is_some_and(|asked| {
            let could_answer = |owed: &Expected| match request.is_split {
                true => owed.could_answer_part(&asked),
                false => owed.could_answer(&asked),
            };
            self.0.iter().any(|owed| now < owed.until && could_answer(&owed.expected))
        })
    }

    /// A reply came, late. A unit that was probed, and that would have been in time but for that.
    pub(super) fn settle(&mut self, index: usize, now: Instant) -> Option<u8> {
        let owed = self.0.get_mut(index)?;
        owed.replies = owed.replies.saturating_sub(1);
        let left = owed.until.saturating_duration_since(now);
        let back = owed.probed.filter(|before| left > *before).map(|_| owed.unit);
        self.keep_from(Instant::default());
        back
    }

    /// When the first of them is forgotten.
    pub(super) fn deadline(&self) -> Instant {
        self.0.iter().fold(Instant::MAX, |first, late| first.min(late.until))
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Expected> {
        self.0.iter().map(|owed| &owed.expected)
    }
}
