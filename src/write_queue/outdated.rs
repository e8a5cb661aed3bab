//! Recognises calls by rosrescue that became wrong while they were queued.

use ros1_master::master::Master;

use super::batch::{Item, MadeBy};
use crate::ledger::{Ledger, activity::Activity};

/// Whether a call made by rosrescue is no longer right. It is outdated if its
/// [precondition](super::batch::Precondition) no longer holds, or if it would shut a node down that has registered at
/// another address meanwhile.
pub(super) fn is_outdated(ledger: &Ledger, item: &Item) -> bool {
    let condition = match &item.made_by {
        MadeBy::Rosrescue(condition) => condition.as_ref(),
        MadeBy::Eviction(_) => None,
        MadeBy::Client { .. } | MadeBy::CutOff { .. } => return false,
    };
    let Some(call) = item.call.as_deref() else {
        return false;
    };
    let is_false = condition.is_some_and(|of| {
        let last_calls = |_: &Master, activity: &mut Activity| activity.last_calls(&of.node);
        !of.holds(call.kind(), ledger.with_activity(last_calls))
    });
    let bumps = |mirror: &Master| {
        let mut calls = call.calls().into_iter();
        calls.any(|call| mirror.displaced_by(call).is_some())
    };
    is_false || ledger.with_mirror(bumps)
}
