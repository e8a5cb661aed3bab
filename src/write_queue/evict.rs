//! Unregisters a dead node before a call that would make the master shut down an innocent node: the call registers the
//! dead node's name at another address. The registering node is not asked first, because it cannot answer before its
//! registration is done.
//!
//! A call that registers another name at the port of a node proves nothing: anybody can register any address. Earlier,
//! `--reap all` unregistered the node at the port before such a call, also a living one.

use std::sync::Arc;

use rescue_core::health::Eviction;
use ros1_master::master::{Master, Request};

use super::batch::{Evicted, Item, MadeBy};
use crate::ledger::Ledger;

/// Judges calls that could make the master shut down an innocent node. By default, it objects to none.
pub(crate) trait MoveJudge: Send + Sync {
    /// The index of the first of `calls` that must be judged and sent alone.
    fn first_move(&self, _mirror: &Master, _calls: &[&Request]) -> Option<usize> {
        None
    }

    /// Judges a call. `None` if it moves no name. Otherwise the eviction that must precede the call,
    /// if there is one.
    fn judge_move(&self, _ledger: &Ledger, _call: &Request) -> Option<Option<Eviction>> {
        None
    }

    /// Notes that a node has registered something.
    fn note_registration(&self) {}
}

/// Objects to no call.
#[cfg(test)]
impl MoveJudge for () {}

/// The call that unregisters the nodes of `eviction`. `by` is the node that takes their port or name.
pub(super) fn unregistration(eviction: Eviction, by: String) -> Item {
    let evicted = Evicted {
        nodes: eviction.nodes,
        by,
    };
    Item::new(MadeBy::Eviction(evicted), Some(Arc::new(eviction.call))).0
}
