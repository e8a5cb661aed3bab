//! Simulates at random the order in which nodes hear of changes. The ledger, the packing of batches
//! and the order of notifications are those of production. The master has notifier threads that are
//! sometimes late, and it dies. Nodes read answers and notifications in separate threads, as rospy
//! and roscpp do.
//!
//! More schedules: `ROSRESCUE_SCHEDULES=1000000 cargo test --release --lib write_queue::tests`. A
//! failure prints its seed.

mod node;

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BinaryHeap, HashMap, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use tokio::sync::oneshot;

use self::node::{Library, Node, Thread};
use super::batch::{AnswerAndDelivery, CallAnswer, Item, pack};
use crate::{
    checkpoint::format::Session,
    cli::SyncPolicy,
    clock,
    dice::Dice,
    health::port_of,
    ledger::{Ledger, delivery::Delivery, late::CatchUp},
    master::{Kind, Master, Notice, Request},
    order::{NextNotification, Order, Subject},
    status::stats::Stats,
    upstream::Head,
    xmlrpc::{Call, Reply, Value},
};

const NODES: u64 = 4;
const TOPICS: u64 = 3;
const PARAMS: u64 = 3;
const CALLS: u64 = 30;
/// How long a batch may wait for the master, in microseconds.
const PATIENCE: u64 = 100_000;
/// When notifications that a dead master may not have sent are sent, in microseconds.
const OWED_AFTER: u64 = 50_000;

/// A rule of the order that is left out, to show that the simulation notices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mutant {
    None,
    /// Nothing waits for anything, as before decision 31.
    NoOrder,
    /// No notification is repeated.
    NoRepeats,
}

#[derive(Debug)]
enum Event {
    /// The node's call reaches rosrescue.
    Arrives(usize, Request),
    /// The master with this number has run the batch, and its reply arrives.
    Replied(u64, Vec<Reply>),
    /// The batch with this number has waited for as long as the patience allows.
    Late(u64),
    /// The master runs these calls after it did nothing for a while.
    RunsLate(u64, Vec<Arc<Request>>),
    /// The answer to this call has been written.
    Written(u64),
    /// A thread of the node has read something.
    Heard(usize, Thread),
    /// The master's first notification to this port arrives.
    MasterNotifies(u64, String),
    /// The node has taken the master's notification.
    TakenFromMaster(u64, String),
    /// The node has taken rosrescue's notification with this number.
    Taken(String, u64),
    Dies,
    Revives,
    /// rosrescue sends the notifications that a master, which is still away, may not have sent.
    OwedInOutage,
    /// The master with this number, which was late, has been examined and gets the mirror's state.
    Examined(u64),
    /// rosrescue sends, after a recovery, the notifications that the dead master may not have sent.
    Owed,
    /// A deadline of the queue or of the notifications has passed.
    Tick,
}

/// A client's call that waits for its answer.
struct Waiting {
    node: usize,
    call: Request,
    answered: oneshot::Receiver<AnswerAndDelivery>,
}

/// An answer that has not been written.
struct Unwritten {
    node: usize,
    call: Request,
    reply: Reply,
    number: Option<u64>,
}

struct World {
    mutant: Mutant,
    dice: Dice,
    start: Instant,
    /// The time in microseconds.
    now: u64,
    events: BinaryHeap<Reverse<(u64, u64)>>,
    bodies: HashMap<u64, Event>,
    next: u64,
    ledger: Arc<Ledger>,
    queue: VecDeque<Item>,
    waiting: Vec<Waiting>,
    unwritten: HashMap<u64, Unwritten>,
    in_flight: Option<Vec<Item>>,
    /// Number of the last batch.
    batch: u64,
    /// Whether the mirror has answered the batch in flight.
    late: bool,
    /// Whether a master that was late is being examined, so that no calls pass to it.
    examined: bool,
    /// Until when the master does nothing.
    stopped: u64,
    /// The master. `None` while it is dead.
    master: Option<Master>,
    /// Number of the master.
    life: u64,
    incarnation: u64,
    caught_up: u64,
    /// The master's notifications, by port. The first one is on its way until the node has taken
    /// it.
    notices: BTreeMap<String, VecDeque<Notice>>,
    /// Ports that rosrescue notifies, and whether a notification is on its way.
    ports: BTreeMap<String, bool>,
    nodes: Vec<Node>,
    calls_left: u64,
    answers: u64,
    value: i32,
    /// Counts the values that parameters have had, and when each was last set.
    time: u64,
    values: HashMap<(String, Option<i32>), u64>,
}

impl World {
    fn new(seed: u64, mutant: Mutant, stats: &'static Stats) -> Self {
        let (session, sync) = (Session::default(), SyncPolicy::Interval);
        let ledger = Ledger::new(Master::default(), session, Vec::new(), None, sync, stats);
        ledger.succeed();
        let incarnation = ledger.serve();
        let mut dice = Dice(seed);
        let library = |dice: &mut Dice| match dice.one_in(2) {
            true => Library::Rospy,
            false => Library::Roscpp,
        };
        let nodes = (0..NODES).map(|number| Node::new(number, library(&mut dice)));
        let nodes = nodes.collect();
        let mut world = Self {
            mutant,
            dice,
            start: Instant::now(),
            now: 0,
            events: BinaryHeap::new(),
            bodies: HashMap::new(),
            next: 0,
            ledger: Arc::new(ledger),
            queue: VecDeque::new(),
            waiting: Vec::new(),
            unwritten: HashMap::new(),
            in_flight: None,
            batch: 0,
            late: false,
            examined: false,
            stopped: 0,
            master: Some(Master::default()),
            life: 0,
            incarnation,
            caught_up: 0,
            notices: BTreeMap::new(),
            ports: BTreeMap::new(),
            nodes,
            calls_left: CALLS,
            answers: 0,
            value: 0,
            time: 0,
            values: HashMap::new(),
        };
        for node in 0..world.nodes.len() {
            world.call(node);
        }
        if world.dice.one_in(2) {
            let death = world.dice.below(20_000);
            world.after(death, Event::Dies);
        }
        world
    }

    fn instant(&self) -> Instant {
        self.start + Duration::from_micros(self.now)
    }

    fn after(&mut self, time: u64, event: Event) {
        self.next += 1;
        self.bodies.insert(self.next, event);
        self.events.push(Reverse((self.now + time, self.next)));
    }

    fn at(&mut self, time: Instant) {
        let due = time.saturating_duration_since(self.start).as_micros();
        let due = u64::try_from(due).unwrap().saturating_sub(self.now);
        self.after(due + 1, Event::Tick);
    }

    /// How long a thread takes to run: mostly at once, sometimes when Python passes its lock on.
    fn scheduled(&mut self) -> u64 {
        match self.dice.below(20) {
            0 => self.dice.below(15_000),
            1..4 => self.dice.below(3_000),
            _ => 20 + self.dice.below(200),
        }
    }

    /// Makes the next call of a node whose last call has been answered.
    fn call(&mut self, node: usize) {
        if self.calls_left == 0 {
            return;
        }
        self.calls_left -= 1;
        self.value += 1;
        let Some(of) = self.nodes.get_mut(node) else {
            return;
        };
        let call = of.call(&mut self.dice, self.value);
        let pause = self.dice.below(1_500);
        self.after(pause, Event::Arrives(node, call));
    }

    fn arrives(&mut self, node: usize, call: Request) {
        if call.kind() == Kind::Read {
            let begun = match self.mutant {
                Mutant::NoOrder => Ok(None),
                _ => Delivery::of_read(&self.ledger, self.instant(), Some(&call)),
            };
            match begun {
                Ok(delivery) => {
                    let reply = self.ledger.answer(&call).unwrap();
                    self.answer(node, call, reply, delivery);
                }
                Err(_) => self.after(50, Event::Arrives(node, call)),
            }
            return;
        }
        let raw = Some((Head::default(), Bytes::new()));
        let (mut item, answered) = Item::new(raw, Some(Arc::new(call.clone())));
        if self.mutant == Mutant::NoOrder {
            item.forget_concern();
        }
        self.queue.push_back(item);
        self.waiting.push(Waiting {
            node,
            call,
            answered,
        });
    }

    /// Readies an answer, which its task writes as soon as the task runs.
    fn answer(&mut self, node: usize, call: Request, reply: Reply, delivery: Option<Delivery>) {
        let number = delivery.map(Delivery::into_number);
        self.answers += 1;
        let unwritten = Unwritten {
            node,
            call,
            reply,
            number,
        };
        self.unwritten.insert(self.answers, unwritten);
        // A busy computer, or a client that reads slowly.
        let late = self.dice.one_in(20).then(|| self.dice.below(100_000));
        let time = self.scheduled() + late.unwrap_or(0);
        self.after(time, Event::Written(self.answers));
    }

    fn end_answer(&self, number: u64) {
        let now = self.instant();
        self.ledger
            .with_order(|order, _| order.written(now, number));
    }

    /// Passes on what the write queue has answered.
    fn collect(&mut self) {
        let (mut done, mut waiting) = (Vec::new(), Vec::new());
        for mut call in std::mem::take(&mut self.waiting) {
            match call.answered.try_recv() {
                Ok((CallAnswer::Made(reply), delivery)) => done.push((call, reply, delivery)),
                Ok(other) => panic!("{other:?}"),
                Err(_) => waiting.push(call),
            }
        }
        self.waiting = waiting;
        for (Waiting { node, call, .. }, reply, delivery) in done {
            self.answer(node, call, reply, delivery);
        }
    }

    /// Sends the next batch, as `Drain::send` does.
    fn send(&mut self) {
        if self.in_flight.is_some() {
            return;
        }
        let (now, ledger) = (self.instant(), self.ledger.clone());
        let batch = ledger.with_order(|order, _| {
            let delivery = |number| Delivery::new(&ledger, number);
            let batch = pack(&mut self.queue, order, now, delivery);
            let tells = batch.items.iter().flat_map(|item| item.concern().tells());
            let answers = batch.items.iter().filter_map(|item| item.delivery.as_ref());
            order.sent(tells, answers.map(Delivery::number).collect());
            batch
        });
        if let Some(until) = batch.until {
            self.at(until);
        }
        if batch.items.is_empty() {
            return;
        }
        if self.master.is_none() {
            return;
        }
        let calls = batch.items.iter().map(|item| item.call.clone().unwrap());
        let calls: Vec<_> = calls.collect();
        self.in_flight = Some(batch.items);
        self.batch += 1;
        if self.dice.one_in(8) {
            // The master is stopped, or busy.
            let time = match self.dice.one_in(4) {
                true => self.dice.below(10 * PATIENCE),
                false => self.dice.below(2 * PATIENCE),
            };
            self.stopped = self.now + time;
            self.after(time, Event::RunsLate(self.life, calls));
            self.after(PATIENCE, Event::Late(self.batch));
            return;
        }
        let replies = self.run(&calls);
        calls.iter().for_each(|call| self.note_value(call));
        let time = 50 + self.dice.below(1_000);
        self.after(time, Event::Replied(self.life, replies));
    }

    /// Lets the master run `calls` and notify nodes.
    fn run(&mut self, calls: &[Arc<Request>]) -> Vec<Reply> {
        let Some(master) = &mut self.master else {
            return Vec::new();
        };
        let mut replies = Vec::new();
        for call in calls {
            let applied = master.apply(call);
            replies.push(applied.reply);
            for notice in applied.notices {
                let port = port_of(notice.to()).to_owned();
                let queue = self.notices.entry(port.clone()).or_default();
                queue.push_back(notice);
                if queue.len() == 1 {
                    let lead = 300 + self.dice.below(500);
                    let late = self.dice.one_in(10).then(|| self.dice.below(5_000));
                    let time = lead + late.unwrap_or(0);
                    self.next += 1;
                    let event = Event::MasterNotifies(self.life, port);
                    self.bodies.insert(self.next, event);
                    self.events.push(Reverse((self.now + time, self.next)));
                }
            }
        }
        replies
    }

    fn runs_late(&mut self, calls: &[Arc<Request>]) {
        let replies = self.run(calls);
        if !self.late {
            calls.iter().for_each(|call| self.note_value(call));
        }
        let time = 50 + self.dice.below(1_000);
        self.after(time, Event::Replied(self.life, replies));
    }

    /// Lets the mirror answer the batch in flight, as `Drain::stand_in_for_late` does.
    fn stand_in_for_late(&mut self) {
        self.late = true;
        let mut tells = Vec::new();
        for mut item in self.in_flight.replace(Vec::new()).into_iter().flatten() {
            if let Some(delivery) = item.delivery.take() {
                self.end_answer(delivery.into_number());
            }
            tells.extend_from_slice(item.concern().tells());
            self.answer_item(item);
        }
        self.ledger.fall_behind(self.instant(), tells);
    }

    /// The late master has answered, and gets the writes that it missed.
    fn catches_up(&mut self) {
        (self.in_flight, self.late) = (None, false);
        let now = self.instant();
        self.ledger.late_answered(now);
        self.ledger.release(Order::settled);
        match self.ledger.begin_catch_up(now) {
            Some(CatchUp::Nothing) => {}
            Some(CatchUp::Run(missed)) => {
                assert_eq!(self.master, Some(missed.behind));
                let writes: Vec<_> = missed.writes.into_iter().map(Arc::new).collect();
                self.run(&writes);
                assert_eq!(self.master, Some(missed.mirror));
                self.ledger.delivered();
                self.caught_up += 1;
            }
            // The master is examined and injected, and still sends the notifications that it had
            // begun.
            None => {
                self.examined = true;
                self.after(OWED_AFTER, Event::OwedInOutage);
                let time = self.dice.below(3 * PATIENCE);
                return self.after(time, Event::Examined(self.life));
            }
        }
        self.incarnation = self.ledger.serve();
    }

    fn replied(&mut self, replies: Vec<Reply>) {
        let Some(items) = self.in_flight.take() else {
            return;
        };
        let calls = items.iter().map(|item| item.call.clone().unwrap());
        let calls: Vec<_> = calls.collect();
        let answered: Vec<_> = calls.iter().map(|call| &**call).zip(&replies).collect();
        let now = self.instant();
        let recorded = self.ledger.record_here(now, self.incarnation, &answered);
        assert!(!recorded.unwrap().doubtful, "the model is the master here");
        for (item, reply) in items.into_iter().zip(replies) {
            item.reply(CallAnswer::Made(reply));
        }
        self.ledger.release(Order::settled);
    }

    /// Lets the mirror answer what is queued, as `Drain::stand_in` does.
    fn stand_in(&mut self) {
        for item in std::mem::take(&mut self.queue) {
            self.answer_item(item);
        }
        if !self.late {
            self.ledger.release(Order::settled);
        }
    }

    fn answer_item(&mut self, mut item: Item) {
        let call = item.call.clone().unwrap();
        let now = self.instant();
        let answer =
            self.ledger
                .stand_in_for(now, &call, item.concern(), &item.source, item.origin);
        let (reply, _, delivery) = answer.unwrap();
        item.delivery = delivery;
        item.reply(CallAnswer::Made(reply));
        self.note_value(&call);
    }

    /// Notes that a parameter has this value from now on.
    fn note_value(&mut self, call: &Request) {
        if let (Some(key), Some(value)) = (call.text(1), call.params().get(2)) {
            self.time += 1;
            self.values
                .insert((format!("{key}/"), value.as_int()), self.time);
        }
    }

    fn dies(&mut self) {
        self.master = None;
        (self.examined, self.stopped) = (false, 0);
        self.notices.clear();
        if std::mem::take(&mut self.late) {
            self.ledger.abandon_batch();
        }
        for mut item in self.in_flight.take().into_iter().flatten().rev() {
            if let Some(delivery) = item.delivery.take() {
                self.end_answer(delivery.into_number());
            }
            self.queue.push_front(item);
        }
        self.after(OWED_AFTER, Event::OwedInOutage);
        let outage = 1_000 + self.dice.below(150_000);
        self.after(outage, Event::Revives);
    }

    fn revives(&mut self) {
        self.ledger.with_order(|order, _| order.master_is_gone());
        self.is_injected();
    }

    fn is_injected(&mut self) {
        let basis = self.ledger.begin_injection();
        self.ledger.succeed();
        self.ledger.delivered();
        self.master = Some(basis.mirror);
        self.incarnation = self.ledger.serve();
        let checked = self.dice.below(20_000);
        self.after(checked, Event::Owed);
    }

    /// Sends owed notifications, as `nodes::notify_owed` does.
    fn owed(&mut self) {
        let now = self.instant();
        let owed = self
            .ledger
            .with_activity(|_, activity| activity.take_owed(now));
        self.ledger.with_order(|order, mirror| {
            for topic in owed.topics {
                for api in mirror.subscribers_of(&topic) {
                    order.tell_state(port_of(&api), Subject::Topic(topic.clone()));
                }
            }
            for (api, key) in owed.params {
                order.tell_state(port_of(&api), Subject::Param(key.to_string()));
            }
        });
    }

    /// Sends the notifications that are due, as `notifications::deliver` does.
    fn notify(&mut self) {
        let now = self.instant();
        let idle = self.ledger.with_order(|order, _| {
            if order.next_repeat().is_some_and(|at| at <= now) && self.mutant != Mutant::NoRepeats {
                order.repeat(now);
            }
            order.take_idle_ports()
        });
        self.ports
            .extend(idle.into_iter().map(|port| (port, false)));
        let ready = self.ports.iter().filter(|(_, sending)| !**sending);
        let ready: Vec<_> = ready.map(|(port, _)| port.clone()).collect();
        for port in ready {
            let next = self
                .ledger
                .with_order(|order, mirror| order.next(now, &port, mirror));
            match next {
                NextNotification::Send { call, number } => {
                    // The network is sometimes slow.
                    let late = self.dice.one_in(20).then(|| self.dice.below(60_000));
                    let time = self.tell(&call, &port, late.unwrap_or(0)) + 50;
                    self.ports.insert(port.clone(), true);
                    self.after(time, Event::Taken(port, number));
                }
                NextNotification::Wait { until } => {
                    if let Some(until) = until {
                        self.at(until);
                    }
                }
                NextNotification::Idle => {
                    self.ports.remove(&port);
                }
            }
        }
        if self.mutant != Mutant::NoRepeats
            && let Some(at) = self.ledger.with_order(|order, _| order.next_repeat())
        {
            self.at(at);
        }
    }

    /// A notification arrives at the node at `port`, and one of its threads reads it.
    fn tell(&mut self, call: &Call, port: &str, late: u64) -> u64 {
        let time = 100 + late + self.scheduled();
        let at = self.nodes.iter().position(|node| node.port() == port);
        if let Some(node) = at {
            self.nodes[node].arrives(call, &self.values);
            self.after(time, Event::Heard(node, Thread::Server(call.clone())));
        }
        time
    }

    fn is_master(&self, life: u64) -> bool {
        self.master.is_some() && self.life == life
    }

    fn step(&mut self, event: Event) {
        match event {
            Event::Arrives(node, call) => self.arrives(node, call),
            Event::Replied(of, _) if self.is_master(of) && self.late => self.catches_up(),
            Event::Replied(of, replies) if self.is_master(of) => self.replied(replies),
            Event::RunsLate(of, calls) if self.is_master(of) => self.runs_late(&calls),
            Event::Late(batch) if batch == self.batch && self.in_flight.is_some() => {
                self.stand_in_for_late();
            }
            Event::Written(number) => {
                let Unwritten {
                    node,
                    call,
                    reply,
                    number,
                } = self.unwritten.remove(&number).unwrap();
                number
                    .into_iter()
                    .for_each(|number| self.end_answer(number));
                let time = 30 + self.scheduled();
                self.after(time, Event::Heard(node, Thread::Main(call, reply)));
            }
            Event::Heard(node, thread) => {
                let answered = matches!(thread, Thread::Main(..));
                let again = self.nodes[node].hears(thread);
                match again {
                    Some(call) => self.after(20, Event::Arrives(node, call)),
                    None if answered => self.call(node),
                    None => {}
                }
            }
            Event::MasterNotifies(of, port) if self.is_master(of) && self.now < self.stopped => {
                let time = self.stopped - self.now + self.scheduled();
                self.after(time, Event::MasterNotifies(of, port));
            }
            Event::MasterNotifies(of, port) if self.is_master(of) => {
                let call = self.notices[&port].front().unwrap().call();
                let time = self.tell(&call, &port, 0);
                self.after(time + 50, Event::TakenFromMaster(of, port));
            }
            Event::TakenFromMaster(of, port) if self.is_master(of) => {
                let queue = self.notices.get_mut(&port).unwrap();
                queue.pop_front();
                if !queue.is_empty() {
                    let time = 100 + self.scheduled();
                    self.after(time, Event::MasterNotifies(of, port));
                }
            }
            Event::Taken(port, number) => {
                self.ledger.with_order(|order, _| order.taken(number));
                self.ports.insert(port, false);
            }
            Event::Dies => self.dies(),
            Event::Revives => {
                self.life += 1;
                self.revives();
            }
            Event::Examined(of) if self.is_master(of) => {
                self.examined = false;
                self.is_injected();
            }
            Event::OwedInOutage if self.master.is_none() || self.examined => {
                let now = self.instant();
                let again = self.ledger.with_order(|order, _| order.master_is_away(now));
                match again {
                    Some(at) => {
                        let wait = at.duration_since(now).as_micros();
                        self.after(u64::try_from(wait).unwrap() + 1, Event::OwedInOutage);
                    }
                    None => self.owed(),
                }
            }
            Event::Owed => self.owed(),
            Event::OwedInOutage
            | Event::Replied(..)
            | Event::RunsLate(..)
            | Event::Examined(..)
            | Event::Late(..)
            | Event::MasterNotifies(..)
            | Event::TakenFromMaster(..)
            | Event::Tick => {}
        }
        self.collect();
        match self.master {
            Some(_) if !self.late && !self.examined => self.send(),
            _ => self.stand_in(),
        }
        self.collect();
        self.notify();
    }

    /// Plays until all is quiet. Returns the nodes' false beliefs, and how often a late master was
    /// given only the writes that it missed.
    fn play(mut self) -> (Vec<String>, u64) {
        while let Some(Reverse((time, number))) = self.events.pop() {
            self.now = time;
            let event = self.bodies.remove(&number).unwrap();
            self.step(event);
        }
        assert!(
            self.waiting.is_empty() && self.queue.is_empty(),
            "a call is never answered"
        );
        let nodes = self.nodes.iter();
        let mistakes = self
            .ledger
            .with_mirror(|mirror| nodes.flat_map(|node| node.mistakes(mirror)).collect());
        (mistakes, self.caught_up)
    }
}

/// The first seed from `from` on that leaves nodes with false beliefs, and these beliefs.
fn mistake(mutant: Mutant, from: u64, schedules: u64) -> Option<(u64, Vec<String>)> {
    let stats: &'static Stats = Box::leak(Box::default());
    (from..from + schedules).find_map(|seed| {
        let (mistakes, _) = World::new(seed, mutant, stats).play();
        (!mistakes.is_empty()).then_some((seed, mistakes))
    })
}

#[test]
fn when_all_is_quiet_each_node_knows_the_state() {
    let number = |name| std::env::var(name).ok().and_then(|text| text.parse().ok());
    let seed = number("ROSRESCUE_SEED").unwrap_or_else(|| (clock::wall_time() * 1e6) as u64);
    let schedules = number("ROSRESCUE_SCHEDULES").unwrap_or(500);
    println!("seeds from {seed} on, {schedules} schedules");
    let found = mistake(Mutant::None, seed, schedules);
    assert!(found.is_none(), "seed and mistakes: {found:?}");
}

#[test]
fn late_masters_are_given_what_they_missed() {
    let stats: &'static Stats = Box::leak(Box::default());
    let worlds = (0..100).map(|seed| World::new(seed, Mutant::None, stats));
    let caught_up: u64 = worlds.map(|world| world.play().1).sum();
    println!("{caught_up} times");
    assert!(caught_up > 3);
}

#[test]
fn each_part_of_the_order_is_needed() {
    for mutant in [Mutant::NoOrder, Mutant::NoRepeats] {
        let found = mistake(mutant, 0, 10_000);
        let (seed, _) = found.unwrap_or_else(|| panic!("{mutant:?} goes unnoticed"));
        println!("{mutant:?}: found in schedule {seed}");
    }
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_owned()
}
