//! The calls that the master has not answered, and the writes that a late master has missed because the mirror answered
//! them.

use rescue_core::{
    order::{BySubject, Subject},
    replay::Token,
};
use ros1_master::{
    master::{Master, NoticeSink, Request},
    xmlrpc::Value,
};

use super::mutant::Mutant;

/// The calls that the present master was given and has not answered.
#[derive(Default)]
pub(super) enum Outstanding {
    /// Their answers are awaited, or there are none.
    #[default]
    Awaited,
    /// The mirror has answered them, because the master is late. What the master holds once it has answered them, too.
    Late(Box<LateState>),
    /// Their answers are no longer awaited. The master may still run them.
    Abandoned,
}

impl Outstanding {
    /// Whether the present master may still run calls whose answers are no longer awaited.
    pub(super) fn is_abandoned(&self) -> bool {
        matches!(self, Self::Abandoned)
    }

    /// Takes what is known of a late master. It cannot catch up any more.
    pub(super) fn take_late(&mut self) -> Option<LateState> {
        match std::mem::take(self) {
            Self::Late(late) => Some(*late),
            other => {
                *self = other;
                None
            }
        }
    }
}

/// The state of a late master once it has answered its outstanding calls.
pub(super) struct LateState {
    pub(super) state: Master,
    /// The number of pending writes that the master will have run when it has answered its outstanding calls. It must
    /// still get the later ones.
    pub(super) ran: usize,
    /// The topics, parameters and node names about which the outstanding calls may make the master notify nodes.
    pub(super) tells: Vec<Subject>,
    pub(super) answered: bool,
    /// Whether [`Self::state`] is what the master will have. Not if the mirror had answered later calls first.
    pub(super) is_exact: bool,
}

/// How to bring a late master up to date.
#[derive(Debug)]
pub(crate) enum CatchUp {
    /// The master has missed nothing.
    Nothing,
    /// The master must run the writes that it has missed.
    Run(Box<Missed>),
}

/// The writes that a late master has missed, and the states before and after them.
#[derive(Debug)]
pub(crate) struct Missed {
    /// The state that the master holds.
    pub(crate) behind: Master,
    pub(crate) writes: Vec<Request>,
    /// The topics and parameters of which the master notifies nodes when it runs [`Self::writes`], each with the number
    /// of these nodes.
    pub(crate) notified: Vec<(Subject, usize)>,
    /// The state that the master holds after it has run the missed writes.
    pub(crate) mirror: Master,
    pub(crate) before: Token,
    pub(crate) token: Token,
}

/// The topics and parameters of which the master notifies nodes when it runs `writes`, each with the number of these
/// nodes. `None` if a node would have to shut down, or if nodes would be notified of one of them more than once.
pub(super) fn notified_once(
    behind: &LateState,
    writes: &[Request],
) -> Option<Vec<(Subject, usize)>> {
    let mut heard = BySubject::default();
    for subject in &behind.tells {
        heard.add(subject, ());
    }
    let mut master = behind.state.clone();
    let mut notified = Vec::new();
    for write in writes {
        let mut tells = Tells::default();
        master.apply_telling(write, &mut tells);
        let shuts_down = tells.shuts_down && !Mutant::ShutsDownLate.lives();
        if shuts_down || tells.notified.iter().any(|(subject, _)| heard.has(subject)) {
            return None;
        }
        for (subject, _) in &tells.notified {
            heard.add(subject, ());
        }
        notified.extend(tells.notified);
    }
    Some(notified)
}

/// The topics and parameters of which one call notifies nodes, each with the number of these nodes.
#[derive(Default)]
struct Tells {
    notified: Vec<(Subject, usize)>,
    shuts_down: bool,
}

impl NoticeSink for Tells {
    fn publisher_update(&mut self, to: &[String], topic: &str, _: &[String]) {
        self.notified
            .push((Subject::Topic(topic.to_owned()), to.len()));
    }

    fn param_update(&mut self, to: &[String], key: &str, _: &Value) {
        self.notified
            .push((Subject::Param(key.to_owned()), to.len()));
    }

    fn shutdown(&mut self, _: &str, _: &str) {
        self.shuts_down = true;
    }
}
