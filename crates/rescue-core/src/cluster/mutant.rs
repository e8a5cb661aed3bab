//! Defects found in the field. A test puts each back, and the simulation must find it.

/// A defect that the product had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mutant {
    /// A former leader trusts its own disk although etcd's journal holds more.
    OwnDiskWins,
    /// A leader that was paused acts before it knows whether it still leads. A leader that etcd no longer answers does
    /// not stop its master.
    ActsWithoutLease,
    /// A computer that is cut off runs a master, which notifies nodes on other computers.
    MasterWhileAlone,
    /// A follower's mirror answers although it is out of date.
    StaleReads,
    /// An answer to a read, which may show a record that the journal lacks, counts as one that shows the journal.
    ShowsAhead,
    /// The mirror of a computer that starts answers before etcd's journal has been read.
    AnswersUnread,
    /// No computer corrects what nodes have heard from a former leader, or from a computer that was cut off.
    LeavesOldNews,
    /// A merge compares two states, so a value that others changed and changed back counts as unchanged.
    MergesByState,
    /// A value that equals this computer's own write never counts as another computer's change.
    GuessesByValues,
    /// Partition writes are checked for conflicts once, and then sent whatever others write meanwhile.
    JudgesOnce,
    /// A leader that is cut off keeps calls that other computers forwarded to it.
    KeepsForwarded,
    /// Every partition write is kept, instead of the last one of each subject.
    KeepsEachWrite,
    /// A leader that was alone deletes its file of partition writes before the journal has them.
    DeletesKeptWrites,
    /// An etcd that has lost its data is not recognised.
    TrustsLostEtcd,
    /// Keys of the journal that were deleted in a living etcd, or replaced by older ones, are not noticed.
    TrustsDeletedKeys,
    /// After an older copy of etcd was restored, its values count as changes by others.
    BelievesOldCopy,
    /// A process that starts follows an older copy of etcd, although its checkpoint has more.
    StartsFromOldCopy,
    /// Two computers of one name do not notice each other.
    IgnoresNamesake,
    /// A request that never ends blocks the machine forever.
    WaitsForEver,
}

#[cfg(test)]
thread_local! {
    static PRESENT: std::cell::Cell<Option<Mutant>> = const { std::cell::Cell::new(None) };
}

impl Mutant {
    /// Whether this defect is present.
    #[cfg(test)]
    pub(crate) fn lives(self) -> bool {
        PRESENT.get() == Some(self)
    }

    #[cfg(not(test))]
    pub(crate) fn lives(self) -> bool {
        false
    }

    /// Sets this thread's defect.
    #[cfg(test)]
    pub(crate) fn put(mutant: Option<Self>) {
        PRESENT.set(mutant);
    }
}
