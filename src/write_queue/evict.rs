//! Unregisters a node when another node registers its port, with `--reap-dead-nodes`. The registering node is not asked
//! first, because it cannot answer before its registration is done.

use std::{sync::Arc, time::Instant};

use super::{
    batch::{self, Batch, CallAnswer, Item},
    drain::Drain,
    merge,
};
use crate::{
    health::{Eviction, first_taking},
    ledger::{Ledger, delivery::Delivery},
    master::Request,
};

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
        if !self.evicts {
            return items;
        }
        let Some(first) = items.first_mut() else {
            return items;
        };
        let mut length = 1;
        if first.raw.is_some() && !first.way_made {
            let ledger = &self.link.ledger;
            if let Some(call) = first.call.as_deref()
                && let Some(eviction) = eviction(ledger, call)
            {
                first.way_made = true;
                let by = call.caller().unwrap_or_default().to_owned();
                self.take_back(items);
                return vec![own(eviction, by)];
            }
            let taking = ledger.with_mirror(|mirror| {
                first_taking(mirror, items.iter().map_while(|item| item.call.as_deref()))
            });
            length = taking.unwrap_or(items.len()).max(1);
        }
        let rest = items.split_off(length);
        self.take_back(rest);
        items
    }
}

/// The eviction that must precede `call`, if there is one.
fn eviction(ledger: &Ledger, call: &Request) -> Option<Eviction> {
    ledger.with_mirror(|mirror| Eviction::before(mirror, call))
}

/// Unregisters the nodes whose port `call` takes, while the mirror answers in a master's place.
pub(super) fn while_standing_in(ledger: &Ledger, call: &Request) {
    if let Some(eviction) = eviction(ledger, call)
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
        "unregistered dead nodes: another node now uses their port"
    );
}
