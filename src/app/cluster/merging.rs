//! Sends what was answered alone to the leader, as far as it still holds.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use bytes::Bytes;
use tokio::sync::watch;

use super::cut_off::Time;
use crate::{
    cluster::{
        merge::{self, Lost},
        way::Way,
    },
    master::{Master, Request, entry_reply, is_success},
    upstream::{Head, peer::Peers},
    write_queue::WriteQueue,
    xmlrpc::{self, Reply, Value},
};

/// Pause before calls that were not answered are sent again.
const AGAIN: Duration = Duration::from_millis(100);
/// Most calls, and about most bytes, of one multicall.
const CALLS_MOST: usize = 200;
const BYTES_MOST: usize = 512 << 10;

/// How to reach the leader.
pub(super) struct Route {
    /// Who leads, also while calls of nodes wait.
    pub(super) leads: watch::Receiver<Way>,
    pub(super) peers: Arc<Peers>,
    /// If it is this computer.
    pub(super) write_queue: WriteQueue,
}

impl Route {
    /// The leader's answer to a multicall, however long that takes.
    async fn call(&mut self, calls: &[Request]) -> Reply {
        let call = Request::multicall(calls.iter().cloned());
        let body = Bytes::from(xmlrpc::encode_call(&call.clone().into()));
        loop {
            let now = self.leads.borrow().clone();
            let reply = match now {
                Way::Here { term: Some(_) } => self.write_queue.call_of_client(call.clone()).await,
                Way::Leader { uri, term } => {
                    let leader = self.peers.at(&uri);
                    let sent = leader.forward(term, &Head::default(), &body).await;
                    sent.ok()
                        .and_then(|raw| xmlrpc::decode_reply(&raw.body).ok())
                }
                Way::Here { term: None } | Way::Nobody { .. } => None,
            };
            match reply {
                Some(reply) => return reply,
                None => tokio::time::sleep(AGAIN).await,
            }
        }
    }
}

/// Sends what of a time alone still holds, in order. `now`: the state that the others have. Returns how many did
/// not hold.
pub(super) async fn send(time: Time, now: &Master, mut route: Route) -> u64 {
    let merged = merge::merge(&time.base, now, &time.calls);
    drop(time);
    let lost = merged.lost.len() as u64;
    say_lost(merged.lost);
    for calls in portions(&merged.send) {
        let reply = route.call(calls).await;
        let results = match &reply {
            Reply::Value(Value::Array(results)) => results.as_slice(),
            _ => &[],
        };
        for (nth, call) in calls.iter().enumerate() {
            let done = results.get(nth).and_then(entry_reply);
            if !done.is_some_and(|reply| is_success(&reply)) {
                tracing::warn!(
                    method = call.method().name(),
                    node = call.caller().unwrap_or_default(),
                    "a write that was answered while this computer was alone is refused by the leader"
                );
            }
        }
    }
    tracing::info!(
        sent = merged.send.len(),
        lost,
        "the writes of a time alone were sent to the leader"
    );
    lost
}

/// One line for each subject: a node may have written the same a thousand times.
fn say_lost(lost: Vec<Lost>) {
    let mut subjects: BTreeMap<_, u64> = BTreeMap::new();
    for Lost { call, why } in lost {
        let node = call.caller().unwrap_or_default().to_owned();
        let method = call.method().name().to_owned();
        *subjects.entry((why, method, node)).or_default() += 1;
    }
    for ((why, method, node), count) in subjects {
        tracing::warn!(
            method,
            node,
            count,
            "what was written while this computer was alone does not hold: {why}"
        );
    }
}

/// Parts of the calls, each for one multicall.
fn portions(mut calls: &[Request]) -> impl Iterator<Item = &[Request]> {
    std::iter::from_fn(move || {
        let (mut count, mut bytes) = (0, 0);
        for call in calls.iter().take(CALLS_MOST) {
            bytes += call.params().iter().map(Value::size).sum::<usize>();
            if count > 0 && bytes > BYTES_MOST {
                break;
            }
            count += 1;
        }
        let (portion, rest) = calls.split_at(count);
        calls = rest;
        Some(portion).filter(|portion| !portion.is_empty())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::Method;

    #[test]
    fn calls_go_in_portions_and_none_is_left_out() {
        let set = |value: &str| Request::new(Method::SetParam, ["/n", "/k", value]);
        let large = "x".repeat(BYTES_MOST);
        let mut calls = vec![set("1"); CALLS_MOST + 1];
        calls.extend([set(&large), set(&large), set("2")]);
        let portions: Vec<_> = portions(&calls).collect();
        assert_eq!(portions.concat(), calls);
        let lengths: Vec<_> = portions.iter().map(|portion| portion.len()).collect();
        assert_eq!(lengths, [CALLS_MOST, 1, 1, 1, 1]);
    }
}
