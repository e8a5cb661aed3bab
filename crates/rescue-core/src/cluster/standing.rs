//! Who has the master, and where calls of nodes go. Pure.

use crate::cluster::mutant::Mutant;

/// What passes where a computer leads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pass {
    Calls,
    /// Reads, by the mirror; the next leader is to come.
    Reads,
    /// Nothing: what was answered here alone is not merged yet, and whoever wrote it would not see it.
    Nothing,
}

/// What this computer is at this moment. [`Member`](crate::cluster::member::Member) decides it; nothing else sets it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// This computer leads in `term`, and has the master.
    Leads { term: u64, pass: Pass },
    /// This computer is cut off, and its mirror answers its own nodes. Calls of other computers are refused.
    Alone,
    /// The computer at `uri` leads in `term`, and is sent all calls.
    Follows { uri: String, term: u64 },
    /// Nobody leads. Writes wait. `known`: the mirror holds the robot's state, and answers reads.
    Nobody { known: bool },
}

impl Standing {
    /// Whether calls are recorded on this computer, and not on another one.
    pub fn records(&self) -> bool {
        matches!(self, Self::Leads { .. } | Self::Alone)
    }

    /// Whether this computer answers calls of its own nodes.
    pub fn answers(&self) -> bool {
        let pass = Pass::Calls;
        matches!(self, Self::Leads { pass: of, .. } if *of == pass) || *self == Self::Alone
    }

    /// Whether this computer answers calls that others send it for the leader of `term`.
    pub fn answers_others(&self, term: u64) -> bool {
        let pass = Pass::Calls;
        *self == Self::Leads { term, pass }
    }
}

/// A place in the journal of all computers. One of a later term is further: whoever leads in it holds all that was
/// committed before, and nothing else of the earlier terms will ever be in the journal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// How often etcd has lost its data since this process began.
    pub epoch: u64,
    /// The term of the computer that leads.
    pub term: u64,
    /// The number of a record.
    pub seq: u64,
}

impl Place {
    /// Whether a mirror that is here may answer reads, when answers have told of `told`: on one computer no read
    /// goes back.
    pub fn shows(self, told: Self) -> bool {
        self >= told || Mutant::StaleReads.lives()
    }
}
