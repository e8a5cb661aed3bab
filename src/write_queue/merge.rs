//! Merges another computer's partition writes. Those that conflict with changes by other computers are left out at the last
//! moment, when no other call is on its way to the master.

use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use rescue_core::{
    checkpoint::format::Origin,
    cluster::{
        merge::{
            MergeVerdict,
            wire::{self, Ask},
        },
        sharing::Source,
    },
};
use ros1_master::{
    master::Request,
    xmlrpc::{Reply, Value},
};
use tokio::sync::oneshot;

use super::batch::{self, AnswerAndDelivery, Item, MadeBy};
use crate::{ledger::Ledger, upstream::Head};

/// Whether each write of an item conflicts with changes by other computers, as decided last.
#[derive(Clone, Debug, Default)]
pub(super) struct Verdicts(Arc<Mutex<Option<Vec<MergeVerdict>>>>);

impl Verdicts {
    fn set(&self, verdicts: Option<Vec<MergeVerdict>>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = verdicts;
    }

    /// The answer to the computer that sent the writes. `reply` is the master's reply to the writes that were made.
    pub(super) fn answer(&self, reply: &Reply) -> wire::MergeAnswer {
        match &*self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(verdicts) => wire::MergeAnswer::from_reply(verdicts, reply),
            None => wire::MergeAnswer::Again,
        }
    }
}

/// The writes to merge, and whether each of them conflicts with changes by other computers.
#[derive(Debug)]
pub(crate) struct Merge {
    ask: Ask,
    judged: Verdicts,
}

/// Makes an item for the write queue. `origin` is the computer that was cut off. Also returns the receiver of its answer, and a handle that shows which of its
/// writes conflict with changes by other computers.
pub(super) fn item(
    ask: Ask,
    origin: Origin,
) -> (Item, oneshot::Receiver<AnswerAndDelivery>, Verdicts) {
    let judged = Verdicts::default();
    let source = Source::Merge(ask.id.clone());
    let call = multicall(&ask.calls);
    let made_by = MadeBy::CutOff {
        request: request(&call),
        merge: Merge {
            ask,
            judged: judged.clone(),
        },
    };
    let (item, answered) = Item::new(made_by, Some(Arc::new(call)));
    (item.came_from(source, origin), answered, judged)
}

fn multicall<'a>(calls: impl IntoIterator<Item = &'a Request>) -> Request {
    Request::multicall(calls.into_iter().cloned())
}

fn request(call: &Request) -> (Head, Bytes) {
    (Head::default(), call.encode().into())
}

/// Leaves out writes that conflict with changes by other computers. If no write remains, answers the item and returns
/// `None`.
pub(super) fn leave_out_conflicts(ledger: &Ledger, mut item: Item) -> Option<Item> {
    let MadeBy::CutOff {
        request: sent,
        merge: Merge { ask, judged },
    } = &mut item.made_by
    else {
        return Some(item);
    };
    let calls: Vec<&Request> = ask.calls.iter().collect();
    let verdicts = ledger.merge_verdicts(ask.seq, &ask.id, &calls);
    let runs = verdicts.iter().flatten().zip(&ask.calls);
    let runs: Vec<_> = runs
        .filter(|(verdict, _)| **verdict == MergeVerdict::Apply)
        .map(|(_, call)| call)
        .collect();
    judged.set(verdicts);
    if runs.is_empty() {
        item.reply(batch::CallAnswer::Made(Reply::Value(Value::Nil)));
        return None;
    }
    let call = multicall(runs);
    *sent = request(&call);
    item.call = Some(Arc::new(call));
    Some(item)
}
