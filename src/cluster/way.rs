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
