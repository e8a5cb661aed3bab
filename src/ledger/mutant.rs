//! Rules of the write queue and of notifications that a test leaves out, one at a time. The simulation
//! (`write_queue/tests.rs`) must notice.

/// A rule that is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mutant {
    /// Nothing waits for answers or notifications under way, as before decision 31.
    #[cfg(test)]
    NoOrder,
    /// No state is told again.
    #[cfg(test)]
    NoRepeats,
    /// A living master that was silent is not expected to send old notifications.
    TellsOnce,
    /// What a lost master may not have told nodes is forgotten.
    OwesNothing,
    /// A notification that the last process of rosrescue had on its way is not expected.
    ForgetsLastProcess,
    /// The mirror answers writes first although nothing would keep them if the process ended.
    AnswersUnprotected,
    /// The journal does not get to know which writes the master has run.
    NotesNothingRun,
    /// Calls overtake a write that the mirror has answered first.
    Overtakes,
    /// Writes that the mirror has answered first go to the next master, too, which has got the state.
    KeepsAnswered,
    /// The master does not get what the mirror has answered during the injection.
    LeavesBehind,
    /// What a master holds replaces what the mirror has answered since the injection began.
    ForgetsAnswered,
    /// An injection is not announced in the journal.
    AnnouncesNothing,
    /// A master is read although it may still run calls of closed connections.
    ReadsBeforeRun,
    /// The mirror wins over what another program has set in a late master while it caught up.
    UndoesDirectChange,
    /// A pending registration of a node that has ended displaces the one that took its name.
    ReturnsEndedNodes,
    /// A late master runs a registration that makes it shut down a node, although the mirror has answered it long ago.
    ShutsDownLate,
    /// The master is read although it has not run all writes that the mirror has answered first.
    ReadsTooEarly,
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
