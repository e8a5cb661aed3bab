//! What a master misses that was late with an answer: the mirror has answered for it meanwhile.

use std::time::Instant;

use super::{Inner, Ledger};
use crate::{
    master::{Master, NoticeSink, Request},
    order::{BySubject, Subject},
    replay::Token,
    xmlrpc::Value,
};

/// What a late master holds when it has answered.
pub(super) struct Behind {
    state: Master,
    /// So many of the pending writes it has run by then.
    ran: usize,
    /// Of what it may notify nodes because of what it was late with.
    tells: Vec<Subject>,
    answered: bool,
}

/// What a late master is given.
#[derive(Debug)]
pub(crate) enum CatchUp {
    /// Nothing.
    Nothing,
    /// It runs what it missed.
    Run(Box<Missed>),
}

/// What a late master missed.
#[derive(Debug)]
pub(crate) struct Missed {
    /// What it holds.
    pub(crate) behind: Master,
    pub(crate) writes: Vec<Request>,
    /// What it holds afterwards.
    pub(crate) mirror: Master,
    pub(crate) before: Token,
    pub(crate) token: Token,
}

impl Ledger {
    /// The mirror has answered what the present incarnation is late with, and nothing after it. `tells`: of what
    /// that may notify nodes.
    pub(crate) fn fall_behind(&self, tells: Vec<Subject>) {
        let mut inner = self.lock();
        inner.behind = Some(Behind {
            state: inner.mirror.clone(),
            ran: inner.pending.calls().len(),
            tells,
            answered: false,
        });
    }

    /// The present incarnation has answered what it was late with. It may notify nodes of it only now.
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

    /// What the present incarnation is given, which was late and has answered. The mirror is frozen until
    /// [`Self::end_injection`] or [`Self::serve`], and a new incarnation begins if anything is given.
    ///
    /// None if it must be examined: it has not answered, or a node would hear twice of a subject, and of the
    /// first time when it has long heard of the second, or a node would be shut down.
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

/// Of what the master notifies how many nodes when it runs `writes`. None if of anything more than once.
fn once(behind: &Behind, writes: &[Request]) -> Option<Vec<(Subject, usize)>> {
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

/// Of what one call notifies how many nodes.
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
