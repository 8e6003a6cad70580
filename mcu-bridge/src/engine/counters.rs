//! What is counted, port by port.

/// Counters of one port; all wrap around.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Frames received.
    pub received: u32,
    /// Frames sent; on CAN frames, not transfers.
    pub sent: u32,
    /// Checksum errors.
    pub checksum_errors: u32,
    /// Dropped bursts; one to an unknown unit counts as refused instead.
    pub dropped_bursts: u32,
    /// Attempts that no reply came to in time.
    pub timeouts: u32,
    /// Reads sent again.
    pub retries: u32,
    /// Frames that belong to no request, or came too late for theirs.
    pub foreign_or_late: u32,
    /// Bytes or frames lost because nobody fetched them in time, or because there was no room to keep them.
    pub overruns: u32,
    /// Requests whose time to live ended before they were sent.
    pub expired: u32,
    /// Requests refused: queue full, unknown unit, write protection.
    pub refused: u32,
    /// Times the controller went bus-off.
    pub bus_off: u32,
    /// Transmit errors and collisions.
    pub transmit_errors: u32,
}

impl Counters {
    /// Nothing has been counted.
    pub const ZERO: Self = Self {
        received: 0,
        sent: 0,
        checksum_errors: 0,
        dropped_bursts: 0,
        timeouts: 0,
        retries: 0,
        foreign_or_late: 0,
        overruns: 0,
        expired: 0,
        refused: 0,
        bus_off: 0,
        transmit_errors: 0,
    };

    /// The counters in the order of their registers.
    #[must_use]
    pub const fn in_order(&self) -> [u32; 12] {
        [
            self.received,
            self.sent,
            self.checksum_errors,
            self.dropped_bursts,
            self.timeouts,
            self.retries,
            self.foreign_or_late,
            self.overruns,
            self.expired,
            self.refused,
            self.bus_off,
            self.transmit_errors,
        ]
    }
}

/// One more.
pub(super) const fn count(counter: &mut u32) {
    *counter = counter.wrapping_add(1);
}
