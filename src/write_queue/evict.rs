//! Unregisters a dead node before a call that would make the master shut down an innocent node: the call registers the
//! dead node's name at another address, or its port for another node. The registering node is not asked first, because
//! it cannot answer before its registration is done.

use std::{sync::Arc, time::Instant};

use super::batch::{CallAnswer, Item};
use crate::{
    checkpoint::format::Origin,
    health::Eviction,
    ledger::Ledger,
    master::{Master, Request},
};

/// Judges calls that could make the master shut down an innocent node. By default, it objects to none.
pub(crate) trait MoveJudge: Send + Sync {
    /// Whether a node is unregistered when another node registers its port.
    fn reaps_all(&self) -> bool {
        false
    }

    /// The index of the first of `calls` that must be judged and sent alone.
    fn first_apart(&self, _mirror: &Master, _calls: &[(&Request, Origin)]) -> Option<usize> {
        None
    }

    /// Judges a call. `None` if it moves no name and takes no port. Otherwise the eviction that must precede the call,
    /// if there is one.
    fn judge(
        &self,
        _ledger: &Ledger,
        _call: &Request,
        _origin: Origin,
    ) -> Option<Option<Eviction>> {
        None
    }

    /// Notes that a node has registered something.
    fn registered(&self) {}
}

/// Objects to no call.
#[cfg(test)]
impl MoveJudge for () {}

/// Unregisters the nodes whose port `call` takes, while the mirror answers in a master's place.
pub(super) fn while_standing_in(ledger: &Ledger, call: &Request, origin: Origin) {
    let from = origin.other_computer();
    let eviction = ledger.with_mirror(|mirror| Eviction::before(mirror, call, from));
    if let Some(eviction) = eviction
        && ledger.stand_in(Instant::now(), &eviction.call).is_some()
    {
        say(&eviction.nodes, call.caller().unwrap_or_default());
    }
}

/// The call that unregisters the nodes of `eviction`. `by` is the node that takes their port or name.
pub(super) fn unregistration(eviction: Eviction, by: String) -> Item {
    let (item, answered) = Item::new(None, Some(Arc::new(eviction.call)));
    crate::task::spawn(async move {
        if let Ok((CallAnswer::Raw(_) | CallAnswer::Made(_), _)) = answered.await {
            say(&eviction.nodes, &by);
        }
    });
    item
}

fn say(nodes: &[String], by: &str) {
    tracing::info!(
        ?nodes,
        by,
        "unregistered dead nodes: their ports or names belong to other nodes now"
    );
}
