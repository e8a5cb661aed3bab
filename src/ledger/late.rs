//! The writes that a late master has missed because the mirror answered them.

use std::time::Instant;

use super::{Inner, Ledger};
use crate::{
    master::{Master, NoticeSink, Request},
    order::{BySubject, Subject},
    replay::Token,
    xmlrpc::Value,
};

/// The state of a late master once it has answered its outstanding calls.
pub(super) struct LateState {
    state: Master,
    /// The number of pending writes that the master will have run when it has answered its outstanding calls. It must
    /// still get the later ones.
    ran: usize,
    /// The topics, parameters and node names about which the outstanding calls may make the master notify nodes.
    tells: Vec<Subject>,
    answered: bool,
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
    /// The state that the master holds after it has run the missed writes.
    pub(crate) mirror: Master,
    pub(crate) before: Token,
    pub(crate) token: Token,
}

impl Ledger {
    /// Notes that the mirror has answered the calls that the present master is late with, and no later calls. `tells`
    /// are the topics, parameters and node names about which these calls may make the master notify nodes.
    pub(crate) fn fall_behind(&self, tells: Vec<Subject>) {
        let mut inner = self.lock();
        inner.behind = Some(LateState {
            state: inner.mirror.clone(),
            ran: inner.pending.calls().len(),
            tells,
            answered: false,
        });
    }

    /// Notes that the late master has answered its outstanding calls. It may notify nodes of the changes by these calls
    /// only now.
    pub(crate) fn late_answered(&self, now: Instant) {
        let mut inner = self.lock();
        let Inner {
            behind: Some(behind),
            mirror,
            order,
            ..
        } = &mut *inner
        else {
            return;
        };
        behind.answered = true;
        for subject in &behind.tells {
            let nodes = match subject {
                Subject::Topic(topic) => mirror.subscribers_of(topic).len(),
                Subject::Param(_) => 1,
                Subject::Name(_) => continue,
            };
            order.told_by_master(now, subject, nodes);
        }
        drop(inner);
        self.outbox_changed.notify_one();
    }

    /// Decides what the present master needs after it was late and has answered. Freezes the mirror until
    /// [`Self::end_injection`] or [`Self::serve`]. Begins a new incarnation (see [`Token`]) if the master must run
    /// writes.
    ///
    /// `None` if the master must be examined instead: it has not answered, its state is in doubt, a node would have to
    /// shut down, or a node would be notified twice of one topic or parameter and could get the older value last.
    pub(crate) fn begin_catch_up(&self, now: Instant) -> Option<CatchUp> {
        let mut inner = self.lock();
        let behind = inner.behind.take().filter(|behind| behind.answered)?;
        if inner.doubted || inner.abandoned || inner.mirror.is_inexact() {
            return None;
        }
        if inner.pending.calls().is_empty() {
            inner.injecting = true;
            return Some(CatchUp::Nothing);
        }
        let writes = inner.pending.calls().get(behind.ran..)?.to_vec();
        let told = once(&behind, &writes)?;
        inner.injecting = true;
        let before = inner.token();
        inner.raise_incarnation();
        for (subject, nodes) in told {
            inner.order.told_by_master(now, &subject, nodes);
        }
        Some(CatchUp::Run(Box::new(Missed {
            behind: behind.state,
            writes,
            mirror: inner.mirror.clone(),
            before,
            token: inner.token(),
        })))
    }
}

/// The topics and parameters of which the master notifies nodes when it runs `writes`, each with the number of these
/// nodes. `None` if a node would have to shut down, or if nodes would be notified of one of them more than once.
fn once(behind: &LateState, writes: &[Request]) -> Option<Vec<(Subject, usize)>> {
    let mut heard = BySubject::default();
    for subject in &behind.tells {
        heard.add(subject, ());
    }
    let mut master = behind.state.clone();
    let mut told = Vec::new();
    for write in writes {
        let mut tells = Tells::default();
        master.apply_telling(write, &mut tells);
        if tells.shuts_down || tells.told.iter().any(|(subject, _)| heard.has(subject)) {
            return None;
        }
        for (subject, _) in &tells.told {
            heard.add(subject, ());
        }
        told.extend(tells.told);
    }
    Some(told)
}

/// The topics and parameters of which one call notifies nodes, each with the number of these nodes.
#[derive(Default)]
struct Tells {
    told: Vec<(Subject, usize)>,
    shuts_down: bool,
}

impl NoticeSink for Tells {
    fn publisher_update(&mut self, to: &[String], topic: &str, _: &[String]) {
        self.told.push((Subject::Topic(topic.to_owned()), to.len()));
    }

    fn param_update(&mut self, to: &[String], key: &str, _: &Value) {
        self.told.push((Subject::Param(key.to_owned()), to.len()));
    }

    fn shutdown(&mut self, _: &str, _: &str) {
        self.shuts_down = true;
    }
}
