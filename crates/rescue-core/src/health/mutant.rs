//! Wrong rules about dead nodes. A test puts each of them in, and the simulation must find it.

/// A rule about deaths that a test breaks on purpose. The simulation must notice each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WrongRule {
    /// A node is dead when its socket is closed, whether or not its process runs.
    ClosedPortIsDeath,
    /// The owner of the socket counts as the node, although it may only forward the port.
    TrustsForwarders,
    /// A socket with several names proves the end of each.
    SharedSocketProves,
    /// A name that moves is not judged, so the master shuts down whatever listens at the old port.
    MovesUnjudged,
    /// Only registered names at the old port count, and no other program.
    OnlyNamesCount,
}

#[cfg(test)]
thread_local! {
    static PRESENT: std::cell::Cell<Option<WrongRule>> = const { std::cell::Cell::new(None) };
}

impl WrongRule {
    /// Whether this rule is in force.
    #[cfg(test)]
    pub(super) fn lives(self) -> bool {
        PRESENT.get() == Some(self)
    }

    #[cfg(not(test))]
    pub(super) fn lives(self) -> bool {
        false
    }

    /// Sets this thread's wrong rule.
    #[cfg(test)]
    pub(super) fn put(rule: Option<Self>) {
        PRESENT.set(rule);
    }
}
