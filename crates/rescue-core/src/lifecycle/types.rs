//! Inputs and actions of the lifecycle.

use std::time::Duration;

/// Whether rosrescue or another program starts the masters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Supervision {
    /// rosrescue starts the masters.
    Ours,
    /// Another program starts the masters, and rosrescue waits for them.
    Theirs,
}

/// How to tell a hung master from a slow one.
#[derive(Clone, Copy, Debug)]
pub struct Probing {
    /// Pause between an answered probe and the next.
    pub interval: Duration,
    /// Number of unanswered probes in a row after which the master counts as hung.
    pub count: u32,
    /// How long a new master may take until it listens. Later it is killed if it hangs.
    pub start_limit: Duration,
}

/// An event that the lifecycle reacts to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Input {
    /// rosrescue starts.
    Start {
        /// Whether a master of an earlier rosrescue still runs. Its end is reported as [`Input::Exited`], as if this
        /// rosrescue had started it.
        left: bool,
        /// Whether the mirror comes from a checkpoint whose session continues.
        restored: bool,
    },
    /// The examined master has answered and is being brought to the mirror's state. If the master ends now, that counts
    /// as another death.
    Answered,
    /// A connection to the master has been made.
    Connected,
    /// Nothing listens at the master's address.
    Refused,
    /// Another program listens at the port of the new master.
    PortTaken,
    /// The master's address cannot be reached, or does not answer in time.
    Unreachable,
    /// The connection to the master has ended.
    ConnectionLost,
    /// A thread of the master has ended, as all its threads do when the master is killed.
    ThreadEnded,
    /// Writes that went to the master together got no reply.
    BatchLost,
    /// The master takes too long to answer a call.
    Slow,
    /// A write has waited for as long as [`Patience`](super::Patience) says, and the mirror can answer it.
    Late,
    /// The master has answered the calls that were outstanding when it was [late](Self::Late).
    LateAnswered,
    /// The late master has got the writes that the mirror answered in its place.
    CaughtUp,
    /// The late master could not get the writes that it missed.
    NotCaughtUp,
    /// The examination has ended: master and mirror have the same state.
    Examined {
        /// Whether the master is another process than the one that served before.
        new: bool,
    },
    /// The server at the master's address is not a master.
    NotAMaster,
    /// The master answered a probe in time.
    ProbeAnswered,
    /// The master did not answer a probe in time.
    ProbeMissed,
    /// A master was spawned.
    Spawned,
    /// No master could be spawned.
    SpawnFailed {
        /// Whether there are pending writes: answered by the mirror, and not yet run by the present master.
        pending: bool,
    },
    /// The spawned master has ended.
    Exited,
    /// The time of [`Lifecycle::deadline`](super::Lifecycle::deadline) has come.
    Wake,
    /// rosrescue must stop.
    Stop,
}

/// Why no calls pass to the master any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// The master's connection ended: it died, or it closed an idle connection.
    ConnectionLost,
    /// A thread of the master ended: the master is dying, or is being stopped.
    ThreadEnded,
    /// The master's process ended.
    Exited,
    /// The master no longer answers.
    Hung,
    /// The master was late and must be examined.
    Late,
    /// rosrescue stops.
    Stopping,
}

impl Cause {
    /// The cause in words, for reports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::ConnectionLost => "the connection to the master ended",
            Self::ThreadEnded => "the master is ending",
            Self::Exited => "the master's process ended",
            Self::Hung => "the master stopped answering",
            Self::Late => "the master answered late",
            Self::Stopping => "rosrescue is stopping",
        }
    }
}

/// An action that the caller of [`Lifecycle::on`](super::Lifecycle::on) must carry out. Actions are carried out in
/// order. A new `Connect`, `Examine` or `CatchUp` cancels the one of these that is still running, or a running `Probe`.
/// A `Probe` cancels nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Connect to the master. Results: `Connected`, `Refused`, `PortTaken` or `Unreachable`.
    Connect,
    /// Bring the connected master to the mirror's state, or the mirror to the master's. Results: `Examined`,
    /// `NotAMaster`, `Unreachable` or `ConnectionLost`.
    Examine,
    /// Shut the gate: let no call pass to the master.
    ShutGate(Cause),
    /// Let the mirror answer until the master has answered its outstanding calls. Result: `LateAnswered`.
    StandIn,
    /// Send the late master the writes that the mirror has answered in its place. Results: `CaughtUp` or `NotCaughtUp`.
    CatchUp,
    /// Open the gate: let calls pass to the master.
    OpenGate,
    /// Probe the master. Results: `ProbeAnswered`, `ProbeMissed`, or `ConnectionLost` if another master answers.
    Probe,
    /// Start a master. Results: `Spawned` or `SpawnFailed`.
    Spawn,
    /// Kill the master.
    Kill,
    /// Report why a master that does not answer is not killed.
    Spare(&'static str),
    /// Stop rosrescue with an error: no master can be started, and there is no state that a later master would need.
    GiveUp,
    /// Report a crash loop, with the number of deaths within a minute.
    ReportCrashLoop(usize),
    /// Report the end of the crash loop.
    ReportCalm,
}
