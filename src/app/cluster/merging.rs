//! Sends what was answered alone to the leader, as far as it still holds.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use bytes::Bytes;
use tokio::sync::watch;

use super::{cut_off::Time, reading::Present};
use crate::{
    app::startup,
    checkpoint::format::shown,
    cluster::{
        merge::{
            self, Lost, weight,
            wire::{Answer, Ask, Outcome},
        },
        way::Way,
    },
    hide::Hide,
    master::{Method, Request, names},
    upstream::{Head, peer::Peers},
    write_queue::WriteQueue,
    xmlrpc::{self, Value},
};

/// Pause before calls that were not answered are sent again.
const AGAIN: Duration = Duration::from_millis(100);
/// Most calls, and about most bytes, of one portion. Other writes pass in between.
const CALLS_MOST: usize = 100;
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
    /// The leader's answer, however long that takes.
    async fn merge(&self, ask: &Ask) -> Answer {
        let mut plainly = false;
        loop {
            let now = self.leads.borrow().clone();
            let answer = match now {
                Way::Here { term: Some(_) } => self.write_queue.merge(ask.clone()).await,
                Way::Leader { uri, term } => {
                    let calls = ask.calls.iter().cloned();
                    let call = match plainly {
                        true => Request::multicall(calls),
                        false => ask.to_request(),
                    };
                    let body = Bytes::from(xmlrpc::encode_call(&call.into()));
                    let leader = self.peers.at(&uri);
                    let sent = leader.forward(term, &Head::default(), &body).await;
                    let reply = sent
                        .ok()
                        .and_then(|raw| xmlrpc::decode_reply(&raw.body).ok());
                    match reply {
                        Some(reply) if plainly => Some(Answer::of(
                            &vec![merge::Verdict::Runs; ask.calls.len()],
                            &reply,
                        )),
                        Some(reply) => {
                            let answer = Answer::read(&reply, ask.calls.len());
                            // An earlier version, which does not know what it is asked.
                            plainly = answer.is_none();
                            if plainly {
                                continue;
                            }
                            answer
                        }
                        None => None,
                    }
                }
                Way::Here { term: None } | Way::Nobody { .. } => None,
            };
            match answer {
                Some(answer) => return answer,
                None => {
                    plainly = false;
                    tokio::time::sleep(AGAIN).await;
                }
            }
        }
    }
}

/// Sends what of a time alone still holds, in order. `present`: the journal as far as it is in the time's changes.
/// Returns how many did not hold.
pub(super) async fn send(time: Time, mut present: Present, route: Route, hide: &Hide) -> u64 {
    let id: Arc<str> = startup::kernel_id("/proc/sys/kernel/random/uuid").into();
    let mut report = Report {
        hide,
        sent: 0,
        lost: 0,
    };
    let mut changes = time.changes;
    let mut left: Vec<Request> = time.pending.calls().cloned().collect();
    drop((time.base, time.pending));
    while !left.is_empty() {
        present.catch_up(&mut changes).await;
        let merged = merge::merge(&changes, &present.state, &left);
        report.lost(&merged.lost);
        left = merged.send;
        loop {
            let count = portion(&left);
            let calls: Vec<_> = left.iter().take(count).cloned().collect();
            if calls.is_empty() {
                break;
            }
            // If there is no answer, the journal may have them all the same.
            changes.expect(calls.iter().cloned());
            let ask = Ask {
                id: id.clone(),
                seq: present.seq(),
                calls,
            };
            match route.merge(&ask).await {
                Answer::Done(outcomes) => {
                    report.outcomes(&ask.calls, outcomes);
                    left.drain(..count);
                }
                Answer::Again => {
                    tokio::time::sleep(AGAIN).await;
                    break;
                }
            }
        }
    }
    tracing::info!(
        sent = report.sent,
        lost = report.lost,
        "sent the writes made while cut off to the leader"
    );
    report.lost
}

/// What is said of writes that do not hold.
struct Report<'a> {
    hide: &'a Hide,
    sent: u64,
    lost: u64,
}

impl Report<'_> {
    /// They conflict with what the journal has.
    fn lost(&mut self, lost: &[Lost]) {
        let lost = lost.iter();
        self.say(lost.map(|lost| (&lost.call, lost.into())));
    }

    /// The leader has answered `calls`.
    fn outcomes(&mut self, calls: &[Request], outcomes: Vec<Outcome>) {
        self.sent += outcomes.iter().filter(|of| **of == Outcome::Holds).count() as u64;
        self.say(calls.iter().zip(outcomes));
    }

    /// One line for each parameter, and for each other subject: a node may have written to it a thousand times.
    fn say<'a>(&mut self, outcomes: impl Iterator<Item = (&'a Request, Outcome)>) {
        let mut subjects: BTreeMap<_, u64> = BTreeMap::new();
        for (call, outcome) in outcomes {
            let node = call.caller().unwrap_or_default();
            let method = call.method().name();
            match outcome {
                Outcome::Holds => {}
                // It is not there any more: others have deleted it, too.
                Outcome::Refused(_) if *call.method() == Method::DeleteParam => {}
                Outcome::Refused(text) => {
                    self.lost += 1;
                    tracing::warn!(
                        method,
                        node,
                        text,
                        "the leader refused a write made while this computer was cut off"
                    );
                }
                Outcome::Lost { why, present } => {
                    self.lost += 1;
                    match parameter(call) {
                        Some((key, value)) => {
                            let alone = self.shown(&key, value);
                            let others = self.shown(&key, present.as_ref());
                            tracing::warn!(
                                method,
                                node,
                                %alone,
                                %others,
                                "a write made while this computer was cut off was lost: {why}"
                            );
                        }
                        None => {
                            *subjects
                                .entry((why, method.to_owned(), node.to_owned()))
                                .or_default() += 1;
                        }
                    }
                }
            }
        }
        for ((why, method, node), count) in subjects {
            tracing::warn!(
                method,
                node,
                count,
                "a write made while this computer was cut off was lost: {why}"
            );
        }
    }

    /// A parameter's value for people; hidden if it is one of those.
    fn shown(&self, key: &str, value: Option<&Value>) -> String {
        let shown_value = |value| shown(&self.hide.mask(key, value));
        value.map_or_else(|| "(none)".to_owned(), shown_value)
    }
}

/// The parameter that `call` sets, and to what; nothing if it deletes it.
fn parameter(call: &Request) -> Option<(String, Option<&Value>)> {
    let key = || Some(names::resolve(call.text(1)?, call.caller()?));
    match call.method() {
        Method::SetParam => Some((key()?, call.params().get(2))),
        Method::DeleteParam => Some((key()?, None)),
        _ => None,
    }
}

/// How many of the calls are the next portion.
fn portion(calls: &[Request]) -> usize {
    let (mut count, mut bytes) = (0, 0);
    for call in calls.iter().take(CALLS_MOST) {
        // Its answer holds a value that the master may not be able to write.
        let is_alone = *call.method() == Method::SubscribeParam;
        bytes += weight(call);
        if count > 0 && (is_alone || bytes > BYTES_MOST) {
            break;
        }
        count += 1;
        if is_alone {
            break;
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_go_in_portions_and_none_is_left_out() {
        let set = |value: &str| Request::new(Method::SetParam, ["/n", "/k", value]);
        let subscribe = Request::new(Method::SubscribeParam, ["/n", "http://n:1/", "/k"]);
        let large = "x".repeat(BYTES_MOST);
        let mut calls = vec![set("1"); CALLS_MOST + 1];
        calls.extend([set(&large), set(&large), set("2"), subscribe, set("3")]);
        let mut lengths = Vec::new();
        let mut left = calls.as_slice();
        while !left.is_empty() {
            let count = portion(left);
            lengths.push(count);
            left = &left[count..];
        }
        assert_eq!(lengths, [CALLS_MOST, 1, 1, 1, 1, 1, 1]);
    }
}
