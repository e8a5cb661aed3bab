//! Rules of the write queue that a test leaves out, one at a time. The simulation must notice.

/// A rule that is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mutant {
    /// Nothing waits for answers or notifications under way, as before decision 31.
    NoOrder,
    /// No state is told again.
    NoRepeats,
    /// A batch whose answer was lost is sent again before it is known whether its master lives.
    SendsAfterLoss,
    /// A request of a master that went away may still run while that master is examined.
    KeepsConnection,
    /// It is forgotten about what a late master notifies nodes once it goes on.
    ForgetsLateNews,
    /// What the mirror answered while the master was away counts as told to nodes.
    OwesNothing,
}

#[cfg(test)]
thread_local! {
    static PRESENT: std::cell::Cell<Option<Mutant>> = const { std::cell::Cell::new(None) };
}

impl Mutant {
    /// Whether this rule is left out.
    #[cfg(test)]
    pub(crate) fn lives(self) -> bool {
        PRESENT.get() == Some(self)
    }

    #[cfg(not(test))]
    pub(crate) fn lives(self) -> bool {
        false
    }

    /// Sets the rule that this thread leaves out.
    #[cfg(test)]
    pub(crate) fn put(mutant: Option<Self>) {
        PRESENT.set(mutant);
    }
}
