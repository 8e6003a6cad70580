//! A bus on a serial port: one transaction in flight, half duplex.

use super::counters::count;
use super::host::FRAME_MAX;
use super::transaction::{KINDS, OwedReplies, Queue, QueueFull, Request, Surroundings, Wanted};
use jointbus_protocol::checksum;
use jointbus_protocol::deframe::ReplySearch;
use jointbus_protocol::time::{Duration, Instant};

/// Bytes that the search for a reply looks back on.
const WINDOW: usize = FRAME_MAX + 64;

/// A port that has not told the end of a transmission so long after the time on the wire is broken.
const TRANSMIT_LIMIT: Duration = Duration::from_millis(1000);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Waits for a silent line, and for room for the reply.
    Ready,
    /// Handed to the port up to a byte; the last stop bit has not left yet.
    Sending { handed: usize, limit: Instant },
    /// Sent; the reply has time until then.
    Waiting { sent: Instant, deadline: Instant },
}

#[derive(Debug)]
struct Flight {
    request: Request,
    phase: Phase,
    retries_left: u8,
    /// Attempts that timed out.
    unanswered: u8,
    /// When the newest attempt had left.
    sent: Option<Instant>,
    /// What came back of this attempt, where the port hears itself.
    echo: Echo,
}

impl Flight {
    /// Counts an attempt whose echo was not what was sent. One that was answered in spite of it did no harm.
    fn count_collision(&self, around: &mut Surroundings<'_>) {
        if around.port.echo && (self.echo.collided || self.echo.heard < self.request.content.len()) {
            count(&mut around.counters.transmit_errors);
        }
    }
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
    /// Takes the echo of `sent` from the front of `bytes`.
    fn take<'b>(&mut self, sent: &[u8], bytes: &'b [u8]) -> &'b [u8] {
        let expected = sent.get(self.heard..).unwrap_or(&[]);
        let (echo, rest) = bytes.split_at_checked(expected.len()).unwrap_or((bytes, &[]));
        self.collided |= expected.iter().zip(echo).any(|(sent, heard)| sent != heard);
        self.heard = self.heard.saturating_add(echo.len());
        rest
    }
}

/// A serial bus.
#[derive(Debug)]
pub(super) struct SerialBus {
    queue: Queue,
    flight: Option<Flight>,
    owed: OwedReplies,
    search: ReplySearch<WINDOW, KINDS>,
    /// When the line was last heard or used.
    busy: Instant,
}

impl SerialBus {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            queue: Queue::new(),
            flight: None,
            owed: OwedReplies::new(),
            search: ReplySearch::default(),
            busy: now,
        }
    }

    /// Takes a request.
    pub(super) fn push(
        &mut self,
        request: Request,
        now: Instant,
        around: &mut Surroundings<'_>,
    ) -> Result<(), QueueFull> {
        let result = self.queue.push(request);
        self.take_next(now, around);
        result
    }

    /// Whether a request would have to wait for a reply that its unit owes.
    pub(super) fn holds(&self, request: &Request, now: Instant) -> bool {
        self.owed.holds(request, now)
    }

    /// What the port is to send.
    pub(super) fn pending(&self) -> &[u8] {
        match &self.flight {
            Some(Flight { request, phase: Phase::Sending { handed, .. }, .. }) => {
                request.content.get(*handed..).unwrap_or(&[])
            }
            _ => &[],
        }
    }

    /// The port took so many of the pending bytes.
    pub(super) fn consume(&mut self, taken: usize) {
        if let Some(Flight { request, phase: Phase::Sending { handed, .. }, .. }) = &mut self.flight {
            *handed = handed.saturating_add(taken).min(request.content.len());
        }
    }

    /// The last stop bit has left and the driver is off.
    pub(super) fn transmitted(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        let Some(flight) = &mut self.flight else { return };
        let Phase::Sending { handed, .. } = flight.phase else { return };
        if handed < flight.request.content.len() {
            return;
        }
        self.busy = now;
        count(&mut around.counters.sent);
        let Some(expected) = &flight.request.expected else {
            self.finish(around);
            self.take_next(now, around);
            return;
        };
        let [longest, other] = expected.lengths();
        let on_wire = around.port.characters(if expected.is_open() { FRAME_MAX } else { longest.max(other) });
        let deadline = now.after(flight.request.timeout).after(on_wire);
        flight.phase = Phase::Waiting { sent: now, deadline };
        flight.sent = Some(now);
        self.discard(around);
    }

    /// Takes bytes from the line, the last of which ended at `now`.
    pub(super) fn receive(&mut self, mut bytes: &[u8], now: Instant, around: &mut Surroundings<'_>) {
        self.busy = now;
        if let Some(flight) = &mut self.flight
            && around.port.echo
            && flight.phase != Phase::Ready
        {
            bytes = flight.echo.take(&flight.request.content, bytes);
        }
        if matches!(&self.flight, Some(Flight { phase: Phase::Sending { .. }, .. })) {
            return;
        }
        while !bytes.is_empty() {
            let waiting = self.flight.as_ref().and_then(|flight| match flight.phase {
                Phase::Waiting { sent, .. } => Some((&flight.request, sent)),
                Phase::Ready | Phase::Sending { .. } => None,
            });
            let in_flight = waiting.and_then(|(request, _)| request.expected.as_ref());
            let wanted = Wanted { in_flight, owed: &self.owed };
            let Some((kind, frame)) = self.search.feed(&wanted, &mut bytes) else { break };
            count(&mut around.counters.received);
            if let Some(index) = Wanted::owed_index(kind) {
                count(&mut around.counters.foreign_or_late);
                self.owed.settle(index);
            } else if let (Some((request, sent)), Some(content)) = (waiting, content(frame)) {
                around.answer(request, content, sent, now);
                self.finish(around);
            }
        }
        self.take_next(now, around);
    }

    /// Does what is due.
    pub(super) fn poll(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        // the reply in flight may be half received: it has another place among the kinds now
        if self.owed.expire(now) {
            self.search.start_over();
        }
        self.end_open_reply(now, around);
        match self.flight.as_ref().map(|flight| flight.phase) {
            Some(Phase::Waiting { deadline, .. }) if now >= deadline => self.time_out(now, around),
            Some(Phase::Sending { limit, .. }) if now >= limit => {
                count(&mut around.counters.transmit_errors);
                self.time_out(now, around);
            }
            _ => {}
        }
        self.queue.expire(now, around.counters, &mut around.host);
        self.expire_ready(now, around);
        self.take_next(now, around);
    }

    /// When [`SerialBus::poll`] has something to do next.
    pub(super) fn deadline(&self, around_pause: Duration, gap: Duration) -> Option<Instant> {
        let flight = self.flight.as_ref().map(|flight| match flight.phase {
            Phase::Ready => self.busy.after(gap).min(flight.request.expires),
            Phase::Sending { limit, .. } => limit,
            Phase::Waiting { deadline, .. } if self.is_open_reply() => {
                deadline.min(self.busy.after(around_pause))
            }
            Phase::Waiting { deadline, .. } => deadline,
        });
        [flight, self.queue.deadline(), self.owed.deadline()].into_iter().flatten().min()
    }

    /// Drops everything that waits or is in flight.
    pub(super) fn reset(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        if let Some(flight) = self.flight.take() {
            around.fail(&flight.request);
            around.release(&flight.request);
        }
        self.queue.clear(&mut around.host);
        self.owed = OwedReplies::new();
        self.search.clear();
        self.busy = now;
    }

    /// Puts the next request in flight, and onto the line once that was silent for the gap.
    fn take_next(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        if self.flight.is_none() {
            self.flight = around.next(&mut self.queue, &self.owed, now).map(|request| Flight {
                retries_left: request.retries,
                unanswered: 0,
                sent: None,
                echo: Echo::default(),
                request,
                phase: Phase::Ready,
            });
        }
        if let Some(flight) = &mut self.flight
            && flight.phase == Phase::Ready
            && now >= self.busy.after(around.port.gap())
        {
            let on_wire = around.port.characters(flight.request.content.len());
            let limit = now.after(on_wire).after(TRANSMIT_LIMIT);
            flight.phase = Phase::Sending { handed: 0, limit };
            if flight.unanswered > 0 {
                count(&mut around.counters.retries);
            }
            flight.echo = Echo::default();
        }
    }

    /// Drops a request that the line had no silence for in time.
    fn expire_ready(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        let Some(flight) = &self.flight else { return };
        if flight.phase == Phase::Ready && now >= flight.request.expires {
            if flight.unanswered == 0 {
                count(&mut around.counters.expired);
            }
            around.fail(&flight.request);
            self.finish(around);
        }
    }

    fn time_out(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        count(&mut around.counters.timeouts);
        self.discard(around);
        let Some(flight) = &mut self.flight else { return };
        flight.count_collision(around);
        flight.unanswered = flight.unanswered.saturating_add(1);
        if flight.retries_left > 0 && now < flight.request.expires {
            flight.retries_left = flight.retries_left.saturating_sub(1);
            flight.phase = Phase::Ready;
            return;
        }
        around.give_up(&flight.request, now);
        self.finish(around);
    }

    /// Ends the transaction; what its device left unanswered is owed.
    fn finish(&mut self, around: &mut Surroundings<'_>) {
        let Some(flight) = self.flight.take() else { return };
        around.release(&flight.request);
        if flight.request.expected.is_none() {
            flight.count_collision(around);
        }
        if let (Some(expected), Some(sent)) = (flight.request.expected, flight.sent) {
            self.owed.add(expected, flight.unanswered, sent.after(flight.request.hold_off));
        }
    }

    fn is_open_reply(&self) -> bool {
        let expected = self.flight.as_ref().and_then(|flight| flight.request.expected.as_ref());
        self.search.has_leftovers() && expected.is_some_and(|expected| expected.is_open())
    }

    /// Silence ends a reply of unknown length.
    fn end_open_reply(&mut self, now: Instant, around: &mut Surroundings<'_>) {
        if !self.is_open_reply() || now < self.busy.after(around.port.pause()) {
            return;
        }
        let Some(Flight { request, phase: Phase::Waiting { sent, .. }, .. }) = &self.flight else { return };
        let Some(expected) = &request.expected else { return };
        let found = self.search.at_silence(|frame| expected.accepts(frame));
        match found.and_then(content) {
            Some(content) => {
                count(&mut around.counters.received);
                around.answer(request, content, *sent, self.busy);
                self.finish(around);
            }
            // silence has ended whatever it was; kept, it would be due again at once and until the timeout
            None => self.discard(around),
        }
    }

    /// Forgets received bytes that belong to nothing.
    fn discard(&mut self, around: &mut Surroundings<'_>) {
        if self.search.has_leftovers() {
            count(&mut around.counters.foreign_or_late);
        }
        self.search.clear();
    }
}

/// A frame without address and CRC.
fn content(frame: &[u8]) -> Option<&[u8]> {
    let (body, _crc) = frame.split_last_chunk::<{ checksum::CRC_LENGTH }>()?;
    body.get(1..)
}
