//! Where calls go.

use crate::ros_env::MasterUri;

/// Who answers calls now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Way {
    /// This computer.
    Here {
        /// In which it leads; none while it is alone. Calls of other computers are taken only if it leads.
        term: Option<u64>,
    },
    /// The leader.
    Leader { uri: MasterUri, term: u64 },
    /// Nobody: writes wait.
    Nobody {
        /// Whether the mirror holds the robot's state, and answers reads.
        known: bool,
    },
}

/// A place in the journal of all computers. One of a later term is further: the leader of that term holds all that was
/// committed before, and nothing else of the earlier terms will ever be in the journal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The term of the computer that leads.
    pub term: u64,
    /// The number of a record.
    pub seq: u64,
}
