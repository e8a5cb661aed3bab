//! Whether the session that the journal holds goes on.
//!
//! A robot that is switched on in the morning must not go on with yesterday's state, so a computer that has
//! claimed leads only when that is decided. Others that see it lead take its word.

use super::types::Alive;

/// What is known of the journal's session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Session {
    /// Nothing: no other computer was seen leading it. Whoever leads next has to decide.
    #[default]
    Unknown,
    /// It goes on.
    GoesOn,
    /// It ended with this record. Whoever leads replaces the state by an empty one, as the next record.
    Over(u64),
}

impl Session {
    /// The shell has decided about the journal up to record `seq`, unless others were quicker.
    pub(super) fn decided(&mut self, seq: u64, goes_on: bool) {
        if *self == Self::Unknown {
            *self = match goes_on {
                true => Self::GoesOn,
                false => Self::Over(seq),
            };
        }
    }

    /// etcd shows `alive`. `other_lives`: another computer has just written it.
    pub(super) fn see(&mut self, alive: &Alive, other_lives: bool) {
        let replaced = matches!(*self, Self::Over(last) if alive.seq > last);
        if replaced || other_lives && alive.settled {
            *self = Self::GoesOn;
        }
    }

    /// Whether the journal's session goes on once record `seq` is in it.
    pub(super) fn settled_by(self, seq: u64) -> bool {
        match self {
            Self::Unknown => false,
            Self::GoesOn => true,
            Self::Over(last) => seq > last,
        }
    }
}
