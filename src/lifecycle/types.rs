//! What the lifecycle is told, and what it answers.

use std::time::Duration;

/// Who starts masters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Supervision {
    /// rosrescue does.
    Ours,
    /// Somebody else does; rosrescue waits.
    Theirs,
}

/// How a hung master is told from a slow one.
#[derive(Clone, Copy, Debug)]
pub struct Probing {
    /// Pause between an answered probe and the next.
    pub interval: Duration,
    /// So many missed probes in a row mean that the master hangs.
    pub count: u32,
}

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Input {
    /// rosrescue starts.
    Start {
        /// Whether a master that an earlier rosrescue spawned still runs. Its end is told as that of
        /// a child.
        left: bool,
        /// Whether the mirror comes from a checkpoint whose session goes on.
        restored: bool,
    },
    /// The master that is examined has answered, and is being brought to the mirror's state: if it ends now,
    /// that is a death of its own.
    Answered,
    /// The connection to the master is there.
    Connected,
    /// Nothing listens at the master's address.
    Refused,
    /// The master's address cannot be reached, or does not answer in time.
    Unreachable,
    /// The connection to the master has ended.
    ConnectionLost,
    /// A thread of the master has ended, as all do when it is killed.
    ThreadEnded,
    /// A batch of writes got no reply.
    BatchLost,
    /// The master has not answered a call for longer than it should take.
    Slow,
    /// The master holds the whole state.
    Examined {
        /// It is not the incarnation that was served before.
        new: bool,
    },
    /// What listens there does not answer as a master does.
    NotAMaster,
    /// The master answered a probe in time.
    ProbeAnswered,
    /// The master did not answer a probe in time.
    ProbeMissed,
    /// A master was spawned.
    Spawned,
    /// No master could be spawned.
    SpawnFailed {
        /// Whether the mirror has answered writes that no master has run yet.
        pending: bool,
    },
    /// The spawned master has ended.
    Exited,
    /// The time of [`Lifecycle::deadline`](super::Lifecycle::deadline) has come.
    Wake,
    /// rosrescue is to stop.
    Stop,
}

/// Why the gate is shut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// The master's connection ended: it died, or it closed an idle connection.
    ConnectionLost,
    /// A thread of the master ended: it dies, or it is being stopped in order.
    ThreadEnded,
    /// The master's process ended.
    Exited,
    /// The master no longer answers.
    Hung,
    /// rosrescue stops.
    Stopping,
}

impl Cause {
    /// The cause in words, for reports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::ConnectionLost => "the master's connection ended",
            Self::ThreadEnded => "a thread of the master ended",
            Self::Exited => "the master's process ended",
            Self::Hung => "the master stopped answering",
            Self::Stopping => "rosrescue stops",
        }
    }
}

/// What the shell is to do, in order. A new `Connect` or `Examine` cancels the step that is under way;
/// a `Probe` leaves it alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Connect to the master; answer `Connected`, `Refused` or `Unreachable`.
    Connect,
    /// Bring the connected master to the mirror's state, or the mirror to its; answer `Examined`,
    /// `NotAMaster` or `Unreachable`.
    Examine,
    /// Let no call pass.
    ShutGate(Cause),
    /// Let calls pass.
    OpenGate,
    /// Ask the master for a sign of life; answer `ProbeAnswered` or `ProbeMissed`.
    Probe,
    /// Start a master; answer `Spawned` or `SpawnFailed`.
    Spawn,
    /// End the master at once.
    Kill,
    /// End rosrescue: no master can be started, and there is no state that a later one could be given. Better
    /// to say what is wrong than to try for ever.
    GiveUp,
    /// Report a crash loop: the number of deaths within a minute.
    ReportCrashLoop(usize),
    /// Say that it no longer does.
    ReportCalm,
}
