//! What this process has begun.

use std::time::Instant;

use super::Op;

/// This process leads, as far as it knows.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reign {
    pub(super) term: u64,
    /// When the last transaction that etcd has made was sent. None if that is not known.
    pub(super) sent: Option<Instant>,
    pub(super) beat: u64,
    /// The mirror held the whole journal when it began to lead.
    pub(super) caught_up: bool,
    /// The last beat did not take all records that there were.
    pub(super) full: bool,
    /// Another computer can lead since the last beat.
    pub(super) lapsed: bool,
}

/// A request whose effect is not known yet.
#[derive(Clone, Debug)]
pub(super) struct Flight {
    pub(super) number: u64,
    pub(super) op: Op,
    /// When it was sent for the first time.
    pub(super) first: Instant,
    /// And for the last time.
    pub(super) sent: Instant,
    /// It got no answer, and is not under way now.
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
