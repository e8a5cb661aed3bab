//! Records the calls and notifications of all nodes, and checks the promises against them.

use std::collections::HashMap;

use super::{
    etcd::{Etcd, Held, LogEntry},
    world::COMPUTERS,
};
use crate::{checkpoint::format::RecordContent, cluster::machine::Commit};
use ros1_master::{
    master::{Master, Method, Request},
    xmlrpc::Value,
};

/// How many parameters nodes write.
pub(super) const KEYS: usize = 4;

pub(super) fn key(number: usize) -> String {
    format!("/k{number}")
}

pub(super) fn node(computer: usize) -> String {
    format!("http://node{computer}:1/")
}

/// The state at the start: a node of each computer subscribes to each parameter.
pub(super) fn subscriptions() -> Master {
    let mut state = Master::default();
    for computer in 0..COMPUTERS {
        for number in 0..KEYS {
            let (caller, api, key) = (format!("/s{computer}"), node(computer), key(number));
            let params = [caller.as_str(), api.as_str(), key.as_str()];
            state.apply(&Request::new(Method::SubscribeParam, params));
        }
    }
    state
}

pub(super) fn value_of(state: &Master, number: usize) -> Option<i32> {
    state
        .params()
        .get(&key(number)[1..])
        .and_then(Value::as_int)
}

fn values_of(state: &Master) -> [Option<i32>; KEYS] {
    std::array::from_fn(|number| value_of(state, number))
}

/// A write of a node, and its fate.
#[derive(Clone, Debug)]
pub(super) struct Call {
    pub(super) computer: usize,
    pub(super) key: usize,
    pub(super) value: i32,
    pub(super) made: u64,
    /// When the write was answered first. The next field says by which computer.
    ran: Option<u64>,
    by: Option<usize>,
    /// When the node got the answer.
    heard: Option<u64>,
    /// Set if a computer that was cut off answered the write: how much of the log it held then.
    alone: Option<usize>,
    /// Whether the write was reported as lost.
    reported: bool,
    /// Whether a computer that was cut off answered the write, and its power failed before the disk had it.
    unsynced: bool,
    /// Whether the merge found that the write holds: it was made, or others had set the same value.
    held: bool,
    /// When leaders made the write for a computer that was cut off, and the length of the log then. A leader that loses
    /// leadership before the log has the write leaves that to the next one.
    merged: Vec<(u64, usize)>,
    /// The computers that have made the write, as a leader or in a merge, whether they answered it or not.
    made_by: Vec<usize>,
}

/// A read of a node.
#[derive(Clone, Copy, Debug)]
pub(super) struct Read {
    pub(super) computer: usize,
    pub(super) key: usize,
    pub(super) began: u64,
    pub(super) done: Option<u64>,
    pub(super) value: Option<i32>,
    pub(super) shows: Shows,
}

/// What an answer to a read may show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Shows {
    /// What the journal has.
    Agreed,
    /// The state of the leader of this term, whose journal lacked something.
    Early(u64),
    /// The state of a computer that was cut off. The read does not count.
    Alone,
}

impl Read {
    pub(super) fn new(computer: usize, key: usize, began: u64) -> Self {
        Self {
            computer,
            key,
            began,
            done: None,
            value: None,
            shows: Shows::Agreed,
        }
    }
}

#[derive(Debug, Default)]
pub(super) struct History {
    pub(super) calls: Vec<Call>,
    by_value: HashMap<(usize, usize, i32), usize>,
    pub(super) reads: Vec<Read>,
    /// The value of each parameter in the last notification to each computer's node.
    pub(super) told: [[Option<i32>; KEYS]; COMPUTERS],
    /// Each run of a write that was answered: the write, the computer and the moment.
    runs: Vec<(usize, usize, u64)>,
    /// When the nodes of a computer died.
    died: Vec<(usize, u64)>,
    /// When a computer did not read each change of the others, because it started or got a whole state.
    skipped: Vec<(usize, u64)>,
    /// The journals that began after etcd had lost data.
    pub(super) beginnings: Vec<Beginning>,
    pub(super) broken: Option<String>,
}

/// A new journal that began after etcd had lost data.
#[derive(Debug)]
pub(super) struct Beginning {
    /// The place of its first state in the log.
    pub(super) place: usize,
    /// Whether an older journal went on, with a leader that could not know of the loss.
    pub(super) is_unaware: bool,
    /// The values that the mirror of each computer had. `None` for a computer that could not say so in time, because it
    /// did not run or did not reach etcd.
    pub(super) knew: Vec<Option<[Option<i32>; KEYS]>>,
}

impl History {
    pub(super) fn breaks(&mut self, what: &str) {
        self.broken.get_or_insert_with(|| what.to_owned());
    }

    /// Records that a node writes. `again` chooses one of the values written before, counted from the last one, as the
    /// value.
    pub(super) fn write(
        &mut self,
        computer: usize,
        key: usize,
        now: u64,
        again: Option<u64>,
    ) -> usize {
        let number = self.calls.len();
        let before = again.and_then(|back| {
            let of_key = self.calls.iter().rev().filter(|call| call.key == key);
            let value = of_key.skip(back as usize).map(|call| call.value).next()?;
            let fresh = !self.by_value.contains_key(&(computer, key, value));
            fresh.then_some(value)
        });
        let value = before.unwrap_or(number as i32 + 1);
        self.by_value.insert((computer, key, value), number);
        self.calls.push(Call {
            computer,
            key,
            value,
            made: now,
            ran: None,
            by: None,
            heard: None,
            alone: None,
            reported: false,
            unsynced: false,
            held: false,
            merged: Vec::new(),
            made_by: Vec::new(),
        });
        number
    }

    pub(super) fn request(&self, call: usize) -> Request {
        let Call {
            computer,
            key: number,
            value,
            ..
        } = self.calls[call];
        let caller = format!("/w{computer}");
        let params = [
            caller.as_str().into(),
            key(number).as_str().into(),
            value.into(),
        ];
        Request::new(Method::SetParam, params as [Value; 3])
    }

    fn find(&self, params: &[Value]) -> Option<usize> {
        let computer = params.first()?.as_str()?.strip_prefix("/w")?.parse().ok()?;
        let key = params.get(1)?.as_str()?.strip_prefix("/k")?.parse().ok()?;
        self.by_value
            .get(&(computer, key, params.get(2)?.as_int()?))
            .copied()
    }

    fn of(&mut self, request: &Request) -> &mut Call {
        let call = self.find(request.params()).unwrap();
        &mut self.calls[call]
    }

    pub(super) fn reported(&mut self, call: &Request) {
        self.of(call).reported = true;
    }

    pub(super) fn note_held(&mut self, call: &Request) {
        self.of(call).held = true;
    }

    /// Whether the journal has the value of a write that was kept, or the write's fate is known.
    pub(super) fn is_settled(&self, call: &Request, etcd: &Etcd) -> bool {
        let Some(number) = self.find(call.params()) else {
            return true;
        };
        let call = &self.calls[number];
        let same = |of: &[Value]| {
            let of = self.find(of).map(|of| &self.calls[of]);
            of.is_some_and(|of| (of.key, of.value) == (call.key, call.value))
        };
        let in_log = etcd.log.iter().any(|entry| match &entry.held {
            Held::State(state) => value_of(state, call.key) == Some(call.value),
            Held::Records(records) => records.iter().any(|record| match &record.entry {
                RecordContent::Call { call, .. } => same(call.params()),
                _ => false,
            }),
            Held::Damaged => false,
        });
        in_log || call.reported || call.held || etcd.lost
    }

    /// Notes that the leader `by` has made `call` for the computer `from`.
    pub(super) fn merged(&mut self, (from, by): (usize, usize), call: &Request, at: (u64, usize)) {
        // A value that the merge sets again, to notify nodes, is no call of a node.
        let Some(number) = self.find(call.params()) else {
            return;
        };
        let call = &mut self.calls[number];
        call.made_by.push(by);
        // Only calls by nodes of `from` count. It answered other calls as a leader.
        if call.computer == from {
            call.merged.push(at);
        }
    }

    /// Notes that the computer `by` has made a write, and may answer it.
    pub(super) fn made(&mut self, call: usize, by: usize) {
        self.calls[call].made_by.push(by);
    }

    pub(super) fn answered(
        &mut self,
        by: usize,
        call: usize,
        now: u64,
        alone: Option<(u64, usize)>,
    ) {
        self.runs.push((call, by, now));
        let call = &mut self.calls[call];
        call.by.get_or_insert(by);
        call.ran.get_or_insert(now);
        if call.heard.is_none() {
            call.alone = alone.map(|(_, log)| log);
        }
    }

    /// Notes that the answer does not reach its node.
    pub(super) fn unheard(&mut self, call: usize) {
        let call = &mut self.calls[call];
        if call.heard.is_none() {
            call.alone = None;
        }
    }

    pub(super) fn is_heard(&self, call: usize) -> bool {
        self.calls[call].heard.is_some()
    }

    pub(super) fn note_answered(&mut self, call: usize, now: u64) {
        self.calls[call].heard.get_or_insert(now);
    }

    /// Notes that a computer's power has failed. Its disk holds what it had answered when it was `synced`.
    pub(super) fn loses_power(&mut self, computer: usize, synced: u64, now: u64) {
        let unsynced = |call: &Call| call.alone.is_some() && call.heard >= Some(synced);
        for call in &mut self.calls {
            call.unsynced |= call.computer == computer && unsynced(call);
        }
        self.forgets(computer, now);
    }

    /// Notes that the nodes of a computer have died, so what they were told no longer counts.
    pub(super) fn forgets(&mut self, computer: usize, now: u64) {
        self.died.push((computer, now));
    }

    /// Notes that a computer did not read each change of the others.
    pub(super) fn skips(&mut self, computer: usize, now: u64) {
        self.skipped.push((computer, now));
    }

    /// Checks all promises against the journal.
    pub(super) fn check(&self, etcd: &Etcd, commit: Commit) -> Result<(), String> {
        let places = Places::of(self, etcd);
        for key in 0..KEYS {
            self.check_last(key, &places, etcd, commit)?;
            let last = value_of(&etcd.state, key);
            for (computer, told) in self.told.iter().enumerate() {
                // Nobody is told that a value was lost with etcd.
                let is_gone = last.is_none() && self.beginnings.iter().any(|of| of.place > 0);
                if told[key] != last && !is_gone {
                    let told = told[key];
                    return Err(format!(
                        "the node of {computer} was told last that {key} is {told:?}, and it is {last:?}"
                    ));
                }
            }
        }
        self.check_merged(&places, etcd)?;
        self.check_reads(&places, etcd, commit)
    }

    /// Checks that the last value of a parameter is not older than a write that was answered.
    fn check_last(
        &self,
        key: usize,
        places: &Places,
        etcd: &Etcd,
        commit: Commit,
    ) -> Result<(), String> {
        let last = value_of(&etcd.state, key);
        let of_key = self.calls.iter().enumerate();
        let of_key = of_key.filter(|(_, call)| call.key == key);
        let same = of_key.clone().filter(|(_, call)| Some(call.value) == last);
        let last_made = same.clone().map(|(_, call)| call.made).max();
        let last_heard = same
            .clone()
            .map(|(_, call)| call.heard.unwrap_or(u64::MAX))
            .max();
        for (number, call) in of_key {
            let Some(heard) = call.heard.filter(|_| Some(call.value) != last) else {
                continue;
            };
            let superseded = self.calls.iter().enumerate().any(|(of, later)| {
                let own = later.computer == call.computer && of > number;
                // A leader that was cut off answered it after `call`, whichever computer forwarded it.
                let there = later.by == call.by && later.ran > call.ran;
                later.key == key && (own || there) && later.heard.is_some()
            });
            let recorded = !places.of[number].is_empty();
            // Another write of the same value in the log is as good.
            let in_log = recorded || places.of_value(self, key, Some(call.value)).is_some();
            let may_be_lost = commit == Commit::Interval && !recorded;
            let alone = call.alone.is_some();
            // Others had or set the same value, so this write was not sent, and nothing was lost when they replaced it.
            let equalled = call.alone.is_some_and(|cut| {
                let others = self.calls.iter().enumerate().any(|(of, other)| {
                    let same = (other.key, other.value) == (key, call.value) && of != number;
                    same && places.changed[of].iter().any(|at| *at >= cut * 1000)
                });
                let sent = !places.changed[number].is_empty();
                !sent && (others || places.value_at(key, cut * 1000) == Some(call.value))
            });
            let excused = call.reported || call.unsynced || superseded || equalled;
            // The last value may come from a computer that was cut off, and could not see this write.
            let mut last_ones = same.clone();
            let unseen = last_ones.any(|(last, _)| {
                let merge = self.merge_of(last, places);
                merge.is_some_and(|merge| self.changes_were_hidden(last, merge, places, etcd))
            });
            let mut in_journal = places.of[number].iter();
            let lost = in_journal.any(|at| self.is_lost_with_etcd(key, *at, places));
            let excused = match alone {
                _ if lost => true,
                true => excused || unseen && recorded,
                false => may_be_lost || unseen,
            };
            if excused {
                continue;
            }
            let older = last_heard.is_none_or(|of| of < call.made);
            if older {
                return Err(format!(
                    "{call:?}, heard at {heard}, is gone: {key} is {last:?}, written at {last_made:?} and answered at {last_heard:?}"
                ));
            }
            if alone && !in_log && !call.held && !etcd.lost {
                return Err(format!(
                    "{call:?} was answered alone, is in no journal and was not reported"
                ));
            }
        }
        Ok(())
    }

    /// Whether the write of `key` at this place of the log was lost with etcd's data, as no computer knew it or a later
    /// one that could say so when a new journal began.
    fn is_lost_with_etcd(&self, key: usize, place: usize, places: &Places) -> bool {
        // An older copy that went on unnoticed and the journal that was lost both have later writes. A new journal continues
        // one of them.
        let mut before = self.beginnings.iter();
        let is_branch = before.any(|of| of.is_unaware && of.place * 1000 <= place);
        self.beginnings.iter().any(|beginning| {
            let start = beginning.place * 1000;
            if place >= start || is_branch {
                return place < start;
            }
            // A value that was written several times may be the oldest of these, or come from a computer that was cut off.
            let is_older = |value: Option<i32>| {
                let first = places.first_before(self, key, value, start);
                let mut same = self
                    .calls
                    .iter()
                    .filter(|of| of.key == key && Some(of.value) == value);
                first.is_none_or(|first| first < place) || same.any(|of| of.alone.is_some())
            };
            let knew = beginning.knew.iter().flatten();
            is_older(places.value_at(key, start + 1))
                && knew.clone().all(|knew| is_older(knew[key]))
        })
    }

    /// Whether a computer that held the log before `cut` takes the record at `place` for one that it holds: an older journal
    /// went on with a leader that did not know of the loss, and gave out the same numbers again.
    fn is_overlooked(&self, place: usize, cut: usize, etcd: &Etcd) -> bool {
        let held = etcd.log[..cut].last().map_or(0, |entry| entry.seq);
        let mut branches = self.beginnings.iter().filter(|of| of.is_unaware);
        let is_branch = branches.any(|of| cut <= of.place && of.place * 1000 <= place);
        is_branch && etcd.log[place / 1000].seq_of(place % 1000) <= held
    }

    /// Whether a computer compared two states between `since` and `moment`, because it had not read each change of the
    /// others.
    fn compared(&self, computer: usize, since: u64, moment: u64) -> bool {
        let mut skipped = self.skipped.iter();
        skipped.any(|(of, at)| *of == computer && (since..=moment).contains(at))
    }

    /// When the merge made the write `number`, which a computer answered while it was cut off, and its place in the
    /// journal.
    fn merge_of(&self, number: usize, places: &Places) -> Option<(u64, usize)> {
        let merged = &self.calls[number].merged;
        let (_, first) = merged.first()?;
        let mut changed = places.changed[number].iter();
        let place = *changed.find(|at| **at >= first * 1000)?;
        let mut made = merged.iter().rev();
        let (moment, _) = made.find(|(_, log)| log * 1000 <= place)?;
        Some((*moment, place))
    }

    /// Whether the merge that made the write `number` may have missed the changes of others, because it compared two
    /// states. Those do not show that others set a value and set it back, nor that they set what this computer's nodes
    /// set, too, or what it answered as the leader before it was cut off.
    fn changes_were_hidden(
        &self,
        number: usize,
        (moment, place): (u64, usize),
        places: &Places,
        etcd: &Etcd,
    ) -> bool {
        let call = &self.calls[number];
        // With `interval`, a leader that could not write its journal any more answered it, before it noticed that.
        let led = || {
            etcd.log
                .partition_point(|entry| Some(entry.added) <= call.ran)
        };
        let cut = call.alone.unwrap_or_else(led);
        let before = places.value_at(call.key, place);
        let first = places.of_value(self, call.key, before);
        let back = first.is_some_and(|(first, _)| first < cut * 1000);
        let mut own = self.calls.iter();
        let own = own.any(|of| {
            let own = of.computer == call.computer || of.by == Some(call.computer);
            own && of.key == call.key && Some(of.value) == before
        });
        (back || own) && self.compared(call.computer, etcd.added(cut), moment)
    }

    /// Checks that no write made while cut off has replaced a write that others made meanwhile.
    fn check_merged(&self, places: &Places, etcd: &Etcd) -> Result<(), String> {
        for (number, call) in self.calls.iter().enumerate() {
            let (Some(cut), Some(merge)) = (call.alone, self.merge_of(number, places)) else {
                continue;
            };
            if self.changes_were_hidden(number, merge, places, etcd) {
                continue;
            }
            let (_, merged) = merge;
            for (of, other) in self.calls.iter().enumerate() {
                let theirs = other.computer != call.computer && other.key == call.key;
                // Writes that this computer itself made came before it was cut off.
                let own = other.made_by.contains(&call.computer);
                let counts = other.heard.is_some() && other.alone.is_none() && !own;
                if !theirs || !counts || other.value == call.value {
                    continue;
                }
                let first = places.changed[of].first();
                let first = first.filter(|at| etcd.log[*at / 1000].writer != call.computer);
                let is_lost = |at: &usize| self.is_lost_with_etcd(other.key, *at, places);
                let first = first.filter(|at| !is_lost(at) && !self.is_overlooked(**at, cut, etcd));
                if first.is_some_and(|at| *at >= cut * 1000 && *at < merged) {
                    return Err(format!("{call:?} has replaced {other:?} of others"));
                }
            }
        }
        Ok(())
    }

    /// Checks that on one computer no read goes back in time, and that a node sees its own writes.
    fn check_reads(&self, places: &Places, etcd: &Etcd, commit: Commit) -> Result<(), String> {
        for computer in 0..COMPUTERS {
            for key in 0..KEYS {
                self.check_reads_of(computer, key, places, etcd, commit)?;
            }
        }
        Ok(())
    }

    fn check_reads_of(
        &self,
        computer: usize,
        key: usize,
        places: &Places,
        etcd: &Etcd,
        commit: Commit,
    ) -> Result<(), String> {
        // With `interval`, the journal may lack an answered write until its leader is back and sends it again.
        let brought_back = |call: &Call| commit == Commit::Interval && call.held;
        let mut floors: Vec<Floor> = Vec::new();
        for (number, call) in self.calls.iter().enumerate() {
            if (call.computer, call.key) != (computer, key) || call.reported {
                continue;
            }
            let Some(heard) = call.heard else { continue };
            // A later write may have taken the place of this one when the writes were kept, and may be lost.
            // Until a restart, it may have counted as lost, and after it a comparison of states found no change.
            let revived = match (call.alone, call.merged.last()) {
                // The others' changes may be older than the partition.
                (Some(cut), Some((moment, _))) => {
                    let since = etcd.added(cut).min(heard);
                    self.compared(computer, since, *moment)
                }
                _ => false,
            };
            if call.alone.is_some() && !call.held || revived || brought_back(call) {
                continue;
            }
            // A value in a whole state may come from another call.
            let same = self.calls.iter();
            let same = same.filter(|of| (of.key, of.value) == (key, call.value));
            let in_state = places.of[number].first().filter(|_| same.count() == 1);
            // With `interval`, a leader may die before the journal has what it answered. The next one runs the call again.
            let first = places.changed[number].first().or(in_state);
            let first = first.filter(|first| {
                commit != Commit::Interval
                    || call.by == etcd.log.get(**first / 1000).map(|of| of.writer)
            });
            if let Some(first) = first {
                floors.push(Floor {
                    shown: heard,
                    since: heard,
                    early: false,
                    place: *first,
                    why: format!("{call:?}"),
                });
            }
        }
        let of = |read: &&Read| {
            (read.computer, read.key) == (computer, key) && read.shows != Shows::Alone
        };
        let reads = self
            .reads
            .iter()
            .filter(of)
            .filter(|read| read.done.is_some());
        let reads: Vec<_> = reads.collect();
        // A value that was lost and reported may come back when its node calls again.
        let lost = |value: Option<i32>| {
            let mut calls = self.calls.iter();
            calls.any(|call| {
                let same = call.key == key && Some(call.value) == value;
                same && (call.reported || brought_back(call))
            })
        };
        let several = |read: &&Read| {
            let same = self.calls.iter();
            let same = same.filter(|of| of.key == key && Some(of.value) == read.value);
            same.count() > 1
        };
        // The same value may also come from a write that is in no journal, or was answered while cut off. Then it is
        // unknown which write a read shows. A value in a whole state may come from another call.
        let in_vain = |read: &&Read| {
            let places_of = match several(read) {
                true => &places.changed,
                false => &places.of,
            };
            let mut calls = self.calls.iter().zip(places_of);
            calls.any(|(call, places)| {
                let same = call.key == key && Some(call.value) == read.value;
                let in_vain = places.is_empty() || call.alone.is_some();
                same && in_vain && Some(call.made) <= read.done
            })
        };
        let unknown = |read: &&Read| lost(read.value) || several(read) && in_vain(read);
        let counts = |read: &&&Read| !unknown(read);
        for read in reads.iter().filter(counts) {
            if let Some((first, _)) = places.of_value(self, key, read.value) {
                // What a leader showed early counts once the journal has it. If it was lost with the leader and made
                // again, it may have been gone in between.
                let entry = first / 1000;
                let done = read.done.unwrap();
                let since = done.max(etcd.log[entry].added);
                let of_other =
                    matches!(read.shows, Shows::Early(term) if term != etcd.log[entry].term);
                // The leader may have been deposed, and lead again since an older copy was restored.
                let is_back = self.beginnings.iter().any(|of| {
                    let place = of.place;
                    of.is_unaware && place <= entry && done < etcd.log[place].added
                });
                let lost = of_other || read.shows != Shows::Agreed && is_back;
                if !lost {
                    floors.push(Floor {
                        shown: done,
                        since,
                        early: read.shows != Shows::Agreed,
                        place: first,
                        why: format!("{read:?}"),
                    });
                }
            }
        }
        let counts = |read: &&Read| read.shows == Shows::Agreed && !in_vain(read);
        for read in reads.into_iter().filter(counts) {
            let Some((_, last)) = places.of_value(self, key, read.value) else {
                continue;
            };
            for floor in &floors {
                // The floor's write may have been shown before the journal had it, or by a leader that has started
                // again.
                let LogEntry { added, held, .. } = &etcd.log[floor.place / 1000];
                let early = *added >= read.began || matches!(held, Held::State(_));
                let mut restarts = self.skipped.iter();
                let between = |at: &u64| floor.shown <= *at && *at <= read.done.unwrap();
                let restarted = restarts.any(|(of, at)| *of == computer && between(at));
                // A process that starts does not know what an earlier one has shown before the journal had it.
                let interval = commit == Commit::Interval;
                if interval && (early || restarted) || floor.early && restarted {
                    continue;
                }
                // A write that was sent again runs again. With `interval`, the journal may lack the second run.
                let mut runs = self
                    .runs
                    .iter()
                    .map(|(call, by, at)| (&self.calls[*call], by, at));
                let again = runs.any(|(call, by, at)| {
                    let same = (call.key, Some(call.value), *by) == (key, read.value, computer);
                    same && between(at)
                });
                if interval && again {
                    continue;
                }
                let died = self
                    .died
                    .iter()
                    .any(|(of, at)| *of == computer && between(at));
                if floor.since < read.began
                    && last < floor.place
                    && !died
                    && !self.is_lost_with_etcd(key, floor.place, places)
                {
                    let Floor { place, why, .. } = floor;
                    return Err(format!("{read:?} is older than {why}: {last} < {place}"));
                }
            }
        }
        Ok(())
    }
}

/// What a node has seen. No read that begins later may be older.
struct Floor {
    shown: u64,
    /// From when on it counts.
    since: u64,
    /// Whether the journal lacked it when it was shown.
    early: bool,
    /// Its place in the log.
    place: usize,
    why: String,
}

/// The places of each write in the log. Each entry of the log has a thousand places.
struct Places {
    of: Vec<Vec<usize>>,
    /// The places without those in whole states, which hold earlier writes.
    changed: Vec<Vec<usize>>,
    /// The values of all parameters after each place, in order.
    values: Vec<(usize, [Option<i32>; KEYS])>,
}

impl Places {
    fn of(history: &History, etcd: &Etcd) -> Self {
        let mut of = vec![Vec::new(); history.calls.len()];
        let mut changed = of.clone();
        let (mut state, mut values) = (Master::default(), Vec::new());
        for (index, entry) in etcd.log.iter().enumerate() {
            let records = match &entry.held {
                Held::Records(records) => records,
                Held::Damaged => continue,
                Held::State(whole) => {
                    state = (**whole).clone();
                    values.push((index * 1000, values_of(&state)));
                    let made = history.calls.iter().enumerate();
                    let made = made.filter(|(_, call)| call.made < entry.added);
                    for (number, call) in made {
                        if value_of(&state, call.key) == Some(call.value) {
                            of[number].push(index * 1000);
                        }
                    }
                    continue;
                }
            };
            for (part, record) in records.iter().enumerate() {
                let RecordContent::Call { call, .. } = &record.entry else {
                    continue;
                };
                let place = index * 1000 + part;
                state.apply_telling(call, &mut ());
                values.push((place, values_of(&state)));
                if let Some(call) = history.find(call.params()) {
                    of[call].push(place);
                    changed[call].push(place);
                }
            }
        }
        Self {
            of,
            changed,
            values,
        }
    }

    /// The value of a parameter before `place`.
    fn value_at(&self, key: usize, place: usize) -> Option<i32> {
        let before = self.values.partition_point(|(at, _)| *at < place);
        self.values[..before].last().and_then(|(_, of)| of[key])
    }

    /// The first place of any write of this value, if it is before `end`.
    fn first_before(
        &self,
        history: &History,
        key: usize,
        value: Option<i32>,
        end: usize,
    ) -> Option<usize> {
        let calls = history.calls.iter().enumerate();
        let calls = calls.filter(|(_, call)| call.key == key && Some(call.value) == value);
        let places = calls.flat_map(|(call, _)| &self.of[call]);
        places.filter(|at| **at < end).min().copied()
    }

    /// The first and the last place of any write of this value. `None` if the log has no such write.
    fn of_value(
        &self,
        history: &History,
        key: usize,
        value: Option<i32>,
    ) -> Option<(usize, usize)> {
        let calls = history.calls.iter().enumerate();
        let calls = calls.filter(|(_, call)| call.key == key && Some(call.value) == value);
        let mut places: Vec<_> = calls.flat_map(|(call, _)| self.of[call].clone()).collect();
        places.sort_unstable();
        Some((*places.first()?, *places.last()?))
    }
}
