//! One value that says who has the master and where calls go. Pure.

use crate::cluster::mutant::Mutant;

/// The calls that a leader answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AnsweredCalls {
    All,
    /// The mirror answers reads. Writes wait for the next leader.
    Reads,
    /// No call is answered: partition writes are not merged yet, so their callers would not see them.
    None,
}

/// Who has the master, and where this computer's calls go. Only [`Member`](crate::cluster::member::Member) sets it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// This computer leads in `term`, and has the master.
    Leads { term: u64, answers: AnsweredCalls },
    /// This computer is cut off. Its mirror answers its own nodes, and other computers' calls are refused.
    Alone,
    /// The computer at `uri` leads in `term`. All calls are forwarded to it.
    Follows { uri: String, term: u64 },
    /// No computer leads. Writes wait. If `known`, the mirror has the robot's state and answers reads.
    NoLeader { known: bool },
}

impl Standing {
    /// Whether calls are recorded on this computer.
    pub fn records(&self) -> bool {
        matches!(self, Self::Leads { .. } | Self::Alone)
    }

    /// Whether this computer answers its own nodes' calls.
    pub fn answers(&self) -> bool {
        matches!(
            self,
            Self::Leads {
                answers: AnsweredCalls::All,
                ..
            } | Self::Alone
        )
    }

    /// Whether this computer answers calls that other computers forward to the leader of `term`.
    pub fn answers_others(&self, term: u64) -> bool {
        let answers = AnsweredCalls::All;
        *self == Self::Leads { term, answers }
    }
}

/// A position in the journal of all computers. A position in a later term is further: that term's leader has everything
/// committed before, and nothing more of earlier terms can be added.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct JournalPosition {
    /// How often etcd has lost its data since this process started.
    pub epoch: u64,
    /// The leader's term.
    pub term: u64,
    /// The number of a record in the journal.
    pub seq: u64,
    /// After etcd has lost its data and before a new journal has been read: the leader's term and the number of the record
    /// up to which the mirror has the lost journal.
    pub lost: (u64, u64),
}

impl JournalPosition {
    /// The position that counts as shown when a process starts. Its mirror may be outdated or empty, so it answers nothing
    /// before etcd's journal has been read.
    pub fn at_start() -> Self {
        Self {
            seq: u64::from(!Mutant::AnswersUnread.lives()),
            ..Self::default()
        }
    }

    /// The number of the last record that a leader's answer may show: for a write the last acknowledged one, for a read the
    /// last one in the leader's mirror.
    pub fn shown_seq(is_read: bool, acknowledged: u64, last: u64) -> u64 {
        match is_read && !Mutant::ShowsAhead.lives() {
            true => last,
            false => acknowledged,
        }
    }

    /// Whether a mirror at this position may answer reads after earlier answers have shown the position `shown`. On one
    /// computer, no read goes back in time.
    pub fn shows(self, shown: Self) -> bool {
        // A new journal has all that its first leader knew, but what is left of the lost one in this mirror may be less.
        let has_read = (self.term, self.seq) > (0, 0);
        let has_all = match shown.epoch < self.epoch && !has_read {
            true => self.lost >= (shown.term, shown.seq),
            false => self >= shown,
        };
        has_all || Mutant::StaleReads.lives()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(epoch: u64, term: u64, seq: u64) -> JournalPosition {
        JournalPosition {
            epoch,
            term,
            seq,
            ..JournalPosition::default()
        }
    }

    /// Found on real computers: the leader had just started again when the journal was deleted, and it answered writes before
    /// the others noticed. Their mirrors, which lacked these writes, then answered reads.
    #[test]
    fn a_mirror_that_lacks_what_was_shown_of_a_lost_journal_waits_for_the_next_one() {
        let lost = |term, seq| JournalPosition {
            lost: (term, seq),
            ..at(1, 0, 0)
        };
        assert!(lost(5, 934).shows(at(0, 5, 934)));
        assert!(!lost(5, 934).shows(at(0, 5, 939)));
        assert!(!lost(5, 934).shows(at(0, 6, 0)));
        assert!(at(1, 7, 1).shows(at(0, 5, 939)));
        assert!(!lost(5, 934).shows(at(1, 7, 1)));
    }
}
