//! Writes of a computer that was alone: what others have changed meanwhile is left out at the last moment, when
//! nothing else is on its way to the master.

use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::oneshot;

use super::batch::{self, Answered, Item};
use crate::{
    cluster::merge::{
        Verdict,
        wire::{self, Ask},
    },
    ledger::{Ledger, Source},
    master::Request,
    upstream::Head,
    xmlrpc::{self, Reply, Value},
};

/// What becomes of the writes of an item, as it was judged last.
#[derive(Clone, Debug, Default)]
pub(super) struct Judged(Arc<Mutex<Option<Vec<Verdict>>>>);

impl Judged {
    fn set(&self, verdicts: Option<Vec<Verdict>>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = verdicts;
    }

    /// What is answered to who has asked, when the master has answered those that were made with `reply`.
    pub(super) fn answer(&self, reply: &Reply) -> wire::Answer {
        match &*self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(verdicts) => wire::Answer::of(verdicts, reply),
            None => wire::Answer::Again,
        }
    }
}

/// What is asked, and what was found.
#[derive(Debug)]
pub(crate) struct Merge {
    ask: Ask,
    judged: Judged,
}

/// An item for the queue, where its answer comes, and what is found.
pub(super) fn item(ask: Ask) -> (Item, oneshot::Receiver<Answered>, Judged) {
    let judged = Judged::default();
    let (mut item, answered) = Item::new(None, Some(Arc::new(multicall(&ask.calls))));
    item.source = Source::Merge(ask.id.clone());
    set_call(&mut item, multicall(&ask.calls));
    item.merge = Some(Merge {
        ask,
        judged: judged.clone(),
    });
    (item, answered, judged)
}

fn multicall<'a>(calls: impl IntoIterator<Item = &'a Request>) -> Request {
    Request::multicall(calls.into_iter().cloned())
}

fn set_call(item: &mut Item, call: Request) {
    let call = Arc::new(call);
    let body = xmlrpc::encode_call(&Request::clone(&call).into());
    item.raw = Some((Head::default(), body.into()));
    item.call = Some(call);
}

/// Leaves out what others have changed meanwhile. None if nothing is left, and it is answered.
pub(super) fn judged(ledger: &Ledger, mut item: Item) -> Option<Item> {
    let Some(Merge { ask, judged }) = &item.merge else {
        return Some(item);
    };
    let calls: Vec<&Request> = ask.calls.iter().collect();
    let verdicts = ledger.judge(ask.seq, &ask.id, &calls);
    let runs = verdicts.iter().flatten().zip(&ask.calls);
    let runs: Vec<_> = runs
        .filter(|(verdict, _)| **verdict == Verdict::Runs)
        .map(|(_, call)| call)
        .collect();
    judged.set(verdicts);
    if runs.is_empty() {
        item.reply(batch::Answer::Made(Reply::Value(Value::Nil)));
        return None;
    }
    let call = multicall(runs);
    set_call(&mut item, call);
    Some(item)
}
