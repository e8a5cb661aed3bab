//! Decides whether the journal's session continues.
//!
//! A robot that is switched on in the morning must not continue with yesterday's state. So a computer whose claim has
//! succeeded leads only once that is decided. The others accept its decision.

use super::types::Alive;

/// What is known about the journal's session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum JournalSession {
    /// It is unknown whether the session continues. The next leader has to decide.
    #[default]
    Unknown,
    /// The session continues.
    GoesOn,
    /// The session ended with this record. The leader replaces the state by an empty one, as the next record.
    Over(u64),
}

impl JournalSession {
    /// Applies the decision about the journal up to record `seq`, unless another computer was faster.
    pub(super) fn decided(&mut self, seq: u64, goes_on: bool) {
        if *self == Self::Unknown {
            *self = match goes_on {
                true => Self::GoesOn,
                false => Self::Over(seq),
            };
        }
    }

    /// Handles `alive` as etcd shows it. `other_lives` says whether another computer has just written it.
    pub(super) fn see(&mut self, alive: &Alive, other_lives: bool) {
        let replaced = matches!(*self, Self::Over(last) if alive.seq > last);
        if replaced || other_lives && alive.settled {
            *self = Self::GoesOn;
        }
    }

    /// Whether the session is decided once record `seq` is in the journal.
    pub(super) fn settled_by(self, seq: u64) -> bool {
        match self {
            Self::Unknown => false,
            Self::GoesOn => true,
            Self::Over(last) => seq > last,
        }
    }
}
