//! Logs the events that the cluster's state machine reports.

use std::{collections::BTreeMap, time::Instant};

use rescue_core::{
    checkpoint::format::shown,
    cluster::{
        member::{Cause, News},
        merge::{parameter_of, wire::WriteOutcome},
    },
    hide::Hide,
};
use ros1_master::{master::Request, xmlrpc::Value};

use super::ClusterDriver;
use crate::{
    limit::{AlarmLimit, alarm, all_clear, rarely},
    status::report::{CUT_OFF, STARTED, TAKEN_OVER},
};

/// Limits the log lines that this computer is cut off, and that it is no longer.
static ALONE: AlarmLimit = AlarmLimit::new();

impl ClusterDriver {
    /// Logs an event.
    pub(super) fn log_news(&mut self, news: News) {
        match news {
            News::Alone { serves } => {
                self.facts.times_cut_off += 1;
                self.log_cut_off(serves);
            }
            News::NotAlone => {
                let role = self.member.role().as_str();
                all_clear!(info, ALONE, role, "no longer cut off");
            }
            News::Leads { before, released } => self.facts.taken_over(before, released),
            News::LeadsAgain => {
                tracing::warn!("this computer leads again, because etcd has answered");
            }
            News::Deposed => {
                tracing::warn!(
                    "this computer no longer leads, because another computer leads or may lead"
                );
            }
            News::EtcdLost => tracing::error!(
                "etcd has lost its data; the most recent state of a living computer will replace it"
            ),
            News::Lapsed => tracing::warn!(
                "etcd does not answer, so another computer may lead by now. This computer has killed its master, and \
                 its mirror answers"
            ),
            News::Suspect { uri, until } => {
                let name = &self.member.settings().name;
                let wait = until.saturating_duration_since(Instant::now());
                tracing::info!(
                    name,
                    uri,
                    "the cluster knows this computer's name at another address; the start waits up to {wait:.0?} to \
                     see whether another living computer has the name"
                );
            }
            News::TooLarge(error) => rarely!(
                error,
                error,
                "cannot write a change to etcd; the other computers do not get it"
            ),
            News::Merged { sent, lost } => {
                self.facts.lost_writes += lost;
                tracing::info!(
                    sent,
                    lost,
                    "sent the writes made while cut off to the leader"
                );
            }
        }
    }

    fn log_cut_off(&self, serves: bool) {
        let silent = self.trouble.report_silence(self.member.settings().ttl / 2);
        let own = &self.member.settings().id;
        let leader = self.member.view().leader.as_ref();
        let why = match (
            leader.filter(|of| !silent && of.id != *own),
            self.trouble.get(),
        ) {
            (Some(leader), _) => {
                let (name, uri) = (&leader.name, &leader.uri);
                format!("{name} leads but cannot be reached at {uri}")
            }
            (None, Some((_, why))) => format!("etcd: {why}"),
            (None, None) => "etcd answered too late".to_owned(),
        };
        alarm!(
            error,
            ALONE,
            why,
            serves,
            "ALONE: this computer is cut off from the others or from etcd's majority. With --alone serve, it answers \
             its own nodes and sends their writes to the leader later. With --alone refuse, writes wait. Repair the \
             network or etcd"
        );
    }
}

/// The reason for a master's start, for reports.
pub(super) fn cause(of: Cause) -> &'static str {
    match of {
        Cause::Started => STARTED,
        Cause::TakenOver => TAKEN_OVER,
        Cause::WasCutOff => CUT_OFF,
    }
}

/// Logs which partition writes are lost. Logs one line per parameter, topic or service,
/// because a node may have written the same one a thousand times.
pub(super) fn report(hide: &Hide, outcomes: Vec<(Request, WriteOutcome)>) {
    let mut subjects: BTreeMap<_, u64> = BTreeMap::new();
    let losses = outcomes.iter();
    for (call, outcome) in losses.filter(|(call, outcome)| outcome.is_loss_of(call)) {
        let node = call.caller().unwrap_or_default();
        let method = call.method().name();
        match outcome {
            WriteOutcome::Holds => {}
            WriteOutcome::Refused(text) => {
                tracing::warn!(
                    method,
                    node,
                    text,
                    "the leader refused a write made while this computer was cut off"
                );
            }
            WriteOutcome::Lost { why, present } => match parameter(call) {
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

/// A parameter's value for the log, hidden if necessary.
fn shown_value(hide: &Hide, key: &str, value: Option<&Value>) -> String {
    let text = |value| shown(&hide.mask(key, value));
    value.map_or_else(|| "(none)".to_owned(), text)
}

/// The parameter that `call` sets, and its value. `None` for a deletion.
fn parameter(call: &Request) -> Option<(String, Option<&Value>)> {
    Some((parameter_of(call)?, call.params().get(2)))
}
