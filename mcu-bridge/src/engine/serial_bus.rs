//! A bus on a serial port: one transaction in flight, half duplex.

use super::context::Context;
use super::counters::count;
use super::framing::{Outgoing, wire_byte, wire_length};
use super::host::FRAME_MAX;
use super::queue::{BusQueue, QueueFull};
use super::request::{Expected, Request};
use super::response_matcher::{Received, Receiver, Wanted};
use super::slab::Content;
use super::transaction::{Slot, Transaction};
use crate::board::PortConfig;
use heapless::{Deque, Vec};
use jointbus_protocol::time::{Duration, Instant};

/// A port that has not told the end of a transmission so long after the time on the wire is broken.
const TRANSMIT_LIMIT: Duration = Duration::from_millis(1000);

#[derive(Debug)]
enum Phase {
    /// Waits for a silent line, and for room for the reply.
    Ready,
    /// Handed to the port up to a byte; the last stop bit has not left yet.
    Sending { outgoing: Outgoing, limit: Instant },
    /// Sent; the reply has time until then.
    Waiting { sent: Instant, deadline: Instant },
}

#[derive(Debug)]
struct Flight {
    transaction: Transaction,
    phase: Phase,
    /// What came back of this attempt, where the port hears itself.
    echo: Echo,
}

/// The bytes that a port hears of what it sends.
#[derive(Debug, Clone, Copy, Default)]
struct Echo {
    /// How many came back.
    heard: usize,
    /// One of them was another: somebody else was sending.
    collided: bool,
}

impl Echo {
    /// Takes the echo of what was `sent` from the front of `bytes`.
    fn take(&mut self, sent: impl Fn(usize) -> Option<u8>, bytes: &mut &[u8]) {
        while let Some((heard, rest)) = bytes.split_first()
            && let Some(expected) = sent(self.heard)
        {
            *bytes = rest;
            self.heard = self.heard.saturating_add(1);
            self.collided |= expected != *heard;
        }
    }
}

/// Bytes that the port handed over before it told the end of what it was sending: their time decides whether they are
/// from before that or a response.
#[derive(Debug)]
struct Early {
    bytes: Deque<u8, FRAME_MAX>,
    /// When the last of them ended.
    end: Instant,
}

impl Early {
    const fn new() -> Self {
        Self { bytes: Deque::new(), end: Instant::from_micros(0) }
    }

    /// Keeps bytes, the last of which ended at `now`; tells whether there was room for all.
    fn push(&mut self, bytes: &[u8], now: Instant) -> bool {
        self.end = now;
        bytes.iter().all(|byte| self.bytes.push_back(*byte).is_ok())
    }

    /// Drops what cannot have come after `sent`: more bytes than the time since then has room for.
    fn keep_after(&mut self, sent: Instant, config: &PortConfig) {
        let since = self.end.saturating_duration_since(sent);
        let fits = (0..self.bytes.len()).take_while(|count| config.characters(*count) < since).count();
        let mut before = self.bytes.len().saturating_sub(fits);
        while before > 0 {
            self.bytes.pop_front();
            before = before.saturating_sub(1);
        }
    }

    /// Takes some of the bytes, the first ones; empty when none is left.
    fn take_some(&mut self) -> Vec<u8, 32> {
        let mut some = Vec::new();
        while !some.is_full()
            && let Some(byte) = self.bytes.pop_front()
        {
            let _ = some.push(byte);
        }
        some
    }
}

/// A serial bus.
#[derive(Debug)]
pub(super) struct SerialBus {
    queue: BusQueue,
    flight: Slot<Flight>,
    receiver: Receiver,
    early: Early,
    /// Whether requests go out as Modbus ASCII.
    is_ascii: bool,
    /// When the line was last heard or used.
    busy: Instant,
}

impl SerialBus {
    /// A bus that speaks RTU or NST, before its start, in zeros.
    pub(super) const fn new() -> Self {
        Self {
            queue: BusQueue::new(),
            flight: Slot::Free,
            receiver: Receiver::new(),
            early: Early::new(),
            is_ascii: false,
            busy: Instant::from_micros(0),
        }
    }

    pub(super) const fn start(&mut self, now: Instant) {
        self.busy = now;
    }

    /// Takes a request.
    pub(super) fn push(
        &mut self,
        request: &Request,
        write: impl FnOnce(&mut Content),
        now: Instant,
        cx: &mut Context<'_>,
    ) -> Result<(), QueueFull> {
        let result = self.queue.push(request, write);
        self.take_next(now, cx);
        result
    }

    /// When the request left whose response is waited for.
    pub(super) fn waiting_since(&self) -> Option<Instant> {
        match self.flight.as_ref()?.phase {
            Phase::Waiting { sent, .. } => Some(sent),
            _ => None,
        }
    }

    /// Tells whether a request has to wait for a late response.
    pub(super) fn holds(&self, request: &Request, now: Instant) -> bool {
        self.queue.late.holds(request, now)
    }

    /// What the port is to send.
    pub(super) fn pending(&self) -> &[u8] {
        match self.flight.as_ref() {
            Some(Flight { transaction, phase: Phase::Sending { outgoing, .. }, .. }) => {
                outgoing.pending(self.queue.content(transaction.index))
            }
            _ => &[],
        }
    }

    /// The port took so many of the pending bytes.
    pub(super) fn consume(&mut self, taken: usize) {
        if let Some(Flight { transaction, phase: Phase::Sending { outgoing, .. }, .. }) = self.flight.as_mut()
        {
            outgoing.consume(self.queue.content(transaction.index), taken);
        }
    }

    /// The last stop bit has left and the driver is off.
    pub(super) fn transmitted(&mut self, now: Instant, cx: &mut Context<'_>) {
        if !self.pending().is_empty() {
            return;
        }
        let Some(flight) = self.flight.as_mut() else { return };
        let Phase::Sending { .. } = flight.phase else { return };
        self.busy = self.busy.max(now);
        count(&mut cx.counters.sent);
        self.early.keep_after(now, cx.config);
        let request = &flight.transaction.request;
        let Some(expected) = &request.expected else {
            self.finish(cx);
            self.take_next(now, cx);
            return;
        };
        let [longest, other] = expected.lengths();
        let length = if expected.is_open() { FRAME_MAX } else { longest.max(other) };
        let on_wire = cx.config.characters(if self.is_ascii { length.saturating_mul(2) } else { length });
        let deadline = now.saturating_add(request.timeout).saturating_add(on_wire);
        flight.phase = Phase::Waiting { sent: now, deadline };
        flight.transaction.sent = Some(now);
        self.discard(cx);
        loop {
            let response = self.early.take_some();
            if response.is_empty() {
                break;
            }
            self.receive(&response, self.early.end, cx);
        }
    }

    /// Takes bytes from the line, the last of which ended at `now`.
    pub(super) fn receive(&mut self, mut bytes: &[u8], now: Instant, cx: &mut Context<'_>) {
        self.busy = self.busy.max(now);
        if let Some(flight) = self.flight.as_mut()
            && cx.config.echo
            && !matches!(flight.phase, Phase::Ready)
        {
            let content = self.queue.content(flight.transaction.index);
            flight.echo.take(|index| wire_byte(self.is_ascii, content, index), &mut bytes);
        }
        match self.flight.as_ref().map(|flight| &flight.phase) {
            Some(Phase::Sending { .. }) => {
                // while bytes are still to be handed to the port, none can be a response
                if !bytes.is_empty() && self.pending().is_empty() && !self.early.push(bytes, now) {
                    count(&mut cx.counters.overruns);
                }
                return;
            }
            // from before the end of the request, and handed over after it
            Some(Phase::Waiting { sent, .. }) if now < *sent => {
                count(&mut cx.counters.foreign_or_late);
                return;
            }
            _ => {}
        }
        loop {
            let waiting = self.flight.as_ref().and_then(|flight| match flight.phase {
                Phase::Waiting { sent, .. } => Some((&flight.transaction.request, sent)),
                Phase::Ready | Phase::Sending { .. } => None,
            });
            let in_flight = waiting.and_then(|(request, _)| request.expected.as_ref());
            let wanted = Wanted { in_flight, late: &self.queue.late };
            let Some(heard) = self.receiver.feed(wanted, &mut bytes) else { break };
            if !matches!(heard, Received::Broken) {
                count(&mut cx.counters.received);
            }
            match (heard, waiting) {
                (Received::Reply(content), Some((request, sent))) => {
                    cx.answer(request, content, sent, now);
                    let remote = in_flight.map_or(0, Expected::remote);
                    if self.flight.as_ref().is_some_and(|flight| flight.transaction.unanswered > 0)
                        || !self.queue.late.is_empty()
                    {
                        self.queue.take(remote, content, now);
                    }
                    self.finish(cx);
                }
                (Received::LateResponse(index, content), _) => {
                    count(&mut cx.counters.foreign_or_late);
                    // a copy follows at once
                    let mut length = content.len().saturating_add(4);
                    if self.is_ascii {
                        length = length.saturating_mul(2);
                    }
                    let copy = cx.config.characters(length).saturating_add(cx.config.pause());
                    self.queue.settle(index, content, copy, now, cx);
                }
                _ => count(&mut cx.counters.foreign_or_late),
            }
        }
        self.take_next(now, cx);
    }

    /// Does what is due.
    pub(super) fn poll(&mut self, now: Instant, cx: &mut Context<'_>) {
        // the reply in flight may be half received: it has another place among the kinds now
        if self.queue.late.expire(now) {
            self.receiver.rescan();
        }
        self.end_open_reply(now, cx);
        match self.flight.as_ref().map(|flight| &flight.phase) {
            Some(Phase::Waiting { deadline, .. }) if now >= *deadline => self.time_out(now, cx),
            Some(Phase::Sending { limit, .. }) if now >= *limit => {
                count(&mut cx.counters.transmit_errors);
                self.time_out(now, cx);
            }
            _ => {}
        }
        self.queue.expire(now, cx);
        self.expire_ready(now, cx);
        self.take_next(now, cx);
    }

    /// When [`SerialBus::poll`] has something to do next.
    pub(super) fn deadline(&self, port: &PortConfig) -> Instant {
        let flight = self.flight.as_ref().map_or(Instant::MAX, |flight| match flight.phase {
            Phase::Ready => self.busy.saturating_add(port.gap()).min(flight.transaction.request.expires),
            Phase::Sending { limit, .. } => limit,
            Phase::Waiting { deadline, .. } if self.is_open_reply() => {
                deadline.min(self.busy.saturating_add(port.pause()))
            }
            Phase::Waiting { deadline, .. } => deadline,
        });
        flight.min(self.queue.deadline())
    }

    /// Drops everything that waits or is in flight, and speaks as the routes say now.
    pub(super) fn reset(&mut self, now: Instant, cx: &mut Context<'_>) {
        if let Some(flight) = self.flight.take() {
            cx.fail(&flight.transaction.request);
            flight.transaction.end(None, &mut self.queue, cx);
        }
        self.queue.clear(cx);
        self.is_ascii = cx.routes.topology.speaks_ascii(cx.port);
        self.receiver.reset(self.is_ascii);
        self.busy = now;
    }

    /// Puts the next request in flight, and onto the line once that was silent for the gap.
    fn take_next(&mut self, now: Instant, cx: &mut Context<'_>) {
        if self.flight.is_none()
            && let Some((request, index)) = self.queue.next(now, cx)
        {
            let transaction = Transaction::new(request, index);
            self.flight = Slot::Taken(Flight { transaction, phase: Phase::Ready, echo: Echo::default() });
        }
        if let Some(flight) = self.flight.as_mut()
            && matches!(flight.phase, Phase::Ready)
            && now >= self.busy.saturating_add(cx.config.gap())
        {
            let content = self.queue.content(flight.transaction.index);
            let on_wire = cx.config.characters(wire_length(self.is_ascii, content));
            let limit = now.saturating_add(on_wire).saturating_add(TRANSMIT_LIMIT);
            flight.phase = Phase::Sending { outgoing: Outgoing::start(self.is_ascii, content), limit };
            if flight.transaction.unanswered > 0 {
                count(&mut cx.counters.retries);
            }
            flight.echo = Echo::default();
        }
    }

    /// Drops a request that the line had no silence for in time.
    fn expire_ready(&mut self, now: Instant, cx: &mut Context<'_>) {
        let Some(Flight { transaction, phase: Phase::Ready, .. }) = self.flight.as_ref() else { return };
        if now >= transaction.request.expires {
            if transaction.unanswered == 0 {
                count(&mut cx.counters.expired);
            }
            cx.fail(&transaction.request);
            self.finish(cx);
        }
    }

    fn time_out(&mut self, now: Instant, cx: &mut Context<'_>) {
        self.discard(cx);
        self.count_collision(cx);
        let Some(flight) = self.flight.as_mut() else { return };
        if flight.transaction.time_out(now, cx) {
            flight.phase = Phase::Ready;
        } else {
            self.finish(cx);
        }
    }

    /// Counts an attempt whose echo was not what was sent. One that was answered in spite of it did no harm.
    fn count_collision(&self, cx: &mut Context<'_>) {
        let Some(Flight { transaction, echo, .. }) = self.flight.as_ref() else { return };
        let length = wire_length(self.is_ascii, self.queue.content(transaction.index));
        if cx.config.echo && (echo.collided || echo.heard < length) {
            count(&mut cx.counters.transmit_errors);
        }
    }

    fn finish(&mut self, cx: &mut Context<'_>) {
        if matches!(self.flight.as_ref(), Some(flight) if flight.transaction.request.expected.is_none()) {
            self.count_collision(cx);
        }
        if let Some(flight) = self.flight.take() {
            let expected = flight.transaction.request.expected;
            flight.transaction.end(expected, &mut self.queue, cx);
        }
    }

    fn expected(&self) -> Option<&Expected> {
        self.flight.as_ref()?.transaction.request.expected.as_ref()
    }

    fn is_open_reply(&self) -> bool {
        self.receiver.is_open() && self.expected().is_some_and(|expected| expected.is_open())
    }

    /// Silence ends a reply of unknown length.
    fn end_open_reply(&mut self, now: Instant, cx: &mut Context<'_>) {
        if !self.is_open_reply() || now < self.busy.saturating_add(cx.config.pause()) {
            return;
        }
        let Some(Flight { transaction, phase: Phase::Waiting { sent, .. }, .. }) = self.flight.as_ref()
        else {
            return;
        };
        let Some(expected) = &transaction.request.expected else { return };
        match self.receiver.end_of_frame(expected) {
            Some(content) => {
                count(&mut cx.counters.received);
                cx.answer(&transaction.request, content, *sent, self.busy);
                self.finish(cx);
            }
            // silence has ended it; if it stayed, it would be due again at once and until the timeout
            None => self.discard(cx),
        }
    }

    /// Forgets received bytes that belong to nothing.
    fn discard(&mut self, cx: &mut Context<'_>) {
        if self.receiver.discard() {
            count(&mut cx.counters.foreign_or_late);
        }
    }
}
