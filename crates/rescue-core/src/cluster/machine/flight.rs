//! The present term and the request under way.

use std::time::Instant;

use super::Op;

/// The term in which this process leads, as far as it knows.
#[derive(Clone, Copy, Debug)]
pub(super) struct Leadership {
    pub(super) term: u64,
    /// When the last successful transaction was sent. `None` if unknown.
    pub(super) sent: Option<Instant>,
    pub(super) beat: u64,
    /// Whether the mirror had the whole journal when the term began.
    pub(super) caught_up: bool,
    /// Whether the last heartbeat could not contain all recorded calls.
    pub(super) full: bool,
    /// Whether another computer may have led since the last heartbeat.
    pub(super) lapsed: bool,
}

/// A request whose effect is not known yet.
#[derive(Clone, Debug)]
pub(super) struct Flight {
    pub(super) number: u64,
    pub(super) op: Op,
    /// When the request was sent for the first time.
    pub(super) first: Instant,
    /// When the request was sent for the last time.
    pub(super) sent: Instant,
    /// Whether the request got no answer and is not under way now.
    pub(super) silent: bool,
}

impl Flight {
    pub(super) fn is_beat(&self, number: u64) -> bool {
        matches!(self.op, Op::Beat { beat, .. } if beat == number)
    }

    pub(super) fn is_claim(&self, number: u64) -> bool {
        matches!(self.op, Op::Claim { claim, .. } if claim == number)
    }
}
