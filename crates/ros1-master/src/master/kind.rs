//! The kinds of calls: reads, writes, and calls that only the master understands.

/// The kind of a call. It depends on the method, or for a multicall on the entries.
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
/// The kind of a multicall is the lowest kind in this diagram that equals or lies above the kind of every entry,
/// including nested ones. For example, a multicall with an `Unregister` and an `Unknown` is a `Mutate`, because it must
/// be recorded and must go to the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// `getPid` and `getUri`: ask about the master's process.
    Identity,
    /// A call that changes nothing.
    Read,
    /// `unregister*` and `unsubscribeParam`: remove something that the caller registered.
    Unregister,
    /// A method that the Master API does not have, or a multicall that cannot run.
    Unknown,
    /// `register*`, `setParam`, `deleteParam`, `subscribeParam`: change the state.
    Mutate,
    /// `shutdown`: ends the master.
    Shutdown,
}

impl Kind {
    /// Whether the call may change the master's state, and so must be recorded.
    pub fn mutates(self) -> bool {
        matches!(self, Self::Unregister | Self::Mutate)
    }

    /// The lowest kind that equals or lies above both kinds in the diagram at [`Kind`].
    #[must_use]
    pub fn join(self, other: Self) -> Self {
        match (self, other) {
            (Self::Unregister, Self::Unknown) | (Self::Unknown, Self::Unregister) => Self::Mutate,
            _ if self as u8 >= other as u8 => self,
            _ => other,
        }
    }
}
