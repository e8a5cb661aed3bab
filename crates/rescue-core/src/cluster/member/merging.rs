//! Sends the partition writes to the leader, except those that conflict with others' writes.

use std::{
    collections::BTreeSet,
    sync::Arc,
    time::{Duration, Instant},
};

use super::{Action, Member, News};
use crate::cluster::{
    machine::Role,
    merge::{
        self, Changes, TELLER, parameter_of, weight,
        wire::{self, Ask, WriteOutcome},
    },
    mutant::Mutant,
};
use ros1_master::{
    master::{Master, Method, Request, names},
    xmlrpc::Value,
};

/// Pause before a request that the leader did not answer is sent again.
const MERGE_AGAIN: Duration = Duration::from_millis(100);
/// How often the merge sets parameters again that others keep changing. The limit is low, because calls wait for the
/// end of the merge, and each change by others notifies the nodes, too.
const ROUNDS_MAX: u32 = 3;
/// The largest number of calls in one request to the leader ([`Ask`]). Other writes pass between two requests.
const CALLS_MOST: usize = 100;
/// The approximate size limit of one request to the leader ([`Ask`]), in bytes.
const BYTES_MOST: usize = 512 << 10;

#[derive(Debug, Default)]
enum Step {
    #[default]
    Idle,
    /// Waits until the journal has been read as it is now.
    Reading,
    /// Waits for the answer to this request, from the leader at this address and of this term, or from this computer.
    Asked(Ask, Option<(String, u64)>),
    /// Waits until this time, then sends this request again or, if there is none, decides again which of the remaining
    /// writes to send.
    Pause(Instant, Option<Ask>),
}

/// The state of sending the writes of the oldest partition to the leader.
#[derive(Debug)]
pub(super) struct Merging {
    /// The name under which this computer sends its partition writes. It is the same for all partitions:
    /// what an earlier partition has changed is older than the writes of a later one, and no conflict.
    id: Arc<str>,
    step: Step,
    /// The number of the last request to the leader. Answers to earlier ones are ignored.
    asked: u64,
    /// The writes still to be sent. `None` until it is decided which of them conflict with others' changes.
    unsent: Option<Vec<Request>>,
    /// Parameters of which nodes here heard a value that was lost. These nodes must hear the present value.
    untold: BTreeSet<String>,
    /// Whether the present request to the leader sets the parameters in [`Self::untold`] again, instead of sending
    /// writes.
    telling: bool,
    /// How often a request that sets parameters again failed, because others changed one of them meanwhile.
    rounds: u32,
    /// Whether the leader has answered a request since this computer last read the journal. The mirror then lacks the
    /// writes of that request.
    unread: bool,
    /// The writes in `unsent` conflict with no change up to this record of the journal.
    judged_up_to: u64,
    sent: u64,
    lost_count: u64,
}

impl Merging {
    pub(super) fn new(id: Arc<str>) -> Self {
        Self {
            id,
            step: Step::Idle,
            asked: 0,
            unsent: None,
            untold: BTreeSet::new(),
            telling: false,
            rounds: 0,
            unread: false,
            judged_up_to: 0,
            sent: 0,
            lost_count: 0,
        }
    }

    pub(super) fn due(&self) -> Option<Instant> {
        match self.step {
            Step::Pause(until, _) => Some(until),
            _ => None,
        }
    }
}

impl Member {
    /// The leader that takes partition writes: its address and term, or `Some(None)` for this computer.
    /// `None` if no leader is known.
    fn merges_to(&self) -> Option<Option<(String, u64)>> {
        match self.machine.role() {
            Role::Following if self.data_loss.since().is_some() => None,
            Role::Following if self.reading.wanted.is_none() && self.reading.loaded => {
                let (uri, term) = self.leader()?;
                Some(Some((uri.to_owned(), term)))
            }
            Role::Leading if self.records() => Some(None),
            _ => None,
        }
    }

    pub(super) fn update_merge(&mut self, now: Instant) {
        let to = self.merges_to();
        match &mut self.merging.step {
            Step::Idle => {
                if to.is_some() && !self.cut_off.is_empty() {
                    self.find_conflicts_again(now);
                }
            }
            Step::Reading => {
                if self.reading.is_fresh() {
                    self.find_conflicts(now);
                }
            }
            Step::Asked(ask, asked) => {
                // A leader that is gone never answers.
                if to.is_some_and(|to| to != *asked) {
                    self.merging.step = Step::Pause(now + MERGE_AGAIN, Some(ask.clone()));
                }
            }
            Step::Pause(until, ask) => {
                if *until <= now {
                    match ask.take() {
                        Some(ask) => self.ask(now, ask),
                        None if to.is_none() => *until = now + MERGE_AGAIN,
                        None => self.find_conflicts_again(now),
                    }
                }
            }
        }
    }

    /// Decides again which of the remaining writes to send, because the journal that they were judged by is lost.
    pub(super) fn restart_merge(&mut self, now: Instant) {
        if !matches!(self.merging.step, Step::Idle) {
            self.merging.step = Step::Pause(now + MERGE_AGAIN, None);
        }
    }

    /// Notes that these writes were kept. If the partition that they belong to is being merged already, they are sent with
    /// what is left of it.
    pub(super) fn also_send(&mut self, kept: &[Request]) {
        if let Some(unsent) = &mut self.merging.unsent
            && self.cut_off.is_last_partition()
        {
            unsent.extend_from_slice(kept);
        }
    }

    fn find_conflicts_again(&mut self, now: Instant) {
        self.merging.step = Step::Reading;
        self.reading.refresh(now);
    }

    /// Decides which of the remaining writes conflict with others' changes, up to the journal's last record.
    fn find_conflicts(&mut self, now: Instant) {
        let Some(partition) = self.cut_off.first_mut() else {
            self.merging.step = Step::Idle;
            return;
        };
        let left = self.merging.unsent.take();
        let left = left.unwrap_or_else(|| partition.pending.calls().cloned().collect());
        if Mutant::MergesByState.lives() {
            partition.changes = Changes::default();
            partition
                .changes
                .note_difference(&partition.base, &self.journal.state);
        }
        let merged = merge::merge(&partition.changes, &self.journal.state, &left);
        let parameters = merged.lost.iter();
        let parameters = parameters.filter_map(|lost| parameter_of(&lost.call));
        self.merging.untold.extend(parameters.chain(merged.equal));
        let lost = merged.lost.iter();
        let lost = lost.map(|lost| (lost.call.clone(), lost.into())).collect();
        self.merging.judged_up_to = self.journal.progress.seq;
        self.merging.unread = false;
        self.report(lost);
        self.keep_only(&merged.send);
        self.merging.unsent = Some(merged.send);
        self.next_portion(now);
    }

    /// Drops the oldest partition's other writes, which are lost or need not be sent, also from the file. After a restart
    /// this computer would not know why, and send them.
    fn keep_only(&mut self, writes: &[Request]) {
        let Some(partition) = self.cut_off.first_mut() else {
            return;
        };
        if partition.pending.len() > writes.len() {
            partition.pending = writes.iter().collect();
            if !self.chores.keeps_file() {
                self.store_all_writes();
            }
        }
    }

    fn next_portion(&mut self, now: Instant) {
        let untold = set_again(&self.journal.state, &self.merging.untold);
        let left = self.merging.unsent.as_deref().unwrap_or_default();
        self.merging.telling = left.is_empty();
        let left = if self.merging.telling { &untold } else { left };
        let calls: Vec<_> = left.iter().take(portion(left)).cloned().collect();
        if calls.is_empty() {
            match self.merging.unread {
                true => self.find_conflicts_again(now),
                false => self.finish_partition(now),
            }
            return;
        }
        let ask = Ask {
            id: self.merging.id.clone(),
            seq: self.merging.judged_up_to,
            calls,
        };
        self.ask(now, ask);
    }

    fn ask(&mut self, now: Instant, ask: Ask) {
        let Some(to) = self.merges_to() else {
            self.merging.step = Step::Pause(now + MERGE_AGAIN, Some(ask));
            return;
        };
        // Even without an answer, the journal may contain the calls, perhaps several times.
        self.cut_off.expect_in_all(&ask.calls);
        self.merging.step = Step::Asked(ask.clone(), to.clone());
        self.merging.asked += 1;
        let number = self.merging.asked;
        self.act(Action::Merge { number, ask, to });
    }

    /// Handles the answer to request `number` to the leader. `None` if the leader did not answer.
    pub(super) fn portion_answered(
        &mut self,
        now: Instant,
        number: u64,
        answer: Option<wire::MergeAnswer>,
    ) {
        let Step::Asked(ask, _) = &mut self.merging.step else {
            return;
        };
        if number != self.merging.asked {
            return;
        }
        let ask = ask.clone();
        match answer {
            None => self.merging.step = Step::Pause(now + MERGE_AGAIN, Some(ask)),
            Some(wire::MergeAnswer::Again) => {
                self.merging.step = Step::Pause(now + MERGE_AGAIN, None)
            }
            Some(wire::MergeAnswer::Done(outcomes)) => {
                self.merging.unread = true;
                if self.merging.telling {
                    return self.parameters_set_again(now, &ask, &outcomes);
                }
                if let Some(left) = &mut self.merging.unsent {
                    left.drain(..ask.calls.len().min(left.len()));
                }
                let lost_there = ask.calls.iter().zip(&outcomes);
                let lost_there =
                    lost_there.filter(|(_, of)| matches!(of, WriteOutcome::Lost { .. }));
                let lost_there = lost_there.filter_map(|(call, _)| parameter_of(call));
                self.merging.untold.extend(lost_there);
                self.report(ask.calls.into_iter().zip(outcomes).collect());
                self.next_portion(now);
            }
        }
    }

    /// Handles the answer to a request that set parameters again.
    fn parameters_set_again(&mut self, now: Instant, ask: &Ask, outcomes: &[WriteOutcome]) {
        let is_last = self.merging.rounds >= ROUNDS_MAX;
        let untold = &mut self.merging.untold;
        let before = untold.len();
        for (call, outcome) in ask.calls.iter().zip(outcomes) {
            // If others changed the parameter, nodes may have heard the new value before the lost one.
            if is_last || !matches!(outcome, WriteOutcome::Lost { .. }) {
                call.text(1).map(|key| untold.remove(key));
            }
        }
        match untold.len() + ask.calls.len() == before {
            true => self.next_portion(now),
            false => {
                self.merging.rounds += 1;
                self.merging.step = Step::Pause(now + MERGE_AGAIN, None);
            }
        }
    }

    fn report(&mut self, outcomes: Vec<(Request, WriteOutcome)>) {
        for (call, outcome) in &outcomes {
            self.merging.sent += u64::from(*outcome == WriteOutcome::Holds);
            self.merging.lost_count += u64::from(outcome.is_loss_of(call));
        }
        if !outcomes.is_empty() {
            self.act(Action::Report(outcomes));
        }
    }

    /// Finishes the oldest partition: the leader has made, or judged as lost, all its writes.
    pub(super) fn finish_partition(&mut self, now: Instant) {
        let (sent, lost) = (self.merging.sent, self.merging.lost_count);
        self.report_news(News::Merged { sent, lost });
        self.merging = Merging {
            asked: self.merging.asked,
            ..Merging::new(self.merging.id.clone())
        };
        self.cut_off.sent();
        self.chores.publish_entry_by(now);
        if !self.chores.keeps_file() {
            self.store_all_writes();
        }
        self.adopt();
        self.publish_leading();
        self.update_standing();
    }
}

/// Calls that set each of these parameters to its value in `state`, so that its subscribers are notified.
fn set_again(state: &Master, keys: &BTreeSet<String>) -> Vec<Request> {
    let values = keys.iter().filter_map(|key| {
        let parts: Vec<_> = names::parts(key).collect();
        Some((key, merge::value_at(state.params(), &parts)?))
    });
    let calls = values.map(|(key, value)| {
        let arguments = [Value::from(TELLER), key.as_str().into(), value.clone()];
        Request::new(Method::SetParam, arguments)
    });
    calls.collect()
}

/// How many of the calls fit into the next request to the leader.
fn portion(calls: &[Request]) -> usize {
    let (mut count, mut bytes) = (0, 0);
    for call in calls.iter().take(CALLS_MOST) {
        // The answer to a `subscribeParam` contains a value that the master may be unable to return.
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
