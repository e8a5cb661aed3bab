//! Defects that were found in the field, to be put back one at a time: the simulation must find each.

/// What is done wrong, as before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mutant {
    /// A former leader believes its own disk, although etcd's journal holds more.
    OwnDiskWins,
    /// A leader that stood still acts before it knows whether it leads, and one that is silent keeps its master.
    ActsWithoutLease,
    /// A computer that is alone runs a master, which notifies nodes everywhere.
    MasterWhileAlone,
    /// A follower's mirror answers, whatever its age.
    StaleReads,
    /// Two states are compared: what others have set and set back is no change.
    MergesByState,
    /// What equals an own write is no change of others.
    GuessesByValues,
    /// What was answered alone is judged once, and then sent whatever others write meanwhile.
    JudgesOnce,
    /// A leader that is cut off keeps calls that others have forwarded to it.
    KeepsForwarded,
    /// Each write of a time alone is kept.
    KeepsEachWrite,
    /// An etcd that has lost its data is not recognised.
    TrustsLostEtcd,
    /// Two computers of one name do not notice each other.
    IgnoresNamesake,
    /// A request that never ends is waited for.
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

    /// Puts a defect into this thread, or takes it out.
    #[cfg(test)]
    pub(crate) fn put(mutant: Option<Self>) {
        PRESENT.set(mutant);
    }
}
