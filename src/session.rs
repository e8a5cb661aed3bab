//! Whether a checkpoint's session goes on, or the robot was switched on anew.
//!
//! A robot that is switched on in the morning must not wake up with yesterday's parameters.

use crate::{
    master::Master,
    record::{Checkpoint, Entry, Record, Session},
};

/// When a checkpoint is restored at start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restore {
    /// If the session goes on: same boot and no orderly stop, or a registered node still lives.
    Auto,
    /// Always.
    Always,
    /// Never: the old file is kept under another name.
    Never,
}

/// What is known about a recorded session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Evidence {
    /// The computer has not been booted since.
    pub same_boot: bool,
    /// rosrescue was stopped in order.
    pub closed: bool,
    /// A node that was registered answers; one on another computer, unless it is the same boot.
    pub node_alive: bool,
}

/// Why a checkpoint is restored or not, in words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Restore it.
    Restore(&'static str),
    /// Begin a new session.
    Fresh(&'static str),
}

/// Decides. `evidence` is asked for only if it matters.
pub fn decide(policy: Restore, evidence: Evidence) -> Decision {
    let Evidence {
        same_boot,
        closed,
        node_alive,
    } = evidence;
    match policy {
        Restore::Always => Decision::Restore("--restore always"),
        Restore::Never => Decision::Fresh("--restore never"),
        Restore::Auto if same_boot && !closed => {
            Decision::Restore("the session goes on: rosrescue was not stopped in order")
        }
        Restore::Auto if node_alive => Decision::Restore("the session goes on: nodes are alive"),
        Restore::Auto if closed => {
            Decision::Fresh("rosrescue was stopped in order and no node is alive")
        }
        Restore::Auto => Decision::Fresh("the computer was booted anew and no node is alive"),
    }
}

/// The state that a checkpoint and the records after it make, and the session at its end. A
/// snapshot that is no state of a master is left out, which the text says.
pub fn rebuild(
    checkpoint: Option<Checkpoint>,
    records: Vec<Record>,
) -> (Master, Option<Session>, Option<String>) {
    let mut session = None;
    let mut mirror = Master::default();
    let mut trouble = None;
    if let Some(Checkpoint {
        session: of,
        snapshot,
        ..
    }) = checkpoint
    {
        session = Some(of);
        match Master::from_snapshot(snapshot) {
            Ok(state) => mirror = state,
            Err(error) => trouble = Some(error.to_string()),
        }
    }
    for record in records {
        match record.entry {
            Entry::Call(call) => {
                mirror.apply(&call);
            }
            Entry::Session(of) => session = Some(of),
        }
    }
    (mirror, session, trouble)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn restores(policy: Restore, same_boot: bool, closed: bool, node_alive: bool) -> bool {
        let evidence = Evidence {
            same_boot,
            closed,
            node_alive,
        };
        matches!(decide(policy, evidence), Decision::Restore(_))
    }

    #[test]
    fn a_session_goes_on_after_a_crash_or_while_nodes_live() {
        assert!(
            restores(Restore::Auto, true, false, false),
            "crash and start"
        );
        assert!(
            !restores(Restore::Auto, true, true, false),
            "orderly stop and start"
        );
        assert!(
            restores(Restore::Auto, true, true, true),
            "orderly stop, nodes alive"
        );
        assert!(!restores(Restore::Auto, false, false, false), "reboot");
        assert!(
            restores(Restore::Auto, false, false, true),
            "reboot, nodes on another computer"
        );
    }

    #[test]
    fn always_and_never_say_so_outright() {
        for evidence in 0..8 {
            let [boot, closed, alive] = [1, 2, 4].map(|bit| evidence & bit != 0);
            assert!(restores(Restore::Always, boot, closed, alive));
            assert!(!restores(Restore::Never, boot, closed, alive));
        }
    }
}
