//! Computers, the network between them, and what befalls them, in microseconds.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

use super::super::machine::{ANSWER_LIMIT, Action, Answer, Commit, Input, Op, Role};
use super::computer::{Computer, KEYS, RECORDS_MAX};
use super::etcd::{Etcd, Request, Write};

mod calls;
mod faults;

pub(super) use faults::{Counts, Plan};
use faults::{Fault, Network};

use crate::dice::Dice;

const COMPUTERS: usize = 3;
const MS: u64 = 1000;
/// How often a computer looks after what waits.
const POLL: u64 = 40 * MS;

#[derive(Clone, Debug)]
enum Event {
    Start(usize),
    Wake(usize),
    Poll(usize),
    Flush(usize),
    /// A request reaches etcd. None waits for its answer any more if it is late.
    Request(Request, bool),
    Answer(usize, u64, u64, Answer),
    Watch(usize, u64, super::super::machine::View, u64),
    Load(usize, u64),
    /// Whether the session goes on is decided.
    Decided(usize, u64),
    /// A node of this computer writes.
    Write(usize),
    /// A call of the first reaches the second.
    Forward(usize, usize, Write),
    /// The answer to a call reaches the computer of its node.
    Done(usize, Write),
    Fault,
    End(Fault),
}

/// What has become of a call.
#[derive(Clone, Copy, Debug, Default)]
struct Call {
    key: usize,
    made: u64,
    /// Answered by a leader,
    led: bool,
    /// or by a computer that was alone.
    alone: bool,
    reported: bool,
}

pub(super) struct World {
    plan: Plan,
    dice: Dice,
    now: u64,
    order: u64,
    events: BinaryHeap<Reverse<(u64, u64)>>,
    what: std::collections::HashMap<u64, Event>,
    etcd: Etcd,
    network: Network,
    computers: Vec<Computer>,
    calls: Vec<Call>,
    /// The highest term in which a call was answered.
    term: u64,
    pub(super) counts: Counts,
}

impl World {
    pub(super) fn new(plan: Plan) -> Self {
        let mut dice = Dice(plan.seed);
        let settings = (plan.commit, plan.alone, plan.ttl);
        let computers = (0..COMPUTERS).map(|index| {
            let drift = dice.below(100_000) as i64 - 50_000;
            Computer::new(index, &settings, drift)
        });
        let mut world = Self {
            computers: computers.collect(),
            plan,
            dice,
            now: 0,
            order: 0,
            events: BinaryHeap::new(),
            what: std::collections::HashMap::new(),
            etcd: Etcd::default(),
            network: Network::default(),
            calls: Vec::new(),
            term: 0,
            counts: Counts::default(),
        };
        for index in 0..COMPUTERS {
            let start = world.dice.below(30) * MS;
            world.at(start, Event::Start(index));
            world.at(start, Event::Poll(index));
            world.at(start, Event::Write(index));
        }
        world.at(500 * MS, Event::Fault);
        world
    }

    fn at(&mut self, moment: u64, event: Event) {
        self.order += 1;
        self.events
            .push(Reverse((moment.max(self.now), self.order)));
        self.what.insert(self.order, event);
    }

    fn after(&mut self, delay: u64, event: Event) {
        self.at(self.now + delay, event);
    }

    pub(super) fn run(&mut self, time: Duration) {
        let end = self.now + time.as_micros() as u64;
        while self.step(end) {}
        self.now = end;
    }

    fn step(&mut self, end: u64) -> bool {
        let Some(Reverse((moment, order))) = self.events.peek().copied() else {
            return false;
        };
        if moment > end {
            return false;
        }
        self.events.pop();
        self.now = moment;
        let event = self.what.remove(&order).unwrap();
        let at = match &event {
            Event::Start(at)
            | Event::Wake(at)
            | Event::Poll(at)
            | Event::Flush(at)
            | Event::Answer(at, ..)
            | Event::Watch(at, ..) => Some(*at),
            Event::Load(at, _)
            | Event::Decided(at, _)
            | Event::Write(at)
            | Event::Done(at, _)
            | Event::Forward(_, at, _) => Some(*at),
            Event::Request(..) | Event::Fault | Event::End(_) => None,
        };
        match at.map(|at| self.computers[at].hangs_until) {
            Some(until) if until > self.now => {
                // In their order.
                self.events.push(Reverse((until, order)));
                self.what.insert(order, event);
            }
            _ => self.happen(event),
        }
        true
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Start(at) => {
                let followed = self.computers[at].followed;
                self.input(at, Input::Start(followed));
            }
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
            Event::Flush(at) => {
                if self.computers[at].up {
                    self.flush(at);
                }
            }
            Event::Request(request, awaited) => self.request(request, awaited),
            Event::Answer(at, life, number, answer) => {
                if self.lives(at, life) {
                    self.input(at, Input::Answer { number, answer });
                }
            }
            Event::Watch(at, watch, view, seq) => {
                let computer = &self.computers[at];
                if computer.up && computer.watch == watch {
                    if !self.network.reaches_etcd(at) {
                        self.computers[at].watch += 1;
                        return;
                    }
                    self.loaded(at, seq);
                    self.input(at, Input::View(view));
                }
            }
            Event::Load(at, life) => {
                if !self.lives(at, life) {
                } else if self.network.reaches_etcd(at) {
                    self.loaded(at, self.etcd.journal.len() as u64);
                } else {
                    self.after(100 * MS, Event::Load(at, life));
                }
            }
            Event::Decided(at, life) => {
                if self.lives(at, life) {
                    let (seq, goes_on) = (self.computers[at].followed, true);
                    self.input(at, Input::Decided { seq, goes_on });
                }
            }
            Event::Write(at) => {
                let pause = self.dice.below(300) * MS;
                self.after(pause, Event::Write(at));
                if self.computers[at].up && !self.network.healed_for(self.now, 2_000 * MS) {
                    let key = self.dice.below(KEYS as u64) as usize;
                    self.calls.push(Call {
                        key,
                        made: self.now,
                        ..Call::default()
                    });
                    self.computers[at].waiting.push(self.calls.len() - 1);
                    self.flush(at);
                }
            }
            Event::Forward(from, to, write) => {
                let leads = self.computers[to].up && self.computers[to].role == Role::Leading;
                let takes = self.computers[to].machine.takes_writes();
                if leads && takes && self.network.joins(from, to) {
                    self.record(to, write, from);
                }
            }
            Event::Done(at, write) => self.done(at, write),
            Event::Fault => self.fault(),
            Event::End(fault) => self.end(fault),
        }
    }

    fn lives(&self, at: usize, life: u64) -> bool {
        self.computers[at].up && self.computers[at].life == life
    }

    /// A request reaches etcd, or does not.
    fn request(&mut self, request: Request, awaited: bool) {
        let (at, life, number) = (request.from, request.life, request.number);
        if !self.network.reaches_etcd(at) {
            if awaited && self.now < request.until {
                // The client asks another endpoint.
                self.after(250 * MS, Event::Request(request, true));
            } else if awaited {
                self.after(0, Event::Answer(at, life, number, Answer::Silence));
            }
            return;
        }
        let before = self.etcd.view().guard();
        let answer = self.etcd.run(&request);
        if self.etcd.changed_since(before) {
            for other in 0..COMPUTERS {
                let lag = self.lag();
                self.watch(other, lag);
            }
        }
        if !awaited {
            return;
        }
        if self.plan.faults && self.dice.one_in(60) {
            // The answer is lost.
            self.after(50 * MS, Event::Answer(at, life, number, Answer::Silence));
            return;
        }
        let delay = self.delay();
        self.after(delay, Event::Answer(at, life, number, answer));
    }

    /// The watch of a computer will show the present state.
    fn watch(&mut self, at: usize, lag: u64) {
        let (view, seq) = (self.etcd.view(), self.etcd.journal.len() as u64);
        let computer = &mut self.computers[at];
        computer.watch_at = computer.watch_at.max(self.now + lag);
        let (moment, watch) = (computer.watch_at, computer.watch);
        self.at(moment, Event::Watch(at, watch, view, seq));
    }

    /// The mirror of a computer that does not lead is brought to a record of the journal.
    fn loaded(&mut self, at: usize, seq: u64) {
        let computer = &mut self.computers[at];
        if matches!(computer.role, Role::Following | Role::CatchingUp) {
            let calls = &self.calls;
            computer.follow(&self.etcd.journal, seq, |write| calls[write].key);
            let followed = computer.followed;
            self.input(at, Input::Followed(followed));
        }
    }

    fn input(&mut self, at: usize, input: Input) {
        let local = self.computers[at].local(self.now);
        let said = self.plan.traced.then(|| format!("{input:?}"));
        let actions = self.computers[at].machine.on(local, input);
        if let Some(said) = said.filter(|said| !actions.is_empty() || !said.starts_with("Peer")) {
            println!("{:>9} us, {at}: {said} -> {actions:?}", self.now);
        }
        for action in actions {
            self.act(at, action);
        }
        self.settle(at);
        let computer = &mut self.computers[at];
        if let Some(deadline) = computer.machine.deadline() {
            let moment = computer.moment(deadline).max(self.now);
            if computer.wake <= self.now || moment + 2 * MS < computer.wake {
                computer.wake = moment + self.dice.below(2 * MS);
                let wake = computer.wake;
                self.at(wake, Event::Wake(at));
            }
        }
    }

    fn act(&mut self, at: usize, action: Action) {
        match action {
            Action::Send { number, op } => self.send(at, number, op),
            Action::CatchUp(_) => {
                let (delay, life) = (self.delay(), self.computers[at].life);
                self.after(delay, Event::Load(at, life));
            }
            Action::Become(role) => {
                self.computers[at].role = role;
                self.counts.alone += u64::from(role == Role::Alone);
                self.counts.reigns += u64::from(role == Role::Leading);
                self.after(0, Event::Flush(at));
                if role == Role::CatchingUp {
                    let (delay, life) = (self.delay(), self.computers[at].life);
                    self.after(delay, Event::Decided(at, life));
                }
            }
            Action::Acknowledge(seq) => self.acknowledge(at, seq),
            Action::Yield {
                committed,
                acknowledged,
            } => {
                self.settle(at);
                let computer = &mut self.computers[at];
                assert_eq!(computer.followed, committed, "seed {}", self.plan.seed);
                if self.plan.traced {
                    println!("{:>9} us, {at}: hands back {:?}", self.now, computer.own);
                }
                computer.hand_back((acknowledged - committed) as usize);
            }
            Action::Released => {}
        }
    }

    fn send(&mut self, at: usize, number: u64, op: Op) {
        self.settle(at);
        let computer = &self.computers[at];
        let mut records = Vec::new();
        if let Op::Beat { seq, .. } = &op {
            let most = if self.plan.faults {
                RECORDS_MAX
            } else {
                u64::MAX
            };
            let upto = seq.saturating_sub(computer.followed).min(most);
            records.extend(computer.own.iter().take(upto as usize).map(|own| own.write));
        }
        let (from, life) = (at, computer.life);
        let request = Request {
            from,
            life,
            number,
            op,
            records,
            until: self.now + ANSWER_LIMIT.as_micros() as u64,
        };
        if self.plan.faults && self.dice.one_in(40) {
            // It arrives late, or twice.
            let late = self.dice.below(3000) * MS;
            self.after(late, Event::Request(request.clone(), false));
            if self.dice.one_in(2) {
                let silence = Event::Answer(at, life, number, Answer::Silence);
                self.after(50 * MS, silence);
                return;
            }
        }
        let delay = self.delay();
        self.after(delay, Event::Request(request, true));
    }

    /// Whom a computer takes for the leader: one that says so itself.
    fn peer_of(&self, at: usize) -> Option<usize> {
        (0..COMPUTERS).find(|other| {
            let peer = &self.computers[*other];
            let leads = peer.up && peer.hangs_until <= self.now && peer.role == Role::Leading;
            let newer = peer.machine.term() > self.computers[at].machine.term();
            *other != at && leads && newer && self.network.joins(at, *other)
        })
    }

    fn poll(&mut self, at: usize) {
        let due = self.computers[at].watch_at < self.now && self.network.reaches_etcd(at);
        if due && self.computers[at].machine.view().revision < self.etcd.view().revision {
            // The watch is made anew.
            self.computers[at].watch += 1;
            let lag = self.lag();
            self.watch(at, lag);
        }
        if matches!(
            self.computers[at].role,
            Role::Following | Role::Alone | Role::Joining
        ) {
            let leads = self.peer_of(at).is_some();
            self.input(at, Input::Peer(leads));
        }
        self.flush(at);
    }

    /// The one delay of the network.
    fn delay(&mut self) -> u64 {
        let slow = self.network.slow(self.now);
        MS / 2 + self.dice.below(20 * MS) + slow
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
        let leads =
            |at: &usize| self.computers[*at].up && self.computers[*at].role == Role::Leading;
        (0..COMPUTERS).filter(leads).collect()
    }

    /// How long it takes until another one than `before` leads.
    pub(super) fn until_another_leads(&mut self, before: usize) -> Duration {
        let start = self.now;
        while self.leaders().iter().all(|leader| *leader == before) {
            assert!(
                self.step(start + 20_000 * MS),
                "seed {}: nobody leads",
                self.plan.seed
            );
        }
        Duration::from_micros(self.now - start)
    }

    /// What must be so some time after the last failure.
    pub(super) fn check(&self) {
        let seed = self.plan.seed;
        let leaders = self.leaders();
        assert_eq!(leaders.len(), 1, "seed {seed}: leaders {leaders:?}");
        let journal = &self.etcd.journal;
        for (at, computer) in self.computers.iter().enumerate() {
            let led = leaders.contains(&at) || computer.role == Role::Following;
            assert!(led, "seed {seed}: {at} is {:?}", computer.role);
            assert_eq!(computer.followed, journal.len() as u64, "seed {seed}: {at}");
            let state = |at: usize| self.computers[at].state(|write| self.calls[write].key);
            assert_eq!(state(at), state(leaders[0]), "seed {seed}: {at}");
            let left = (
                computer.own.len(),
                computer.pending.len(),
                computer.waiting.len(),
            );
            assert_eq!(left, (0, 0, 0), "seed {seed}: {at}");
        }
        let arrived: std::collections::HashSet<_> = journal.iter().copied().collect();
        for (write, call) in self.calls.iter().enumerate() {
            let known = arrived.contains(&write);
            let may_be_reported = call.alone || self.plan.commit == Commit::Interval;
            let lost = (call.led || call.alone) && !known && !(may_be_reported && call.reported);
            assert!(!lost, "seed {seed}: call {write} is lost: {call:?}");
        }
    }
}
