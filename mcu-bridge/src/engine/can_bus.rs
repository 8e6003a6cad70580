//! The CAN bus: NST transfers, one transaction in flight, split where a transfer is too short for it.

use super::actions::Action;
use super::context::Context;
use super::counters::count;
use super::queue::{BusQueue, QueueFull};
use super::request::{Expected, Request};
use super::slab::Content;
use super::transaction::{Slot, Transaction};
use heapless::{Deque, Vec};
use jointbus_protocol::can::{Frame, Id};
use jointbus_protocol::nst::can::{self, Outcome, PushResult, Reassembler, ReassemblyError};
use jointbus_protocol::nst::{self, serial::ExpectedResponse};
use jointbus_protocol::time::{Duration, Instant};
use jointbus_protocol::wire::Writer;

/// Longest pause between the frames of a transfer.
const FRAME_PAUSE: Duration = Duration::from_millis(10);

/// Sources whose transfers are joined at once: the device that was asked, and one that is late.
const CONTEXTS: usize = 2;

/// Frames of a whole response to a transfer.
const EARLY: usize = can::TRANSFER_MAX.div_ceil(8);

/// Time that the controller stays off the bus the first time, and at most; each time in a row takes twice as long.
const SHORTEST: Duration = Duration::from_millis(10);
const LONGEST: Duration = Duration::from_millis(1000);

/// Where the joined reply to a read starts among the bytes kept of it.
const REPLY_START: usize = nst::COMMAND_LENGTH - nst::RESPONSE_HEADER;

/// When the controller returns after it went bus-off.
#[derive(Debug)]
struct BackOff {
    /// How long the next time will take.
    next: Duration,
    /// When the controller is to be restarted.
    restart: Option<Instant>,
}

/// Frames of a transfer under way to the controller, or its reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Waits for the controller to be free of former frames, and for room for the reply.
    Ready,
    /// So many frames were handed to the controller; all have to be acknowledged by then.
    Sending { handed: usize, limit: Instant },
    /// Of so many frames that were handed over some were not acknowledged in time: the mailboxes are being aborted.
    Aborting { handed: usize },
    /// Sent; the reply has time until then.
    Waiting { sent: Instant, deadline: Instant },
}

#[derive(Debug)]
struct Flight {
    /// Its attempts are those at the present part.
    transaction: Transaction,
    phase: Phase,
    /// Bytes of the request that former parts moved.
    moved: u8,
    part: Part,
}

impl Flight {
    const fn is_aborting(&self) -> bool {
        matches!(self.phase, Phase::Aborting { .. })
    }
}

/// One transfer of a request.
#[derive(Debug, Clone, Copy)]
struct Part {
    expected: ExpectedResponse,
    length: u8,
}

/// The CAN bus.
#[derive(Debug)]
pub(super) struct CanBus {
    queue: BusQueue,
    flight: Slot<Flight>,
    /// The transfer under way.
    body: Vec<u8, { can::TRANSFER_MAX }>,
    reassembler: Reassembler<CONTEXTS>,
    node: u8,
    /// Frames that the controller has and that nobody acknowledged so far.
    outstanding: u8,
    /// Frames of the device in flight that came, as far as is known, before the last frame of its request was
    /// acknowledged: their time decides whether they are from before that or a response.
    early: Deque<(Frame, Instant), EARLY>,
    /// Read replies with function code 0x10, as the manual prints them (4.3.2.10).
    legacy_codes: u32,
    back_off: BackOff,
}

impl CanBus {
    /// The bus before its start, in zeros.
    pub(super) const fn new() -> Self {
        Self {
            queue: BusQueue::new(),
            flight: Slot::Free,
            body: Vec::new(),
            reassembler: Reassembler::new(0, Duration::ZERO),
            node: 0,
            outstanding: 0,
            early: Deque::new(),
            legacy_codes: 0,
            back_off: BackOff { next: Duration::ZERO, restart: None },
        }
    }

    pub(super) fn start(&mut self, node: u8) {
        self.node = node;
        self.reassembler = Reassembler::new(node, FRAME_PAUSE);
        self.back_off.next = SHORTEST;
    }

    /// The controller went off the bus.
    pub(super) fn went_off(&mut self, now: Instant, cx: &mut Context<'_>) {
        count(&mut cx.counters.bus_off);
        self.back_off.restart = Some(now.saturating_add(self.back_off.next));
        self.back_off.next = self.back_off.next.saturating_mul(2).min(LONGEST);
    }

    pub(super) const fn legacy_codes(&self) -> u32 {
        self.legacy_codes
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

    /// The next frame for the controller; it counts as handed over.
    pub(super) fn next_frame(&mut self) -> Option<Frame> {
        let flight = self.flight.as_mut()?;
        let Phase::Sending { handed, limit } = flight.phase else { return None };
        let destination = flight.part.expected.address();
        let frame = can::segment(self.node, destination, &self.body).ok()?.nth(handed)?;
        flight.phase = Phase::Sending { handed: handed.saturating_add(1), limit };
        self.outstanding = self.outstanding.saturating_add(1);
        Some(frame)
    }

    /// A frame was acknowledged.
    pub(super) fn frame_sent(&mut self, now: Instant, cx: &mut Context<'_>) {
        count(&mut cx.counters.sent);
        self.back_off.next = SHORTEST;
        self.outstanding = self.outstanding.saturating_sub(1);
        self.check_sent(now, cx);
    }

    /// The controller has no frame any more.
    pub(super) fn aborted(&mut self, now: Instant, cx: &mut Context<'_>) {
        self.outstanding = 0;
        self.take_early(Instant::MAX, now, cx);
        if self.flight.as_ref().is_some_and(Flight::is_aborting) {
            self.not_sent(cx);
        }
        self.take_next(now, cx);
    }

    /// Takes a frame that ended at `now`.
    pub(super) fn receive(&mut self, frame: &Frame, now: Instant, cx: &mut Context<'_>) {
        count(&mut cx.counters.received);
        if let Some(flight) = self.flight.as_ref()
            && source(frame) == Some(flight.part.expected.address())
        {
            match flight.phase {
                Phase::Sending { handed, .. }
                    if handed >= self.body.len().div_ceil(8)
                        && self.early.push_back((*frame, now)).is_ok() =>
                {
                    return;
                }
                // from before the end of the request, and handed over after it
                Phase::Waiting { sent, .. } if now < sent => {
                    count(&mut cx.counters.foreign_or_late);
                    return;
                }
                _ => {}
            }
        }
        self.reassemble(frame, now, cx);
    }

    /// Joins a frame to its transfer.
    fn reassemble(&mut self, frame: &Frame, now: Instant, cx: &mut Context<'_>) {
        let PushResult { outcome, error } = self.reassembler.push(frame, now);
        match error {
            None => {}
            Some(ReassemblyError::NotNst | ReassemblyError::OtherDestination) => {
                count(&mut cx.counters.foreign_or_late);
            }
            Some(ReassemblyError::NoContext) => count(&mut cx.counters.overruns),
            Some(_) => count(&mut cx.counters.dropped_bursts),
        }
        let Some(Outcome::Complete { source, destination, body }) = outcome else { return };
        let Some((flight, expected, quirk, sent)) = self.flight.as_mut().and_then(|flight| {
            let expected = flight.part.expected;
            let quirk = expected.accepts_legacy_code(body);
            let fits = source == expected.address()
                && destination == self.node
                && (quirk || expected.accepts_body(body));
            // a device answers only what it has received whole: what comes before is a second copy of the last reply
            let Phase::Waiting { sent, .. } = flight.phase else { return None };
            fits.then_some((flight, expected, quirk, sent))
        }) else {
            let late = self.queue.late.iter().position(|late| match late {
                Expected::Nst(late) => {
                    source == late.address() && (late.accepts_body(body) || late.accepts_legacy_code(body))
                }
                Expected::Modbus(_) => false,
            });
            count(&mut cx.counters.foreign_or_late);
            if let Some(index) = late {
                self.queue.settle(index, body, FRAME_PAUSE, now, cx);
            }
            return;
        };
        if quirk {
            count(&mut self.legacy_codes);
        }
        let data = body.get(nst::RESPONSE_HEADER..).unwrap_or(&[]);
        if let Some(content) = self.queue.content_mut(flight.transaction.index) {
            let _ = content.extend_from_slice(data);
        }
        flight.moved = flight.moved.saturating_add(flight.part.length);
        let transaction = &mut flight.transaction;
        if transaction.unanswered > 0 || !self.queue.late.is_empty() {
            self.queue.take(source, body, now);
        }
        let late = core::mem::take(&mut transaction.unanswered);
        self.queue.late.add(&transaction.request, Expected::Nst(expected), late, sent);
        let content = self.queue.content(transaction.index);
        match following_part(content, &transaction.request, flight.moved, &mut self.body) {
            Some(part) => {
                flight.part = part;
                transaction.restart();
                flight.phase = Phase::Ready;
            }
            None => {
                let function = transaction.request.function;
                if transaction.request.is_read() {
                    // in front of the data stands the request's length, in front of that its register
                    if let Some(content) = self.queue.content_mut(transaction.index)
                        && let Some([code, ..]) = content.get_mut(REPLY_START..)
                    {
                        *code = function;
                    }
                    let reply = self.queue.content(transaction.index).get(REPLY_START..).unwrap_or(&[]);
                    cx.answer(&transaction.request, reply, sent, now);
                } else {
                    cx.answer(&transaction.request, &[function, flight.moved], sent, now);
                }
                self.finish(cx);
            }
        }
        self.take_next(now, cx);
    }

    /// Does what is due.
    pub(super) fn poll(&mut self, now: Instant, cx: &mut Context<'_>) {
        self.queue.late.expire(now);
        if self.back_off.restart.take_if(|restart| now >= *restart).is_some() {
            cx.actions.push(Action::RestartCan(cx.port));
        }
        if let Some(flight) = self.flight.as_mut() {
            match flight.phase {
                Phase::Sending { handed, limit } if now >= limit => {
                    flight.phase = Phase::Aborting { handed };
                    if self.outstanding == 0 {
                        self.not_sent(cx);
                    } else {
                        cx.actions.push(Action::AbortCan(cx.port));
                    }
                }
                Phase::Waiting { deadline, .. } if now >= deadline => self.time_out(now, cx),
                Phase::Ready if now >= flight.transaction.request.expires => self.not_sent(cx),
                _ => {}
            }
        }
        self.queue.expire(now, cx);
        self.take_next(now, cx);
    }

    /// When [`CanBus::poll`] has something to do next.
    pub(super) fn deadline(&self) -> Instant {
        let flight = self.flight.as_ref().map_or(Instant::MAX, |flight| match flight.phase {
            Phase::Ready => flight.transaction.request.expires,
            Phase::Sending { limit, .. } => limit,
            Phase::Waiting { deadline, .. } => deadline,
            Phase::Aborting { .. } => Instant::MAX,
        });
        flight.min(self.queue.deadline()).min(self.back_off.restart.unwrap_or(Instant::MAX))
    }

    /// Drops everything that waits or is in flight; frames that the controller has are aborted.
    pub(super) fn reset(&mut self, cx: &mut Context<'_>) {
        if self.outstanding > 0 {
            cx.actions.push(Action::AbortCan(cx.port));
        }
        if let Some(flight) = self.flight.take() {
            cx.fail(&flight.transaction.request);
            flight.transaction.end(None, &mut self.queue, cx);
        }
        self.queue.clear(cx);
        self.early.clear();
        self.node = cx.config.node;
        self.reassembler.set_node(self.node);
    }

    fn take_next(&mut self, now: Instant, cx: &mut Context<'_>) {
        if self.flight.is_none()
            && let Some((request, index)) = self.queue.next(now, cx)
        {
            let transaction = Transaction::new(request, index);
            let content = self.queue.content(transaction.index);
            match part(content, &transaction.request, 0, &mut self.body) {
                Some(part) => {
                    self.flight = Slot::Taken(Flight { transaction, phase: Phase::Ready, moved: 0, part });
                }
                // what was decoded always has a first part
                None => transaction.end(None, &mut self.queue, cx),
            }
        }
        let Some(flight) = self.flight.as_mut() else { return };
        if flight.phase == Phase::Ready && self.outstanding == 0 && !self.queue.late.is_full() {
            // of a split transfer the first part has to be sent within the time to live
            let limit = match flight.moved {
                0 => flight.transaction.request.expires,
                _ => now.saturating_add(flight.transaction.request.timeout),
            };
            flight.phase = Phase::Sending { handed: 0, limit };
            if flight.transaction.unanswered > 0 {
                count(&mut cx.counters.retries);
            }
        }
    }

    fn check_sent(&mut self, now: Instant, cx: &mut Context<'_>) {
        let Some(flight) = self.flight.as_mut() else { return };
        let (Phase::Sending { handed, .. } | Phase::Aborting { handed }) = flight.phase else { return };
        if self.outstanding > 0 {
            return;
        }
        if handed < self.body.len().div_ceil(8) {
            // the last frame on the wire was acknowledged, the others were never handed over
            if flight.is_aborting() {
                self.not_sent(cx);
                self.take_next(now, cx);
            }
            return;
        }
        if flight.transaction.request.expected.is_none() {
            flight.moved = flight.moved.saturating_add(flight.part.length);
            let content = self.queue.content(flight.transaction.index);
            match following_part(content, &flight.transaction.request, flight.moved, &mut self.body) {
                Some(part) => {
                    flight.part = part;
                    flight.phase = Phase::Ready;
                }
                None => self.finish(cx),
            }
            self.take_next(now, cx);
            return;
        }
        self.take_early(now, now, cx);
        let Some(flight) = self.flight.as_mut() else { return };
        // what its device had begun before is a second copy of a former reply
        self.reassembler.forget(flight.part.expected.address());
        let on_wire = cx.config.can_frames(flight.part.expected.body_length().div_ceil(8));
        let deadline = now.saturating_add(flight.transaction.request.timeout).saturating_add(on_wire);
        flight.phase = Phase::Waiting { sent: now, deadline };
        flight.transaction.sent = Some(now);
        self.take_early(Instant::MAX, Instant::MAX, cx);
    }

    /// Takes the frames that were handed over early and ended by `end`: a response ends later than its request.
    fn take_early(&mut self, end: Instant, now: Instant, cx: &mut Context<'_>) {
        while self.early.front().is_some_and(|(_, at)| *at <= end)
            && let Some((frame, at)) = self.early.pop_front()
        {
            self.reassemble(&frame, at.min(now), cx);
        }
    }

    /// The transfer was not sent in time; of the first part nothing has been carried out.
    fn not_sent(&mut self, cx: &mut Context<'_>) {
        let Some(flight) = self.flight.as_ref() else { return };
        match (flight.moved, flight.transaction.unanswered, flight.phase) {
            (0, 0, _) => count(&mut cx.counters.expired),
            // the attempt before has been counted, and this one was none
            (_, 1.., Phase::Ready) => {}
            _ => count(&mut cx.counters.timeouts),
        }
        cx.fail(&flight.transaction.request);
        self.finish(cx);
    }

    fn time_out(&mut self, now: Instant, cx: &mut Context<'_>) {
        let Some(flight) = self.flight.as_mut() else { return };
        if flight.transaction.time_out(now, cx) {
            flight.phase = Phase::Ready;
        } else {
            self.finish(cx);
        }
    }

    fn finish(&mut self, cx: &mut Context<'_>) {
        if let Some(flight) = self.flight.take() {
            let expected = Some(Expected::Nst(flight.part.expected));
            flight.transaction.end(expected, &mut self.queue, cx);
        }
    }
}

/// The node that sent a frame of NST.
fn source(frame: &Frame) -> Option<u8> {
    match frame.id() {
        Id::Extended(raw) => can::Identifier::from_raw(raw).map(|identifier| identifier.source),
        Id::Standard(_) => None,
    }
}

/// The whole request; behind the bytes of a read come those that were read so far.
fn asked<'c>(content: &'c [u8], request: &Request) -> Option<nst::Request<'c>> {
    let length = if request.is_read() { nst::COMMAND_LENGTH } else { content.len() };
    nst::Request::decode(content.get(..length)?).ok()
}

/// The transfer that follows those that moved so many bytes, put into `body`; `None` when all has been moved.
fn following_part(
    content: &[u8],
    request: &Request,
    moved: u8,
    body: &mut Vec<u8, { can::TRANSFER_MAX }>,
) -> Option<Part> {
    let whole = asked(content, request)?;
    if moved >= whole.length() { None } else { part(content, request, moved, body) }
}

/// The transfer that starts behind so many bytes of a request, put into `body`.
fn part(
    content: &[u8],
    request: &Request,
    moved: u8,
    body: &mut Vec<u8, { can::TRANSFER_MAX }>,
) -> Option<Part> {
    let part = can::next_fragment(&asked(content, request)?, moved)?;
    let remote = request.expected.map_or(can::BROADCAST, |expected| expected.remote());
    body.resize(can::TRANSFER_MAX, 0).ok()?;
    let mut writer = Writer::new(body);
    part.encode(&mut writer).ok()?;
    let length = writer.finish().len();
    body.truncate(length);
    Some(Part { expected: ExpectedResponse::new(remote, &part), length: part.length() })
}
