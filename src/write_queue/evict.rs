//! Unregisters a dead node before a call that would make the master shut down an innocent node: the call registers the
//! dead node's name at another address, or its port for another node. The registering node is not asked first, because
//! it cannot answer before its registration is done.

use std::{sync::Arc, time::Instant};

use super::{
    batch::{self, Batch, CallAnswer, Item},
    drain::Drain,
    merge,
};
use crate::{
    health::Eviction,
    ledger::{Ledger, delivery::Delivery},
    master::{Master, Request},
};

/// Judges calls that could make the master shut down an innocent node. By default, it objects to none.
pub(crate) trait MoveJudge: Send + Sync {
    /// Whether a node is unregistered when another node registers its port.
    fn reaps_all(&self) -> bool {
        false
    }

    /// The index of the first of `calls` that must be judged and sent alone.
    fn first_apart(&self, _mirror: &Master, _calls: &[&Request]) -> Option<usize> {
        None
    }

    /// Judges a call. `None` if it moves no name and takes no port. Otherwise the eviction that must precede the call,
    /// if there is one.
    fn judge(&self, _ledger: &Ledger, _call: &Request) -> Option<Option<Eviction>> {
        None
    }

    /// Notes that a node has registered something.
    fn registered(&self) {}
}

/// Objects to no call.
#[cfg(test)]
impl MoveJudge for () {}

impl Drain {
    /// Takes the next batch. A call that registers the port of another node is the first of its batch. The eviction,
    /// which unregisters that node, goes before it.
    pub(super) fn pack(&mut self) -> Vec<Item> {
        let ledger = self.link.ledger.clone();
        let mut items = loop {
            let Batch { items, until } = ledger.with_order(|order, _| {
                let delivery = |number| Delivery::new(&ledger, number);
                batch::pack(&mut self.queue, order, Instant::now(), delivery)
            });
            self.held_until = until.map(Into::into);
            let any = !items.is_empty();
            let items: Vec<_> = items
                .into_iter()
                .filter_map(|item| merge::judged(&ledger, item))
                .collect();
            // If all these calls were answered without the master, the next ones are taken.
            if !any || !items.is_empty() {
                break items;
            }
        };
        let Some(first) = items.first_mut() else {
            return items;
        };
        let mut length = 1;
        if first.raw.is_some() && !first.way_made {
            if let Some(call) = first.call.as_deref()
                && let Some(eviction) = self.link.judge.judge(&ledger, call)
            {
                first.way_made = true;
                if let Some(eviction) = eviction {
                    let by = call.caller().unwrap_or_default().to_owned();
                    self.take_back(items);
                    return vec![own(eviction, by)];
                }
            } else {
                let calls = items.iter().map_while(|item| item.call.as_deref());
                let calls: Vec<_> = calls.collect();
                let judge = &self.link.judge;
                let apart = ledger.with_mirror(|mirror| judge.first_apart(mirror, &calls));
                length = apart.unwrap_or(items.len()).max(1);
            }
        }
        let rest = items.split_off(length);
        self.take_back(rest);
        items
    }
}

/// Unregisters the nodes whose port `call` takes, while the mirror answers in a master's place.
pub(super) fn while_standing_in(ledger: &Ledger, call: &Request) {
    let eviction = ledger.with_mirror(|mirror| Eviction::before(mirror, call));
    if let Some(eviction) = eviction
        && ledger.stand_in(Instant::now(), &eviction.call).is_some()
    {
        say(&eviction.nodes, call.caller().unwrap_or_default());
    }
}

fn own(eviction: Eviction, by: String) -> Item {
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
