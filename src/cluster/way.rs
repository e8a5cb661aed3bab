//! Which computer answers calls.

use crate::ros_env::MasterUri;

/// The computer that answers calls now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Way {
    /// This computer.
    Here {
        /// The term in which this computer leads; `None` while it is cut off. Only a leader takes calls from other
        /// computers.
        term: Option<u64>,
    },
    /// The leader, on another computer.
    Leader { uri: MasterUri, term: u64 },
    /// No computer. Writes wait.
    Nobody {
        /// Whether the mirror holds the robot's state and answers reads.
        known: bool,
    },
}

/// A position in the journal that all computers share. A later term is always further: its leader has everything that
/// was committed before, and no other record of an earlier term will follow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The leader's term at that time.
    pub term: u64,
    /// The record's number.
    pub seq: u64,
}
