//! Kinds of calls: reads, writes, and calls that only the master understands.

/// The kind of a call, by its method; for a multicall, by its entries.
///
/// ```text
///            Shutdown
///               |
///             Mutate
///             /    \
///     Unregister   Unknown
///             \    /
///              Read
///               |
///            Identity
/// ```
///
/// The kind of a multicall is the lowest one above all its entries, nested ones too. A call that unregisters
/// and also does something unknown must be recorded and must go to the master, so it is a `Mutate`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// `getPid`, `getUri`: answers about the master's process.
    Identity,
    /// Changes nothing.
    Read,
    /// `unregister*`, `unsubscribeParam`: removes something that the caller registered.
    Unregister,
    /// A method that the Master API lacks, or a multicall that cannot run.
    Unknown,
    /// `register*`, `setParam`, `deleteParam`, `subscribeParam`: changes state.
    Mutate,
    /// Ends the master.
    Shutdown,
}

impl Kind {
    /// Whether the call may change the master's state, and so must be recorded.
    pub fn mutates(self) -> bool {
        matches!(self, Self::Unregister | Self::Mutate)
    }

    /// The lowest kind above both.
    #[must_use]
    pub fn join(self, other: Self) -> Self {
        match (self, other) {
            (Self::Unregister, Self::Unknown) | (Self::Unknown, Self::Unregister) => Self::Mutate,
            _ if self as u8 >= other as u8 => self,
            _ => other,
        }
    }
}
