//! Calls of our own that are no longer right, because of what others did.

use super::batch::Item;
use crate::{
    ledger::{Ledger, activity::Activity},
    master::Master,
    xmlrpc::Call,
};

/// Whether a call of our own was right when it was made and is no longer: the node has come back at
/// another address, and would be shut down for it, or has done the contrary itself.
pub(super) fn is_outdated(ledger: &Ledger, item: &Item) -> bool {
    let condition = item.condition.as_ref();
    let is_false = condition.is_some_and(|of| {
        let last_calls = |_: &Master, activity: &mut Activity| activity.last_calls(&of.node);
        !of.holds(item.kind, ledger.with_activity(last_calls))
    });
    let own = item.call.as_deref().filter(|_| item.raw.is_none());
    is_false || own.is_some_and(|call| bumps(ledger, call))
}

/// Whether the master would shut a node down because of `call`, or of an entry of it.
fn bumps(ledger: &Ledger, call: &Call) -> bool {
    let entries = call.entries();
    ledger.with_mirror(|mirror| {
        let mut calls = entries.iter().chain([call]);
        calls.any(|call| mirror.displaced_by(call).is_some())
    })
}
