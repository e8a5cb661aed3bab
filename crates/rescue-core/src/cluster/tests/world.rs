//! The simulated computers, the network between them, and their failures. Times are in microseconds. The code here
//! carries out the members' actions, as `app::cluster` does.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    time::Duration,
};

use super::{
    computer::{Asker, Computer, Unanswered, uri},
    etcd::{Etcd, Sent},
    history::{Beginning, History, KEYS, Read, Shows, key, subscriptions, value_of},
};
use crate::{
    cluster::{
        journal::Progress,
        machine::{ANSWER_LIMIT, Commit, EtcdAnswer, Role, View, WhenAlone},
        member::{Action, ForwardedWrites, Input, News},
        merge::wire::{self, Ask, WriteOutcome},
        sharing::Source,
        standing::{AnsweredCalls, JournalPosition, Standing},
    },
    replay,
};
use ros1_master::{
    master::Notice,
    xmlrpc::{Reply, Value},
};
use test_support::dice::Dice;

mod calls;
mod faults;

pub(super) use faults::{Counts, ScheduleOptions};
use faults::{Fault, Network};

pub(super) const COMPUTERS: usize = 3;
pub(super) const MS: u64 = 1000;
/// How often a computer retries calls that wait.
const POLL: u64 = 40 * MS;
/// How long a master takes to start.
const MASTER_STARTS: u64 = 120 * MS;

#[derive(Debug)]
#[allow(clippy::large_enum_variant, reason = "a test")]
enum Event {
    Wake(usize),
    Poll(usize),
    Input(usize, u64, Input),
    /// A request reaches etcd. The flag is false if its sender no longer waits for the answer.
    Request(Box<Sent>, bool),
    Watch(usize, u64, View),
    Load(usize, u64, Progress, u64),
    /// A node of this computer makes a call.
    Client(usize),
    /// A call forwarded by the first computer reaches the second as the leader of a term.
    Forward(usize, usize, u64, usize),
    /// The answer to a call reaches the computer of its node.
    Done(usize, u64, usize, JournalPosition),
    /// A read forwarded by the first computer reaches the second.
    Ask(usize, u64, usize, u64, usize),
    /// The answer to a read arrives: the value, and whether the journal may lack it.
    Told(usize, u64, usize, (Option<i32>, Shows), JournalPosition),
    /// The leader has not answered a read in time.
    Late(usize, u64, usize),
    Merge(usize, u64, Option<usize>, u64, (u64, Ask)),
    Probe(usize, u64, usize, u64, u64),
    Put(usize, u64, (u64, u64), Vec<crate::cluster::journal::Put>),
    /// A node is notified of a parameter's value, by a computer or by its master.
    Notify {
        from: usize,
        master: Option<u64>,
        to: usize,
        key: usize,
        value: Option<i32>,
    },
    /// A master tries again to notify a node that it could not reach.
    Retry(usize, u64, usize),
    /// A computer notifies all nodes of the state, if it still records calls in the same period.
    TellAll(usize, u64, Option<u64>),
    Sync(usize),
    Fault,
    End(Fault),
}

/// Parameters and the values that a node is told.
type Told = VecDeque<(usize, Option<i32>)>;

pub(super) struct World {
    pub(super) plan: ScheduleOptions,
    pub(super) dice: Dice,
    pub(super) now: u64,
    order: u64,
    /// By their moment, and in the order in which they were added.
    events: BTreeMap<(u64, u64), Box<Event>>,
    pub(super) etcd: Etcd,
    network: Network,
    pub(super) computers: Vec<Computer>,
    pub(super) history: History,
    masters: u64,
    /// Notifications that a master could not deliver to a node, in order. A master sends each node one at a time.
    stuck: HashMap<(usize, u64, usize), Told>,
    /// When the last notification from one computer to another arrives.
    channels: [[u64; COMPUTERS]; COMPUTERS],
    /// Whether a computer must notify another one's node of the state when that node answers again.
    owed: [[bool; COMPUTERS]; COMPUTERS],
    /// The highest term in which a call was answered.
    term: u64,
    pub(super) counts: Counts,
    /// The only computer whose nodes write, if set.
    pub(super) writer: Option<usize>,
    /// Whether the nodes of each computer write a parameter that no others write.
    pub(super) is_apart: bool,
}

impl World {
    pub(super) fn new(plan: ScheduleOptions) -> Self {
        let mut dice = Dice(plan.seed);
        let computers = (0..COMPUTERS).map(|index| {
            let drift = dice.below(100_000) as i64 - 50_000;
            Computer::new(index, &plan, drift)
        });
        let mut world = Self {
            computers: computers.collect(),
            plan,
            dice,
            now: 0,
            order: 0,
            events: BTreeMap::new(),
            etcd: Etcd::new(),
            network: Network::default(),
            history: History::default(),
            masters: 0,
            stuck: HashMap::new(),
            channels: Default::default(),
            owed: Default::default(),
            term: 0,
            counts: Counts::default(),
            writer: None,
            is_apart: false,
        };
        for index in 0..COMPUTERS {
            let computer = &mut world.computers[index];
            computer.disk.own.state = subscriptions();
            computer.synced = computer.disk.clone();
            let plan = world.plan.clone();
            world.computers[index].start(index, &plan);
            let mut start = world.dice.below(30) * MS;
            if world.plan.twins && index == 1 {
                // Two namesakes that start together notice each other only when one of them leads.
                start += (1 + world.dice.below(5)) * 1000 * MS;
            }
            let life = world.computers[index].life;
            world.at(start, Event::Input(index, life, Input::Begin));
            world.at(start, Event::Poll(index));
            world.at(start, Event::Client(index));
            world.at(start, Event::Sync(index));
        }
        world.at(500 * MS, Event::Fault);
        world
    }

    fn at(&mut self, moment: u64, event: Event) {
        self.order += 1;
        let moment = moment.max(self.now);
        self.events.insert((moment, self.order), Box::new(event));
    }

    fn after(&mut self, delay: u64, event: Event) {
        self.at(self.now + delay, event);
    }

    fn trace(&self, text: impl FnOnce() -> String) {
        if self.plan.traced {
            println!("{:>9} us {}", self.now, text());
        }
    }

    pub(super) fn run(&mut self, time: Duration) {
        let end = self.now + time.as_micros() as u64;
        while self.history.broken.is_none() && self.step(end) {}
        self.now = end;
    }

    pub(super) fn step(&mut self, end: u64) -> bool {
        let next = self.events.first_entry();
        let Some(next) = next.filter(|next| next.key().0 <= end) else {
            return false;
        };
        let ((moment, order), event) = next.remove_entry();
        self.now = moment;
        let at = match &*event {
            Event::Wake(at)
            | Event::Poll(at)
            | Event::Input(at, ..)
            | Event::Watch(at, ..)
            | Event::Load(at, ..)
            | Event::Client(at)
            | Event::Forward(_, at, ..)
            | Event::Done(at, ..)
            | Event::Ask(_, _, at, ..)
            | Event::Told(at, ..)
            | Event::Late(at, ..)
            | Event::Merge(_, _, Some(at), ..)
            | Event::Merge(at, _, None, ..)
            | Event::Probe(_, _, at, ..)
            | Event::TellAll(at, _, None) => Some(*at),
            _ => None,
        };
        match at.map(|at| self.computers[at].hangs_until) {
            Some(until) if until > self.now => {
                // Events of a hanging computer keep their order.
                self.events.insert((until, order), event);
            }
            _ => self.happen(*event),
        }
        true
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Wake(at) => {
                if self.computers[at].up && self.computers[at].wake <= self.now {
                    self.input(at, Input::Wake);
                }
            }
            Event::Poll(at) => {
                self.after(POLL, Event::Poll(at));
                if self.computers[at].up {
                    self.poll(at);
                }
            }
            Event::Input(at, life, input) => {
                if self.lives(at, life) {
                    self.input(at, input);
                }
            }
            Event::Request(sent, awaited) => self.request(sent, awaited),
            Event::Watch(at, watch, view) => self.watched(at, watch, view),
            Event::Load(at, life, known, until) => self.load(at, life, known, until),
            Event::Client(at) => self.client(at),
            Event::Forward(from, to, term, call) => {
                let computer = &self.computers[to];
                // A caller that has the answer to an earlier attempt has closed the connection of a later one.
                if !computer.up || self.history.is_heard(call) || !self.network.joins(from, to) {
                    return;
                }
                if computer.standing.answers_others(term) {
                    self.run_call(to, call, from);
                    self.input_changes(to);
                } else if self.network.joins(to, from) {
                    self.refused(from, call);
                }
            }
            Event::Done(at, life, call, position) => {
                if self.lives(at, life) {
                    let computer = &mut self.computers[at];
                    computer.tell_of(position);
                    computer.answered.push((computer.told, call));
                    self.done(at, call);
                }
            }
            Event::Ask(from, life, to, term, read) => {
                let computer = &self.computers[to];
                if computer.up
                    && self.network.joins(from, to)
                    && computer.standing.answers_others(term)
                {
                    let value = self.value(to, self.history.reads[read].key);
                    let ledger = &computer.ledger;
                    let seq = JournalPosition::shown_seq(true, ledger.agreed, ledger.last());
                    let shows = self.shows(to);
                    let delay = self.delay();
                    let told = Event::Told(from, life, read, (value, shows), position(term, seq));
                    self.after(delay, told);
                }
            }
            Event::Told(at, life, read, (value, shows), position) => {
                // When the leader changes, the answer of the one before no longer counts.
                let follows = matches!(
                    self.computers[at].standing,
                    Standing::Follows { term, .. } if term == position.term
                );
                if self.lives(at, life) && self.history.reads[read].done.is_none() && follows {
                    self.computers[at].tell_of(position);
                    self.read_done(read, value, shows);
                }
            }
            Event::Late(at, life, read) => {
                if self.lives(at, life) && self.history.reads[read].done.is_none() {
                    self.read_late(at, life, read);
                }
            }
            Event::Merge(from, life, to, term, (number, ask)) => {
                self.merge((from, life, number), to, term, ask);
            }
            Event::Probe(from, life, to, term, number) => {
                let there = &self.computers[to];
                let leads = there.up
                    && self.network.joins(from, to)
                    && self.network.joins(to, from)
                    && there.standing.answers_others(term);
                let delay = self.delay();
                let input = Input::Probed { number, leads };
                self.after(delay, Event::Input(from, life, input));
            }
            Event::Put(at, life, (number, term), parts) => {
                let reaches = self.network.reaches_etcd(at);
                let leads = self.etcd.view().guard().leader == term;
                if reaches && leads {
                    self.etcd.put(parts);
                }
                let delay = self.delay();
                let leads = reaches.then_some(leads);
                let prepared = Input::Prepared { number, leads };
                self.after(delay, Event::Input(at, life, prepared));
            }
            Event::Notify {
                from,
                master,
                to,
                key,
                value,
            } => self.notify(from, master, to, key, value),
            Event::Retry(from, master, to) => self.retry(from, master, to),
            Event::TellAll(at, leadership, master) => {
                let computer = &self.computers[at];
                let present = computer.up && computer.ledger.leadership == leadership;
                if present && master.is_none_or(|of| computer.master == Some(of)) {
                    (0..COMPUTERS).for_each(|to| self.tell_state(at, to));
                }
            }
            Event::Sync(at) => {
                let pause = (50 + self.dice.below(400)) * MS;
                self.after(pause, Event::Sync(at));
                let computer = &mut self.computers[at];
                computer.synced = computer.disk.clone();
                computer.synced_at = self.now;
            }
            Event::Fault => self.fault(),
            Event::End(fault) => self.end(fault),
        }
    }

    pub(super) fn lives(&self, at: usize, life: u64) -> bool {
        self.computers[at].up && self.computers[at].life == life
    }

    /// Handles a request that may reach etcd.
    fn request(&mut self, sent: Box<Sent>, awaited: bool) {
        let (at, life, number) = (sent.from, sent.life, sent.number);
        let silence = |number| {
            let answer = EtcdAnswer::Silence;
            Event::Input(at, life, Input::Answer { number, answer })
        };
        // A connection that was open when etcd was replaced is closed.
        let is_outdated = !awaited && sent.sent_at < self.etcd.replaced_at;
        if is_outdated {
            return;
        }
        if !self.network.reaches_etcd(at) {
            if awaited && self.now < sent.until {
                // The client asks another endpoint.
                self.after(250 * MS, Event::Request(sent, true));
            } else if awaited {
                self.after(0, silence(number));
            }
            return;
        }
        let is_old = self.etcd.is_old && self.lives(at, life);
        let view = self.etcd.view();
        self.computers[at].reads(view, is_old);
        let before = self.etcd.view().clone();
        if !sent.parts.is_empty() {
            self.etcd.put(sent.parts.clone());
        }
        self.etcd.now = self.now;
        let begun = self.etcd.beginnings.len();
        let answer = self.etcd.run(&sent);
        if self.etcd.beginnings.len() > begun {
            self.note_beginning(at);
        }
        if *self.etcd.view() != before {
            self.show_watches();
        }
        if !awaited {
            return;
        }
        if self.plan.faults && self.dice.one_in(60) {
            // The answer is lost. Sometimes the sender is not told.
            if !self.dice.one_in(10) {
                self.after(50 * MS, silence(number));
            } else {
                self.disturbs(at, ANSWER_LIMIT.as_micros() as u64 + 1000 * MS);
            }
            return;
        }
        let delay = self.delay() + self.network.etcd_slow(self.now);
        let answer = Input::Answer { number, answer };
        self.after(delay, Event::Input(at, life, answer));
    }

    /// Notes what the computers held when `leader` began a new journal, or went on with an older one.
    fn note_beginning(&mut self, leader: usize) {
        let (place, is_unaware) = self.etcd.beginnings[self.etcd.beginnings.len() - 1];
        for (at, computer) in self.computers.iter_mut().enumerate() {
            computer.follows_lost |= is_unaware && at != leader;
        }
        let lost_at = self.etcd.lost_at;
        let patience = 3 * self.plan.ttl.as_micros() as u64 + 1000 * MS;
        let knew = self.computers.iter().map(|computer| {
            let until = computer.disturbed_until;
            let could_tell = until <= lost_at || until + patience <= self.now;
            let values = [0, 1, 2, 3].map(|key| value_of(&computer.ledger.mirror, key));
            (computer.up && could_tell && !is_unaware).then_some(values)
        });
        let beginning = Beginning {
            place,
            is_unaware,
            knew: knew.collect(),
        };
        self.trace(|| format!("a new journal begins: {beginning:?}"));
        self.history.beginnings.push(beginning);
    }

    /// Has each watch show the present state.
    fn show_watches(&mut self) {
        for at in 0..COMPUTERS {
            if self.computers[at].watching {
                self.show_watch(at);
            }
        }
    }

    fn show_watch(&mut self, at: usize) {
        let lag = self.lag();
        let view = self.etcd.view().clone();
        let computer = &mut self.computers[at];
        computer.watch_at = computer.watch_at.max(self.now + lag);
        let (moment, watch) = (computer.watch_at, computer.watch);
        self.at(moment, Event::Watch(at, watch, view));
    }

    fn watched(&mut self, at: usize, watch: u64, view: View) {
        let computer = &mut self.computers[at];
        if !computer.up || computer.watch != watch || !computer.watching {
            return;
        }
        if !self.network.reaches_etcd(at) {
            computer.watch += 1;
            return;
        }
        let revision = computer.watched;
        if self.etcd.view().revision < revision || view.revision > self.etcd.view().revision {
            // The watch waits for a later revision.
            return;
        }
        let entries = self.etcd.entries_after(revision, view.revision);
        let Some(entries) = entries else {
            computer.watching = false;
            return self.input(at, Input::WatchEnded);
        };
        let members = self.etcd.member_entries(revision);
        let deleted = self.etcd.deleted(revision, view.revision);
        let leads = computer.member.role() == Role::Leading;
        if leads && deleted.is_some() && !self.etcd.is_readable() {
            computer.seen_unreadable = self.etcd.view().origin;
        }
        computer.watched = view.revision;
        let input = Input::Watched {
            view,
            entries,
            deleted,
            members,
        };
        self.input(at, input);
    }

    fn load(&mut self, at: usize, life: u64, known: Progress, until: u64) {
        if !self.lives(at, life) {
            return;
        }
        let read = match self.network.reaches_etcd(at) {
            true => {
                let computer = &mut self.computers[at];
                computer.reads(self.etcd.view(), self.etcd.is_old);
                computer.has_read = true;
                let read = self.etcd.read(known);
                if read.state.is_some() {
                    self.history.skips(at, self.now);
                }
                Some(read)
            }
            false if self.now < until => {
                return self.after(100 * MS, Event::Load(at, life, known, until));
            }
            false => None,
        };
        let delay = self.delay();
        self.after(delay, Event::Input(at, life, Input::Loaded(read)));
    }

    /// Passes new changes of the ledger to the member.
    fn input_changes(&mut self, at: usize) {
        let changes = match &mut self.computers[at].ledger.sharing {
            Some(sharing) => sharing.take(),
            None => return,
        };
        if !changes.is_empty() {
            self.input(at, Input::Recorded(changes));
        }
    }

    fn input(&mut self, at: usize, input: Input) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            let local = self.computers[at].local(self.now);
            let said = self.plan.traced.then(|| format!("{input:?}"));
            let computer = &mut self.computers[at];
            let actions = computer.member.on(local, input);
            computer.ledger.lease = computer.member.machine().lease(local);
            if let Some(mut said) = said
                && !actions.is_empty()
            {
                said.truncate(1500);
                let mut all = format!("{actions:?}");
                all.truncate(1500);
                self.trace(|| format!("{at}: {said} -> {all}"));
            }
            for action in actions {
                // Production carries out nothing after it.
                let ends = matches!(action, Action::End);
                self.act(at, action, &mut inputs);
                if ends {
                    return;
                }
            }
            let computer = &mut self.computers[at];
            computer.followed = computer.member.position();
            let follows = computer.member.view().origin == self.etcd.view().origin;
            computer.unaware &= self.etcd.is_old || !follows || computer.member.seq() == 0;
            let leader = computer.member.view().guard().leader;
            let is_current = leader == self.etcd.view().guard().leader
                && computer.member.seq() == self.etcd.seq();
            computer.follows_lost &= !is_current;
            computer.write_disk();
            if inputs.is_empty()
                && let Some(sharing) = &mut computer.ledger.sharing
            {
                let changes = sharing.take();
                if !changes.is_empty() {
                    inputs.push_back(Input::Recorded(changes));
                }
            }
        }
        let computer = &mut self.computers[at];
        if let Some(deadline) = computer.member.deadline().filter(|_| computer.up) {
            let moment = computer.moment(deadline).max(self.now);
            if computer.wake <= self.now || moment + 2 * MS < computer.wake {
                computer.wake = moment + self.dice.below(2 * MS);
                let wake = computer.wake;
                self.at(wake, Event::Wake(at));
            }
        }
    }

    fn act(&mut self, at: usize, action: Action, inputs: &mut VecDeque<Input>) {
        let life = self.computers[at].life;
        match action {
            Action::Send {
                number,
                op,
                entry,
                parts,
                requires,
                ..
            } => {
                let sent = Sent {
                    from: at,
                    life,
                    number,
                    settings: self.computers[at].member.settings().clone(),
                    op,
                    entry,
                    parts,
                    requires,
                    sent_at: self.now,
                    unaware: self.computers[at].unaware,
                    until: self.now + ANSWER_LIMIT.as_micros() as u64,
                };
                self.send(Box::new(sent));
            }
            Action::Load(known) => {
                let until = self.now + ANSWER_LIMIT.as_micros() as u64;
                let delay = self.delay();
                self.after(delay, Event::Load(at, life, known, until));
            }
            Action::Watch(view) => {
                let computer = &mut self.computers[at];
                computer.watch += 1;
                computer.watching = true;
                computer.watched = view.revision;
                if *self.etcd.view() != view {
                    self.show_watch(at);
                }
            }
            Action::Prepare {
                number,
                term,
                parts,
            } => {
                let delay = self.delay();
                self.after(delay, Event::Put(at, life, (number, term), parts));
            }
            Action::Decide { seq, .. } => {
                let delay = self.delay();
                let goes_on = true;
                let input = Input::Decided { seq, goes_on };
                self.after(delay, Event::Input(at, life, input));
            }
            Action::PublishStanding(standing) => self.set_standing(at, standing),
            Action::StopRecording { binds } => {
                for (_, asker, _) in self.computers[at].leave(binds) {
                    self.merge_answered(asker, at, None);
                }
                self.owed[at] = Default::default();
            }
            Action::StartRecording { seq, held, state } => {
                let computer = &mut self.computers[at];
                computer.ledger.lead(seq, &held, state);
                let leadership = computer.ledger.leadership;
                self.after(50 * MS, Event::TellAll(at, leadership, None));
            }
            Action::NotifyAll => (0..COMPUTERS).for_each(|to| self.tell_state(at, to)),
            Action::Follow(records) => {
                let computer = &mut self.computers[at];
                for record in &records {
                    if let crate::checkpoint::format::RecordContent::Call { call, .. } =
                        &record.entry
                    {
                        computer.ledger.mirror.apply_telling(call, &mut ());
                    }
                }
            }
            Action::FollowState { state, .. } => self.computers[at].follow_state(state),
            Action::Acknowledge(seq) => self.agree(at, seq),
            Action::TakeAsState => {
                let ledger = &mut self.computers[at].ledger;
                let mirror = &ledger.mirror;
                let state = ledger.sharing.as_mut().map(|of| of.take_as_state(mirror));
                inputs.push_front(Input::AsState(state));
            }
            Action::CollectForwarded { base } => {
                let computer = &mut self.computers[at];
                let followed = computer.member.position();
                computer
                    .answered
                    .retain(|(shown, _)| !followed.shows(*shown));
                let waiting = computer.waiting.iter().map(|(call, _)| call);
                let answered = computer.answered.iter().map(|(_, call)| call);
                let writes = ForwardedWrites {
                    unanswered: waiting.map(|of| self.history.request(*of)).collect(),
                    answered: answered.map(|of| self.history.request(*of)).collect(),
                };
                inputs.push_front(Input::Forwarded { base, writes });
            }
            Action::StoreTerm {
                term,
                journal_number,
                seq,
            } => {
                let computer = &mut self.computers[at];
                let own = &mut computer.disk.own;
                (own.term, own.journal_number) = (term, journal_number);
                if computer.ledger.sharing.is_none() {
                    own.seq = seq;
                }
            }
            Action::BeginMaster(_) => {
                self.masters += 1;
                let master = self.masters;
                let computer = &mut self.computers[at];
                computer.master = Some(master);
                let leadership = computer.ledger.leadership;
                self.after(MASTER_STARTS, Event::TellAll(at, leadership, Some(master)));
            }
            Action::EndMaster => {
                let computer = &mut self.computers[at];
                computer.master = None;
                let leadership = computer.ledger.leadership;
                self.after(50 * MS, Event::TellAll(at, leadership, None));
            }
            Action::NotifyOwnOnly(own_only) => self.computers[at].own_only = own_only,
            Action::ReplacePartitionWrites(writes) => {
                let computer = &mut self.computers[at];
                computer.disk.kept = Some(writes);
                computer.synced.kept = computer.disk.kept.clone();
            }
            Action::AddPartitionWrites(calls) => {
                if let Some(kept) = &mut self.computers[at].disk.kept {
                    kept.calls.extend(calls);
                }
            }
            Action::DeletePartitionWrites => self.forget_kept(at),
            Action::Merge { number, ask, to } => {
                let delay = self.delay();
                let (to, term) = match to {
                    None => (None, 0),
                    Some((to, term)) => ((0..COMPUTERS).find(|of| uri(*of) == to), term),
                };
                self.after(delay, Event::Merge(at, life, to, term, (number, ask)));
            }
            Action::Report(outcomes) => {
                for (call, outcome) in outcomes {
                    if !matches!(outcome, WriteOutcome::Holds) {
                        self.trace(|| format!("{at}: reports {call:?} {outcome:?}"));
                        self.counts.reported += 1;
                        self.history.reported(&call);
                    } else {
                        self.counts.merged += 1;
                        self.history.note_held(&call);
                    }
                }
            }
            Action::Probe {
                number,
                uri: to,
                term,
            } => {
                let delay = self.delay();
                let to = (0..COMPUTERS).find(|of| uri(*of) == to && *of != at);
                match to {
                    Some(to) => self.after(delay, Event::Probe(at, life, to, term, number)),
                    None => {
                        let leads = false;
                        let input = Input::Probed { number, leads };
                        self.after(delay, Event::Input(at, life, input));
                    }
                }
            }
            Action::PublishMemberEntry(entry) => {
                if self.network.reaches_etcd(at) {
                    let name = self.computers[at].name.clone();
                    self.etcd.put_member_entry(&name, entry);
                    self.show_watches();
                }
            }
            Action::WriteSnapshot { term, progress, .. } => {
                if self.etcd.view().guard().leader == term && self.network.reaches_etcd(at) {
                    self.etcd.compact();
                }
                let delay = self.delay();
                let written = Input::SnapshotWritten(Some((progress, 1000)));
                self.after(delay, Event::Input(at, life, written));
            }
            Action::Log(news) => match news {
                News::Alone { .. } => {
                    self.counts.alone += 1;
                    self.computers[at].times_alone += 1;
                }
                News::Leads { .. } => self.counts.leaderships += 1,
                // Reads may have shown data that etcd has lost.
                News::EtcdLost => self.etcd_is_lost(at),
                _ => {}
            },
            Action::EndRosout => {
                // Some take longer than a stop may.
                let most = if self.dice.one_in(8) { 6000 } else { 200 };
                let time = self.dice.below(most) * MS;
                self.after(time, Event::Input(at, life, Input::RosoutEnded));
            }
            Action::EndForNamesake(_) => {
                self.computers[at].refused = true;
                self.computers[at].up = false;
            }
            Action::End if self.computers[at].up => self.stopped(at),
            Action::End => {}
            Action::AnswerFromMirror
            | Action::AnswerNothing
            | Action::ShutDownDisplaced(_)
            | Action::CompactEtcd(_)
            | Action::HandedOver(_) => {}
        }
    }

    fn set_standing(&mut self, at: usize, standing: Standing) {
        let computer = &mut self.computers[at];
        if standing == Standing::Alone {
            computer.ledger.unanswered.retain(|of| of.origin == at);
            let begun = self.etcd.beginnings.last();
            let log = match begun.filter(|_| computer.follows_lost) {
                Some((place, _)) => *place,
                None => self.etcd.log.len(),
            };
            computer.cut = (computer.member.seq(), log);
        }
        computer.standing = standing;
        for (_, missed) in &mut computer.waiting {
            *missed = self.now;
        }
    }

    fn send(&mut self, sent: Box<Sent>) {
        let well = self.etcd.log.is_empty() || self.network.healed_for(self.now, 0);
        let wait = ANSWER_LIMIT.as_micros() as u64 + 1000 * MS;
        if self.plan.faults && !well && self.dice.one_in(400) {
            self.disturbs(sent.from, wait);
            // The request is lost, and its sender gets no error.
            return;
        }
        if self.plan.faults && self.dice.one_in(40) {
            // The request arrives late, or twice.
            let late = self.dice.below(3000) * MS;
            self.disturbs(sent.from, late);
            self.after(late, Event::Request(sent.clone(), false));
            if self.dice.one_in(2) {
                let (number, answer) = (sent.number, EtcdAnswer::Silence);
                let silence = Input::Answer { number, answer };
                self.after(50 * MS, Event::Input(sent.from, sent.life, silence));
                return;
            }
        }
        let delay = self.delay();
        self.after(delay, Event::Request(sent, true));
    }

    fn lag(&mut self) -> u64 {
        let lag = self.delay();
        if self.plan.faults && self.dice.one_in(50) {
            lag + self.dice.below(500) * MS
        } else {
            lag
        }
    }

    pub(super) fn leaders(&self) -> Vec<usize> {
        let leads = |at: &usize| {
            let computer = &self.computers[*at];
            computer.up && computer.member.role() == Role::Leading
        };
        (0..COMPUTERS).filter(leads).collect()
    }

    /// How long it takes until a computer other than `before` leads.
    pub(super) fn until_another_leads(&mut self, before: usize) -> Duration {
        let start = self.now;
        while self.leaders().iter().all(|leader| *leader == before) {
            let goes_on = self.step(start + 20_000 * MS);
            assert!(goes_on, "seed {}: nobody leads", self.plan.seed);
        }
        Duration::from_micros(self.now - start)
    }

    /// Checks what must be true some time after the last failure. Returns what is wrong if it is not.
    pub(super) fn verdict(&self) -> Result<(), String> {
        if let Some(why) = &self.history.broken {
            return Err(why.clone());
        }
        let leaders = self.leaders();
        if leaders.len() != 1 {
            return Err(format!("leaders {leaders:?}"));
        }
        for (at, computer) in self.computers.iter().enumerate() {
            if computer.refused {
                continue;
            }
            let role = computer.member.role();
            if !matches!(role, Role::Leading | Role::Following) {
                return Err(format!("{at} is {role:?}"));
            }
            if computer.member.seq() != self.etcd.seq() {
                let (seq, last) = (computer.member.seq(), self.etcd.seq());
                return Err(format!("{at} has followed to {seq} of {last}"));
            }
            if computer.ledger.mirror != self.etcd.state {
                let mut difference = replay::difference(&computer.ledger.mirror, &self.etcd.state);
                // A computer that held a record which an older copy lacks may keep it, if it does not see that the copy
                // went on. Other records have set the value since.
                if self
                    .etcd
                    .beginnings
                    .iter()
                    .any(|(_, is_unaware)| *is_unaware)
                {
                    difference.retain(|what| !what.ends_with("in another order"));
                }
                if !difference.is_empty() {
                    return Err(format!(
                        "the state of {at} is not that of the journal: {difference:?}"
                    ));
                }
            }
            if computer.member.uncommitted() > 0 || computer.member.partition_writes().is_some() {
                return Err(format!("{at} still owes writes"));
            }
            if !computer.waiting.is_empty() {
                return Err(format!("calls wait at {at}: {:?}", computer.waiting));
            }
        }
        if self.plan.twins {
            let refused = self.computers.iter().filter(|of| of.refused).count();
            if refused != 1 {
                return Err(format!("{refused} of two computers of one name have ended"));
            }
            return Ok(());
        }
        if !self.etcd.is_readable() || self.etcd.view().is_torn() {
            return Err("the journal cannot be read from its beginning".to_owned());
        }
        self.history.check(&self.etcd, self.plan.commit)
    }

    /// Panics if anything is wrong.
    pub(super) fn check(&self) {
        if let Err(why) = self.verdict() {
            panic!("seed {}: {why}", self.plan.seed);
        }
    }
}

fn position(term: u64, seq: u64) -> JournalPosition {
    let epoch = 0;
    JournalPosition {
        epoch,
        term,
        seq,
        ..JournalPosition::default()
    }
}
