//! What people are told.

use std::{collections::BTreeMap, time::Instant};

use super::ClusterDriver;
use crate::{
    checkpoint::format::shown,
    cluster::{
        member::{Cause, News},
        merge::wire::Outcome,
    },
    hide::Hide,
    limit::{Pair, alarm, all_clear, rarely},
    master::{Method, Request, names},
    status::report::{CUT_OFF, STARTED, TAKEN_OVER},
    xmlrpc::Value,
};

/// That this computer is cut off, and that it is not any more.
static ALONE: Pair = Pair::new();

impl ClusterDriver {
    /// Tells people.
    pub(super) fn tell(&mut self, news: News) {
        match news {
            News::Alone { serves } => self.tell_alone(serves),
            News::NotAlone => {
                let role = self.member.role().as_str();
                all_clear!(info, ALONE, role, "not alone any more");
            }
            News::Leads { before, released } => self.known.taken_over(before, released),
            News::LeadsAgain => {
                tracing::warn!("this computer leads again: etcd has answered");
            }
            News::Deposed => {
                tracing::warn!("this computer does not lead any more; another one does, or may");
            }
            News::EtcdLost => tracing::error!(
                "etcd has lost its data: the most recent state of a computer that lives takes its place"
            ),
            News::Lapsed => tracing::warn!(
                "etcd is silent, and another computer may lead by now: this one's master is ended, and its mirror answers"
            ),
            News::Suspect { uri, until } => {
                let name = &self.member.settings().name;
                let wait = until.saturating_duration_since(Instant::now());
                tracing::info!(
                    name,
                    uri,
                    "the cluster knows this computer's name at another address; the start waits up to {wait:.0?} to \
                     see whether another computer has it"
                );
            }
            News::TooLarge(error) => rarely!(
                error,
                error,
                "a change of the state cannot be given to the other computers; they go on without it"
            ),
            News::Merged { sent, lost } => {
                self.known.lost_writes += lost;
                tracing::info!(
                    sent,
                    lost,
                    "sent the writes made while cut off to the leader"
                );
            }
        }
    }

    fn tell_alone(&self, serves: bool) {
        let silent = self.trouble.is_silent(self.member.settings().ttl / 2);
        let own = &self.member.settings().id;
        let leader = self.member.view().leader.as_ref();
        let why = match (
            leader.filter(|of| !silent && of.id != *own),
            self.trouble.get(),
        ) {
            (Some(leader), _) => {
                let (name, uri) = (&leader.name, &leader.uri);
                format!("{name} leads, and cannot be reached at {uri}")
            }
            (None, Some((_, why))) => format!("etcd: {why}"),
            (None, None) => "etcd has answered too late".to_owned(),
        };
        alarm!(
            error,
            ALONE,
            why,
            serves,
            "ALONE: this computer is cut off from the others or from etcd's majority; with --alone serve its own \
             nodes are served and what they write is sent to the leader later, else writes wait. Repair the \
             network, or etcd"
        );
    }
}

/// Why a master is begun, in words.
pub(super) fn cause(of: Cause) -> &'static str {
    match of {
        Cause::Started => STARTED,
        Cause::TakenOver => TAKEN_OVER,
        Cause::WasCutOff => CUT_OFF,
    }
}

/// Says what does not hold of writes that were answered alone. One line for each parameter, and for each other subject: a node may have written to it a thousand times.
pub(super) fn report(hide: &Hide, outcomes: Vec<(Request, Outcome)>) {
    let mut subjects: BTreeMap<_, u64> = BTreeMap::new();
    for (call, outcome) in &outcomes {
        let node = call.caller().unwrap_or_default();
        let method = call.method().name();
        match outcome {
            Outcome::Holds => {}
            // It is not there any more: others have deleted it, too.
            Outcome::Refused(_) if *call.method() == Method::DeleteParam => {}
            Outcome::Refused(text) => {
                tracing::warn!(
                    method,
                    node,
                    text,
                    "the leader refused a write made while this computer was cut off"
                );
            }
            Outcome::Lost { why, present } => match parameter(call) {
                Some((key, value)) => {
                    let alone = shown_value(hide, &key, value);
                    let others = shown_value(hide, &key, present.as_ref());
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
            },
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
fn shown_value(hide: &Hide, key: &str, value: Option<&Value>) -> String {
    let text = |value| shown(&hide.mask(key, value));
    value.map_or_else(|| "(none)".to_owned(), text)
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
