//! The simulated nodes' writes, reads and notifications, and the merges of their writes.

use super::*;

impl World {
    pub(super) fn poll(&mut self, at: usize) {
        let computer = &self.computers[at];
        let behind = computer.watching
            && computer.watch_at < self.now
            && computer.watched != self.etcd.view().revision;
        if behind && self.network.reaches_etcd(at) {
            // A new watch replaces the silent one.
            self.computers[at].watch += 1;
            self.show_watch(at);
        }
        for to in 0..COMPUTERS {
            if self.owed[at][to] && self.network.joins(at, to) {
                self.owed[at][to] = false;
                self.tell_state(at, to);
            }
        }
        self.flush(at);
        let computer = &self.computers[at];
        // One more period holds the writes that the computer answered as a leader before it was
        // deposed.
        let times = computer.times_alone + 1;
        if computer.standing == Standing::Alone && computer.member.uncommitted() > KEYS * times {
            self.history.breaks("what is kept grows with each write");
        }
        if computer.standing != Standing::Alone && computer.disk.kept.is_none() {
            self.computers[at].times_alone = 0;
        }
    }

    /// Runs or forwards the calls that wait, as far as possible.
    pub(super) fn flush(&mut self, at: usize) {
        let waiting = self.computers[at].waiting.clone();
        for (call, missed) in waiting {
            match self.computers[at].standing.clone() {
                standing if standing.answers() => self.run_call(at, call, at),
                Standing::Follows { uri: to, term } if missed <= self.now => {
                    let to = (0..COMPUTERS).find(|of| uri(*of) == to);
                    if let Some(to) = to.filter(|to| self.network.joins(at, *to)) {
                        let delay = self.delay();
                        self.after(delay, Event::Forward(at, to, term, call));
                        for (waits, missed) in &mut self.computers[at].waiting {
                            if *waits == call {
                                *missed = self.now + 1000 * MS;
                            }
                        }
                    }
                }
                _ => {}
            }
        }
        self.input_changes(at);
    }

    /// Runs a call on the computer that records it.
    pub(super) fn run_call(&mut self, at: usize, call: usize, origin: usize) {
        let source = match origin == at {
            true => Source::Here,
            false => Source::Forwarded,
        };
        let request = self.history.request(call);
        let computer = &mut self.computers[at];
        let local = computer.local(self.now);
        let waits = computer.ledger.unanswered.iter();
        let waits = waits.filter(|of| of.call == call && of.origin == origin);
        if waits.count() > 0 || !computer.ledger.has_lease(local) {
            return;
        }
        let Some((seq, notices)) = computer.ledger.run(&request, &source) else {
            return;
        };
        self.history.made(call, at);
        computer
            .ledger
            .unanswered
            .push(Unanswered { seq, call, origin });
        let agreed = computer.ledger.agreed;
        self.tell_notices(at, notices);
        self.agree(at, agreed);
    }

    pub(super) fn agree(&mut self, at: usize, seq: u64) {
        let computer = &mut self.computers[at];
        let ledger = &mut computer.ledger;
        ledger.agreed = ledger.agreed.max(seq);
        let agreed = ledger.agreed;
        let (answered, left): (Vec<_>, Vec<_>) = std::mem::take(&mut ledger.unanswered)
            .into_iter()
            .partition(|of| of.seq <= agreed);
        ledger.unanswered = left;
        let merges = std::mem::take(&mut ledger.merges).into_iter();
        let (merged, left): (Vec<_>, Vec<_>) = merges.partition(|(seq, ..)| *seq <= agreed);
        ledger.merges = left;
        for (_, asker, answer) in merged {
            self.merge_answered(asker, at, Some(answer));
        }
        for Unanswered { call, origin, .. } in answered {
            self.counts.acknowledged += 1;
            let alone = self.computers[at].member.role() == Role::Alone;
            let term = self.computers[at].member.machine().term();
            if let Some(term) = term.filter(|_| !alone) {
                // A call in the journal is safe, whichever computer answers it.
                let committed = self.etcd.holds(&self.history.request(call));
                // An older copy that is restored within a lease brings two leases.
                let ttl = self.plan.ttl.as_micros() as u64;
                let restored = self.counts.restored > 0 && self.now < self.etcd.lost_at + ttl;
                if !committed && term < self.term && !restored {
                    self.history.breaks("two leaders answer");
                }
                let always = self.plan.commit == Commit::Always;
                let origin = self.etcd.view().origin;
                let seen = origin > 0 && self.computers[at].seen_unreadable == origin;
                if always && seen && !self.etcd.is_readable() {
                    self.history
                        .breaks("a leader answers although it has seen that keys are gone");
                }
                if !committed && always && !self.etcd.lost {
                    self.history
                        .breaks("a leader answers what no journal holds");
                }
                // A leader of the etcd that was lost may not know of the loss yet.
                if term <= self.etcd.view().revision && !self.etcd.is_lost && !restored {
                    self.term = self.term.max(term);
                }
            }
            let cut = self.computers[at].cut;
            self.history
                .answered(at, call, self.now, alone.then_some(cut));
            let shown = JournalPosition::shown_seq(false, agreed, self.computers[at].ledger.last());
            let position = position(term.unwrap_or(0), shown);
            let life = self.computers[origin].life;
            if origin == at {
                self.done(at, call);
            } else if self.network.joins(at, origin) {
                let delay = self.delay();
                self.after(delay, Event::Done(origin, life, call, position));
            } else {
                self.history.unheard(call);
            }
        }
    }

    /// Has a forwarded call sent again soon, because the other computer does not lead.
    pub(super) fn refused(&mut self, at: usize, call: usize) {
        let again = self.now + POLL;
        let waiting = self.computers[at].waiting.iter_mut();
        for (_, missed) in waiting.filter(|(of, _)| *of == call) {
            *missed = again.min(*missed);
        }
    }

    /// Notes that a call of this computer's nodes was answered.
    pub(super) fn done(&mut self, at: usize, call: usize) {
        let computer = &mut self.computers[at];
        let waits = computer.waiting.iter().any(|(of, _)| *of == call);
        if waits {
            self.history.note_answered(call, self.now);
            let made = self.history.calls[call].made;
            if self.plan.alone == WhenAlone::Serve && computer.undisturbed_since <= made {
                let waited = Duration::from_micros(self.now - made);
                self.counts.waited = self.counts.waited.max(waited);
            }
            computer.waiting.retain(|(of, _)| *of != call);
        }
    }

    /// Makes writes on the leader that a computer answered while it was cut off.
    pub(super) fn merge(&mut self, asker: Asker, to: Option<usize>, term: u64, ask: Ask) {
        let (from, ..) = asker;
        let at = to.unwrap_or(from);
        let there = &self.computers[at];
        let standing_fits = match to {
            Some(_) => there.standing.answers_others(term) && self.network.joins(from, at),
            None => there.ledger.sharing.is_some() && there.standing != Standing::Alone,
        };
        let local = there.local(self.now);
        let fits = there.up && standing_fits && there.ledger.has_lease(local);
        let mut answer = None;
        if fits {
            let calls: Vec<_> = ask.calls.iter().collect();
            let ledger = &mut self.computers[at].ledger;
            let mirror = &ledger.mirror;
            let sharing = ledger.sharing.as_ref();
            let verdicts =
                sharing.and_then(|of| of.merge_verdicts(mirror, ask.seq, &ask.id, &calls));
            answer = Some(match verdicts {
                None => wire::MergeAnswer::Again,
                Some(verdicts) => {
                    let source = Source::Merge(ask.id.clone());
                    let mut results = Vec::new();
                    for (call, verdict) in ask.calls.iter().zip(&verdicts) {
                        if *verdict == crate::cluster::merge::MergeVerdict::Apply {
                            let ledger = &mut self.computers[at].ledger;
                            let ran = ledger.run(call, &source);
                            results.push(Value::Array(vec![
                                vec![Value::from(1), "".into(), 0.into()].into(),
                            ]));
                            let log = self.etcd.log.len();
                            self.history.merged((from, at), call, (self.now, log));
                            if let Some((_, notices)) = ran {
                                self.tell_notices(at, notices);
                            }
                        }
                    }
                    wire::MergeAnswer::from_reply(&verdicts, &Reply::Value(results.into()))
                }
            });
        }
        let Some(answer) = answer else {
            return self.merge_answered(asker, at, None);
        };
        // The answer waits until the journal has the writes.
        let ledger = &mut self.computers[at].ledger;
        let seq = ledger.sharing.as_ref().map_or(0, |of| of.last());
        let agreed = ledger.agreed;
        ledger.merges.push((seq, asker, answer));
        self.input_changes(at);
        self.agree(at, agreed);
    }

    pub(super) fn merge_answered(
        &mut self,
        (to, life, number): Asker,
        at: usize,
        answer: Option<wire::MergeAnswer>,
    ) {
        let delay = self.delay();
        let answer = answer.filter(|_| to == at || self.network.joins(at, to));
        let merged = Input::Merged { number, answer };
        self.after(delay, Event::Input(to, life, merged));
    }

    pub(super) fn client(&mut self, at: usize) {
        let pause = self.dice.below(300) * MS;
        self.after(pause, Event::Client(at));
        if !self.computers[at].up || self.network.healed_for(self.now, 2_000 * MS) {
            return;
        }
        let key = match self.is_apart {
            true => at,
            false => self.dice.below(KEYS as u64) as usize,
        };
        if self.dice.one_in(3) || self.writer.is_some_and(|writer| writer != at) {
            return self.begin_read(at, key);
        }
        let again = self.dice.one_in(3).then(|| self.dice.below(4));
        let call = self.history.write(at, key, self.now, again);
        self.computers[at].waiting.push((call, 0));
        self.flush(at);
    }

    /// What the mirror of a computer that is not cut off may show.
    pub(super) fn shows(&self, at: usize) -> Shows {
        let computer = &self.computers[at];
        match computer.early().or(computer.restored_early) {
            Some(term) => Shows::Early(term),
            None => Shows::Agreed,
        }
    }

    pub(super) fn value(&self, at: usize, key: usize) -> Option<i32> {
        value_of(&self.computers[at].ledger.mirror, key)
    }

    pub(super) fn begin_read(&mut self, at: usize, key: usize) {
        let read = self.history.reads.len();
        self.history.reads.push(Read::new(at, key, self.now));
        let computer = &self.computers[at];
        let life = computer.life;
        match computer.standing.clone() {
            Standing::Follows { uri: to, term } => {
                let delay = self.delay();
                let to = (0..COMPUTERS).find(|of| uri(*of) == to);
                if let Some(to) = to.filter(|to| self.network.joins(at, *to)) {
                    self.after(delay, Event::Ask(at, life, to, term, read));
                }
                self.after(100 * MS, Event::Late(at, life, read));
            }
            _ => self.read_late(at, life, read),
        }
    }

    /// Answers a read from the mirror, if the mirror may answer.
    pub(super) fn read_late(&mut self, at: usize, life: u64, read: usize) {
        let key = self.history.reads[read].key;
        let computer = &self.computers[at];
        let fresh = computer.followed.shows(computer.told);
        let alone = computer.member.role() == Role::Alone;
        let led = alone && computer.left == Some(computer.told);
        let may = match &computer.standing {
            Standing::Alone => true,
            Standing::Leads {
                answers: AnsweredCalls::All,
                ..
            } => true,
            Standing::Leads { answers, .. } => fresh && *answers == AnsweredCalls::Reads,
            Standing::Follows { .. } => fresh,
            Standing::NoLeader { known } => fresh && *known,
        };
        assert!(
            may || !led,
            "{at}: a former leader's mirror does not answer"
        );
        if may {
            let value = self.value(at, key);
            let computer = &self.computers[at];
            let uncounted = alone || computer.unaware || computer.follows_lost;
            let shows = if uncounted {
                Shows::Alone
            } else {
                self.shows(at)
            };
            self.read_done(read, value, shows);
        } else if self.now < self.history.reads[read].began + 8_000 * MS {
            self.after(POLL, Event::Late(at, life, read));
        }
    }

    pub(super) fn read_done(&mut self, read: usize, value: Option<i32>, shows: Shows) {
        let read = &mut self.history.reads[read];
        (read.value, read.done, read.shows) = (value, Some(self.now), shows);
        self.counts.reads += 1;
    }

    /// Has the master notify nodes, or the mirror in the master's place.
    pub(super) fn tell_notices(&mut self, at: usize, notices: Vec<Notice>) {
        for notice in notices {
            if let Notice::ParamUpdate {
                to,
                key: name,
                value,
            } = notice
            {
                let to = (0..COMPUTERS)
                    .find(|of| super::super::history::node(*of) == to)
                    .unwrap();
                let of = (0..KEYS)
                    .find(|of| format!("{}/", key(*of)) == name)
                    .unwrap();
                self.tell_node(at, to, of, value.as_int());
            }
        }
    }

    pub(super) fn tell_state(&mut self, at: usize, to: usize) {
        for key in 0..KEYS {
            let value = self.value(at, key);
            if value.is_some() {
                self.tell_node(at, to, key, value);
            }
        }
    }

    pub(super) fn tell_node(&mut self, from: usize, to: usize, key: usize, value: Option<i32>) {
        let computer = &self.computers[from];
        let local = computer.local(self.now);
        let by_mirror = computer.master.is_none();
        if by_mirror && (computer.own_only && to != from || !computer.ledger.has_lease(local)) {
            return;
        }
        let master = computer.master;
        let delay = MS / 2 + self.dice.below(15 * MS);
        let at = self.channels[from][to].max(self.now + delay);
        self.channels[from][to] = at;
        let notify = Event::Notify {
            from,
            master,
            to,
            key,
            value,
        };
        self.at(at, notify);
    }

    pub(super) fn notify(
        &mut self,
        from: usize,
        master: Option<u64>,
        to: usize,
        key: usize,
        value: Option<i32>,
    ) {
        if master.is_some_and(|of| self.computers[from].master != Some(of)) {
            // The master has ended.
            return;
        }
        if master.is_some() && self.computers[from].member.role() == Role::Alone {
            let what =
                format!("{from} is cut off, and its master tells {to} that {key} is {value:?}");
            self.history.breaks(&what);
        }
        if let Some(master) = master
            && let Some(stuck) = self.stuck.get_mut(&(from, master, to))
        {
            stuck.push_back((key, value));
            return;
        }
        if self.network.joins(from, to) {
            return self.note_notified(from, to, key, value);
        }
        if self.computers[from].ledger.sharing.is_some() {
            self.owed[from][to] = true;
        }
        if let Some(master) = master {
            let stuck = VecDeque::from([(key, value)]);
            self.stuck.insert((from, master, to), stuck);
            self.after(150 * MS, Event::Retry(from, master, to));
        }
    }

    /// Repeats a notification that a master could not deliver, as rosmaster does.
    pub(super) fn retry(&mut self, from: usize, master: u64, to: usize) {
        let lives = self.computers[from].master == Some(master);
        if lives && !self.network.joins(from, to) {
            return self.after(150 * MS, Event::Retry(from, master, to));
        }
        let stuck = self.stuck.remove(&(from, master, to)).unwrap_or_default();
        for (key, value) in stuck.into_iter().filter(|_| lives) {
            self.note_notified(from, to, key, value);
        }
    }

    fn note_notified(&mut self, from: usize, to: usize, key: usize, value: Option<i32>) {
        self.trace(|| format!("{from} tells {to} that {key} is {value:?}"));
        self.history.told[to][key] = value;
    }

    /// Deletes a computer's file of the writes that it answered while it was cut off.
    pub(super) fn forget_kept(&mut self, at: usize) {
        self.computers[at].synced.kept = None;
        let kept = self.computers[at].disk.kept.take().unwrap_or_default();
        for name in (0..KEYS).map(key) {
            let last = kept
                .calls
                .iter()
                .rev()
                .find(|call| call.text(1) == Some(&*name));
            if let Some(call) = last.filter(|call| !self.history.is_settled(call, &self.etcd)) {
                let what = format!("{at} forgets {call:?}, which no journal has");
                self.history.breaks(&what);
            }
        }
    }

    /// A random delay of one message in the network.
    pub(super) fn delay(&mut self) -> u64 {
        let slow = self.network.slow(self.now);
        MS / 2 + self.dice.below(20 * MS) + slow
    }
}
