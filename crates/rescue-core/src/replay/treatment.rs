//! What is done with a master that is examined: the table of `docs/architecture.md` (Recovery, 4).

use super::{Authority, Bears};

/// What is known of a master before it is examined.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// Nothing.
    Nothing,
    /// If it bears the token, this process has served it before.
    ServedIfPresent,
    /// If it bears the token, it has been injected but never confirmed.
    InjectedIfPresent,
    /// This process has just started it on a free loopback port, as the successor of one that it served. So
    /// it is empty and not read before the injection; reading back would show if it were not.
    New {
        /// Its process id.
        pid: i32,
    },
}

/// What is done with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Treatment {
    /// It is empty, and so is the mirror: a session begins.
    Begin,
    /// It gets the mirror's state in addition to what it holds.
    Inject,
    /// The mirror, which is empty, takes over what it holds.
    TakeOver,
    /// All that it holds is replaced by the mirror's state.
    Replace,
    /// It gets what [`reconcile`](super::reconcile) makes of its state, the mirror and the pending writes.
    Reconcile(Authority),
}

/// What to do with a master that bears `bears`. One that bears the present token, has been served and misses no
/// write goes on as it is and does not come here.
pub fn treatment(
    bears: Bears,
    known: Known,
    mirror_is_empty: bool,
    master_is_empty: bool,
) -> Treatment {
    match (bears, known) {
        (Bears::Nothing, _) if !mirror_is_empty => Treatment::Inject,
        (Bears::Nothing, _) if master_is_empty => Treatment::Begin,
        (Bears::Nothing, _) => Treatment::TakeOver,
        // A session that has just begun knows nothing that could replace what it holds.
        (Bears::Earlier, Known::Nothing) if mirror_is_empty => Treatment::TakeOver,
        // Another incarnation has succeeded it: the mirror is newer than anything it holds.
        (Bears::Earlier, _) => Treatment::Replace,
        // The checkpoint is older than this master, or another rosrescue has a copy of it.
        (Bears::Later(_), Known::Nothing) => Treatment::Reconcile(Authority::PendingWrites),
        (Bears::Later(_), _) => Treatment::Replace,
        // It has run every write of the checkpoint that is not pending, and maybe more.
        (Bears::Present, Known::Nothing | Known::ServedIfPresent) => {
            Treatment::Reconcile(Authority::PendingWrites)
        }
        (Bears::Present, _) => Treatment::Reconcile(Authority::Mirror),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_master_gets_what_the_document_says() {
        use Treatment::{Begin, Inject, Reconcile, Replace, TakeOver};
        let (served, injected) = (Known::ServedIfPresent, Known::InjectedIfPresent);
        for (bears, known, mirror_is_empty, master_is_empty, expected) in [
            (
                Bears::Present,
                served,
                false,
                false,
                Reconcile(Authority::PendingWrites),
            ),
            (
                Bears::Present,
                injected,
                false,
                false,
                Reconcile(Authority::Mirror),
            ),
            (
                Bears::Present,
                Known::Nothing,
                false,
                false,
                Reconcile(Authority::PendingWrites),
            ),
            (
                Bears::Later(7),
                Known::Nothing,
                false,
                false,
                Reconcile(Authority::PendingWrites),
            ),
            (Bears::Later(7), served, false, false, Replace),
            (
                Bears::Present,
                served,
                true,
                true,
                Reconcile(Authority::PendingWrites),
            ),
            (Bears::Earlier, served, false, false, Replace),
            (Bears::Earlier, Known::Nothing, false, false, Replace),
            (Bears::Earlier, Known::Nothing, true, false, TakeOver),
            (Bears::Nothing, Known::Nothing, true, false, TakeOver),
            (Bears::Nothing, Known::Nothing, true, true, Begin),
            (Bears::Nothing, Known::Nothing, false, false, Inject),
            (Bears::Nothing, served, false, true, Inject),
            (Bears::Nothing, Known::New { pid: 1 }, false, true, Inject),
            (Bears::Nothing, Known::New { pid: 1 }, true, true, Begin),
        ] {
            let found = treatment(bears, known, mirror_is_empty, master_is_empty);
            assert_eq!(found, expected, "{bears:?} {known:?}");
        }
    }
}
