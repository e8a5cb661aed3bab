//! A simulated rosmaster: it runs calls in order, and its notifier threads are sometimes late.

use std::collections::{BTreeMap, VecDeque};

use rescue_core::replay::{Inspection, Token};
use ros1_master::master::Notice;

use super::*;

/// A process of the master.
pub(super) struct Process {
    state: Master,
    /// When it begins to listen.
    pub(super) listens: u64,
    /// Until when it does nothing.
    pub(super) stopped: u64,
    /// Requests that it has got and not run.
    pub(super) running: u64,
    /// Notifications by port. The first one is on its way until the node has taken it.
    notices: BTreeMap<String, VecDeque<Notice>>,
}

impl Process {
    pub(super) fn new(listens: u64) -> Self {
        Self {
            state: Master::default(),
            listens,
            stopped: 0,
            running: 0,
            notices: BTreeMap::new(),
        }
    }

    /// Whether the master has this token.
    pub(super) fn has(&mut self, token: &Token) -> bool {
        Token::is_found(&self.state.apply(&token.lookup()).reply)
    }

    /// The state without rosrescue's tokens.
    pub(super) fn state(&self) -> Master {
        let mut state = self.state.clone();
        for (name, api) in self.state.nodes().filter(|(name, _)| Token::is_ours(name)) {
            state.apply(&Request::new(Method::UnsubscribeParam, [name, api, "~"]));
        }
        state
    }

    /// The state as rosrescue reads it.
    fn read(&mut self, token: &Token, previous: &Master) -> Master {
        let reply = self.state.apply(&Inspection::call(token)).reply;
        let first = Inspection::decode(&reply, token).unwrap();
        let second = first.second_call(previous);
        let second = second.map(|call| self.state.apply(&call).reply);
        first.into_master(second.as_ref(), previous).unwrap()
    }
}

impl World {
    pub(super) fn stop_master(&mut self, time: u64) {
        let until = self.now + time;
        if let Some(master) = &mut self.master {
            master.stopped = master.stopped.max(until);
        }
        self.print(|| format!("the master stops for {time} µs"));
    }

    /// The master runs a request, as soon as it goes on. Without one, the write queue reads its state.
    pub(super) fn master_gets(&mut self, life: u64, asked: Asked, request: Option<Request>) {
        if !self.is_master(life) {
            return;
        }
        let now = self.now;
        let Some(master) = &mut self.master else {
            return;
        };
        if now < master.stopped {
            // Each connection has a thread of its own.
            let time = master.stopped - now + self.scheduled();
            return self.after(time, Event::MasterGets(life, asked, request));
        }
        master.running -= 1;
        let received = match request {
            None => {
                let previous = self.ledger.with_mirror(Clone::clone);
                Received::Held(master.read(&self.ledger.token(), &previous).into())
            }
            Some(call) => Received::Reply(raw(&self.run(&call))),
        };
        let time = 50 + self.dice.below(1_000);
        self.after(time, Event::Replied(asked, received));
    }

    /// Lets the master run a call and notify nodes.
    pub(super) fn run(&mut self, call: &Request) -> Reply {
        self.print(|| format!("the master runs {call:?}"));
        for call in call.calls() {
            // The mirror has run the other ones already, unless it has answered a call because it changed nothing.
            let waits = self.waiting.iter().any(|waiting| waiting.call == *call);
            if waits || self.sent_again.contains(call) {
                self.note_value(call);
            }
        }
        let master = self.master.as_mut().unwrap();
        let applied = master.state.apply(call);
        let mut begun = Vec::new();
        for notice in applied.notices {
            let port = port_of(notice.to()).to_owned();
            let queue = master.notices.entry(port.clone()).or_default();
            queue.push_back(notice);
            if queue.len() == 1 {
                begun.push(port);
            }
        }
        for port in begun {
            let lead = 300 + self.dice.below(500);
            let late = self.dice.one_in(10).then(|| self.dice.below(5_000));
            let time = lead + late.unwrap_or(0);
            self.after(time, Event::MasterNotifies(self.life, port));
        }
        applied.reply
    }

    pub(super) fn master_notifies(&mut self, port: String) {
        let (now, life) = (self.now, self.life);
        let master = self.master.as_ref().unwrap();
        if now < master.stopped {
            let time = master.stopped - now + self.scheduled();
            return self.after(time, Event::MasterNotifies(life, port));
        }
        let call = master.notices[&port].front().unwrap().call();
        self.print(|| format!("the master tells {port} {:?}", call.params));
        let time = self.notify_node(&call, &port, 0);
        self.after(time + 50, Event::TakenFromMaster(life, port));
    }

    pub(super) fn taken_from_master(&mut self, port: String) {
        let life = self.life;
        let queue = self
            .master
            .as_mut()
            .unwrap()
            .notices
            .get_mut(&port)
            .unwrap();
        queue.pop_front();
        if !queue.is_empty() {
            let time = 100 + self.scheduled();
            self.after(time, Event::MasterNotifies(life, port));
        }
    }

    pub(super) fn dies(&mut self) {
        if self.master.take().is_none() {
            return;
        }
        self.print(|| "the master dies".to_owned());
        let life = self.life;
        let (ended, exited) = (self.dice.below(3_000), self.dice.below(6_000));
        self.after(
            ended,
            Event::Recovery(recovery::Event::ConnectionEnds(life)),
        );
        match self.recovery.supervision {
            Supervision::Ours => self.after(exited, Event::Recovery(recovery::Event::Exits(life))),
            Supervision::Theirs => {
                let outage = 1_000 + self.dice.below(150_000);
                self.after(outage, Event::Recovery(recovery::Event::Started));
            }
        }
        self.break_request();
    }

    /// The connection of the request in flight ends. Its answer may have been sent before.
    pub(super) fn break_request(&mut self) {
        if let Some(number) = self.in_flight {
            // Sometimes only after the mirror has begun to stand in.
            let most = if self.dice.one_in(4) { 12_000 } else { 3_000 };
            let time = self.dice.below(most);
            self.after(time, Event::Broken(number, Failure::MayHaveRun));
        }
    }

    /// A client sets a parameter directly at the master if the journal must know that the master has run the call that set
    /// it to `value`. Then rosrescue dies.
    pub(super) fn bypasses_after(&mut self, value: i32) {
        let held = self.master.as_ref();
        let held = held.and_then(|it| it.state.params().get(BYPASSED)?.as_int());
        let is_known = held == Some(value)
            && self.gate().is_open()
            && self.in_flight.is_none()
            && !self.is_down;
        match (is_known, self.set_before.is_some()) {
            // The master may have run the call just now.
            (true, true) => {
                self.set_before = None;
                self.after(15_000, Event::BypassesAfter(value));
            }
            (true, false) if !self.ledger.has_jobs() => {
                self.bypasses();
                let time = 5_000 + self.dice.below(50_000);
                self.after(time, Event::WorkerDies);
            }
            (true | false, _) if self.calls_left > 0 => {
                self.after(2_000, Event::BypassesAfter(value));
            }
            _ => {}
        }
    }

    /// A client sets a parameter directly at the master.
    pub(super) fn bypasses(&mut self) {
        let now = self.now;
        let Some(master) = &mut self.master else {
            return;
        };
        if now < master.stopped || now < master.listens {
            return;
        }
        self.value += 1;
        let (value, life) = (self.value, self.life);
        let call = set_bypassed(value);
        master.state.apply(&call);
        self.print(|| format!("at the master, a client calls {call:?}"));
        // The parameter is given back its first value if it was set again after that was read.
        let is_second =
            !self.gate().is_open() && std::mem::replace(&mut self.bypassed_before_open, true);
        self.injection_broke |= is_second && self.gate().is_injecting();
        self.bypassed = (!self.injection_broke).then_some((value, life));
        let time = self.dice.below(COMPARE_WITHIN);
        self.after(time, Event::Compares);
    }

    /// The connection of an injection ends, and with it the only answer that shows what the injection replaced.
    pub(super) fn injection_breaks(&mut self) {
        self.injection_broke = true;
        self.bypassed = None;
    }

    pub(super) fn breaks(&mut self) {
        if self.master.is_none() {
            return;
        }
        self.print(|| "all connections to the master break".to_owned());
        self.may_go_back = true;
        let time = self.dice.below(3_000);
        let event = recovery::Event::ConnectionEnds(self.life);
        self.after(time, Event::Recovery(event));
        self.break_request();
    }
}
