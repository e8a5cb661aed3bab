//! Decides what to do with an examined master, as in the table in `docs/architecture.md` (Recovery, 4).

use super::{Authority, TokenState};

/// What is known about a master before it is examined.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KnownMaster {
    /// Nothing is known.
    Nothing,
    /// If the master has the latest [`Token`](super::Token), this rosrescue has already let calls pass to the master.
    ServedIfPresent,
    /// If the master has the latest [`Token`](super::Token), rosrescue has sent it the whole state, but got no
    /// confirmation.
    InjectedIfPresent,
    /// This rosrescue has just started the master on a free loopback port, as the successor of another master. So the
    /// master is empty, and rosrescue does not read it before the injection. The reads of the injection would show if
    /// the master was not empty.
    New {
        /// The process id of the master.
        pid: i32,
    },
}

/// What to do with a master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Treatment {
    /// Begin a session: master and mirror are both empty.
    Begin,
    /// Add the mirror's state to what the master holds.
    Inject,
    /// Copy the master's state into the mirror, which is empty.
    Adopt,
    /// Replace everything that the master holds by the mirror's state.
    Replace,
    /// Combine the master's state, the mirror and the pending writes with [`reconcile`](super::reconcile).
    Reconcile(Authority),
}

/// Decides what to do with a master that has the token `bears`. Not called for a master that can continue unchanged,
/// because it has the latest token, calls have already passed to it, and it has missed no write.
pub fn treatment(
    bears: TokenState,
    known: KnownMaster,
    mirror_is_empty: bool,
    master_is_empty: bool,
) -> Treatment {
    match (bears, known) {
        (TokenState::Nothing, _) if !mirror_is_empty => Treatment::Inject,
        (TokenState::Nothing, _) if master_is_empty => Treatment::Begin,
        (TokenState::Nothing, _) => Treatment::Adopt,
        // A new session has no state that could replace the master's.
        (TokenState::Earlier, KnownMaster::Nothing) if mirror_is_empty => Treatment::Adopt,
        // A later incarnation has been served, so the mirror is newer than everything in this master.
        (TokenState::Earlier, _) => Treatment::Replace,
        // The checkpoint is older than this master, or another rosrescue has a copy of the checkpoint.
        (TokenState::Later(_), KnownMaster::Nothing) => {
            Treatment::Reconcile(Authority::PendingWrites)
        }
        (TokenState::Later(_), _) => Treatment::Replace,
        // This master has run all writes of the checkpoint that are not pending, and perhaps more.
        (TokenState::Present, KnownMaster::Nothing | KnownMaster::ServedIfPresent) => {
            Treatment::Reconcile(Authority::PendingWrites)
        }
        (TokenState::Present, _) => Treatment::Reconcile(Authority::Mirror),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_master_is_treated_as_the_architecture_document_says() {
        use Treatment::{Adopt, Begin, Inject, Reconcile, Replace};
        let (served, injected) = (KnownMaster::ServedIfPresent, KnownMaster::InjectedIfPresent);
        for (bears, known, mirror_is_empty, master_is_empty, expected) in [
            (
                TokenState::Present,
                served,
                false,
                false,
                Reconcile(Authority::PendingWrites),
            ),
            (
                TokenState::Present,
                injected,
                false,
                false,
                Reconcile(Authority::Mirror),
            ),
            (
                TokenState::Present,
                KnownMaster::Nothing,
                false,
                false,
                Reconcile(Authority::PendingWrites),
            ),
            (
                TokenState::Later(7),
                KnownMaster::Nothing,
                false,
                false,
                Reconcile(Authority::PendingWrites),
            ),
            (TokenState::Later(7), served, false, false, Replace),
            (
                TokenState::Present,
                served,
                true,
                true,
                Reconcile(Authority::PendingWrites),
            ),
            (TokenState::Earlier, served, false, false, Replace),
            (
                TokenState::Earlier,
                KnownMaster::Nothing,
                false,
                false,
                Replace,
            ),
            (
                TokenState::Earlier,
                KnownMaster::Nothing,
                true,
                false,
                Adopt,
            ),
            (
                TokenState::Nothing,
                KnownMaster::Nothing,
                true,
                false,
                Adopt,
            ),
            (TokenState::Nothing, KnownMaster::Nothing, true, true, Begin),
            (
                TokenState::Nothing,
                KnownMaster::Nothing,
                false,
                false,
                Inject,
            ),
            (TokenState::Nothing, served, false, true, Inject),
            (
                TokenState::Nothing,
                KnownMaster::New { pid: 1 },
                false,
                true,
                Inject,
            ),
            (
                TokenState::Nothing,
                KnownMaster::New { pid: 1 },
                true,
                true,
                Begin,
            ),
        ] {
            let found = treatment(bears, known, mirror_is_empty, master_is_empty);
            assert_eq!(found, expected, "{bears:?} {known:?}");
        }
    }
}
