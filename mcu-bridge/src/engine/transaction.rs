//! A request in flight.

use super::context::Context;
use super::counters::count;
use super::queue::BusQueue;
use super::request::{Expected, Origin, Request};
use super::slab::ContentIndex;
use jointbus_protocol::time::Instant;

/// A request in flight, and its attempts.
#[derive(Debug)]
pub(super) struct Transaction {
    pub(super) request: Request,
    /// Where its bytes are.
    pub(super) index: ContentIndex,
    /// Attempts that may still follow.
    retries_left: u8,
    /// Attempts that timed out.
    pub(super) unanswered: u8,
    /// When the newest attempt had left.
    pub(super) sent: Option<Instant>,
}

impl Transaction {
    pub(super) const fn new(request: Request, index: ContentIndex) -> Self {
        Self { retries_left: request.retries, unanswered: 0, sent: None, request, index }
    }

    /// Another part of the request begins, with as many retries.
    pub(super) const fn restart(&mut self) {
        self.retries_left = self.request.retries;
    }

    /// An attempt timed out; whether there is another one.
    pub(super) fn time_out(&mut self, now: Instant, cx: &mut Context<'_>) -> bool {
        count(&mut cx.counters.timeouts);
        self.unanswered = self.unanswered.saturating_add(1);
        if self.retries_left > 0 && now < self.request.expires {
            self.retries_left = self.retries_left.saturating_sub(1);
            return true;
        }
        cx.give_up(&self.request, now);
        false
    }

    /// Ends it; the responses to attempts that timed out may still come late.
    pub(super) fn end(self, expected: Option<Expected>, queue: &mut BusQueue, cx: &mut Context<'_>) {
        if self.request.origin == Origin::Host {
            cx.host.output.release();
        }
        queue.free(self.index);
        if let (Some(expected), Some(sent)) = (expected, self.sent) {
            queue.late.add(&self.request, expected, self.unanswered, sent);
        }
    }
}

/// The one place of a bus for what is in flight: an `Option` that is all zeros while it is empty, which one with a niche
/// is not. So the engine's memory lies in `.bss`.
#[derive(Debug)]
#[repr(u8)]
pub(super) enum Slot<T> {
    Free,
    Taken(T),
}

impl<T> Slot<T> {
    pub(super) const fn as_ref(&self) -> Option<&T> {
        match self {
            Self::Free => None,
            Self::Taken(flight) => Some(flight),
        }
    }

    pub(super) const fn as_mut(&mut self) -> Option<&mut T> {
        match self {
            Self::Free => None,
            Self::Taken(flight) => Some(flight),
        }
    }

    pub(super) const fn is_none(&self) -> bool {
        matches!(self, Self::Free)
    }

    pub(super) fn take(&mut self) -> Option<T> {
        match core::mem::replace(self, Self::Free) {
            Self::Free => None,
            Self::Taken(flight) => Some(flight),
        }
    }
}
