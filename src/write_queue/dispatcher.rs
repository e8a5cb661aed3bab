//! Decides which queued writes go to the master and which ones the mirror answers. Pure: the time, the state of the
//! [gate](crate::gate) and the end of each request are inputs, and what follows is a list of [`Action`]s.
//! [`Drain`](super::Drain) carries these out; [`tests`](super::tests) plays random schedules with them.

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;

use super::{
    MoveJudge,
    batch::{self, Batch, CallAnswer, Caller, First, Item, MadeBy},
    evict, merge,
    outdated::is_outdated,
    resync::ResyncSchedule,
    round_trip::{Failure, Received},
};
use rescue_core::{checkpoint::format::Origin, lifecycle::Patience, order::Order};
use ros1_master::{
    master::{Effect, Master, Request, Write},
    xmlrpc::{self, Reply},
};

use crate::{
    cli::Writes,
    gate::State,
    ledger::{
        Ledger, Mark,
        delivery::Delivery,
        first::{Acknowledged, AnsweredFirst},
        mutant::Mutant,
    },
    limit::rarely,
    status::stats::Stats,
    upstream::{Head, RawReply},
};

/// Pause before an unsent batch is retried while calls still pass to the master.
const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// How long a batch may continue after calls no longer pass to the master, before the mirror answers it. A killed
/// master closes its connections within milliseconds. A master that only closed an idle connection still answers.
const GRACE: Duration = Duration::from_millis(5);
/// Longest time for which a write that the mirror has answered waits for answers on their way to nodes. Those nodes may
/// be notified of it before they read the answers, and are told the state again.
const FIRST_WAITS: Duration = Duration::from_millis(20);
/// How long the journal may not know which writes the master has run. A rosrescue that starts meanwhile gives them to
/// the master once more, although a program may have changed the master directly since.
const ACKNOWLEDGE_AFTER: Duration = Duration::from_millis(10);
/// Time after which the mirror answers in place of a master that has not answered. A rosmaster answers within a
/// millisecond, or within some ten milliseconds if another call keeps its Python interpreter busy.
pub(crate) const PATIENCE: Duration = Duration::from_millis(100);

/// What the dispatcher must know of the rest of rosrescue.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    pub(super) now: Instant,
    pub(super) gate: State,
    /// Whether the gate has changed since the last input.
    pub(super) gate_changed: bool,
    /// With several computers, whether this computer may act as leader.
    pub(super) leads: bool,
    /// Since when no call to the master, on any connection, has ended although some are under way.
    pub(super) silent_since: Option<Instant>,
}

/// Something that happened.
#[derive(Debug)]
pub(super) enum Input {
    /// Calls have arrived.
    Calls(Vec<Item>),
    /// The request in flight has ended.
    Ended(Result<Received, Failure>),
    /// It is time to compare the master with the mirror.
    Compare,
    /// Time has passed, the gate or the lease has changed, or calls that waited may go on.
    Wake,
}

/// Something to do.
#[derive(Debug)]
pub(super) enum Action {
    /// Send these bytes to the master with this number. Its end is an [`Input::Ended`].
    Send {
        incarnation: u64,
        request: (Head, Bytes),
    },
    /// Read the state of the master with this number. Its end is an [`Input::Ended`].
    Inspect {
        incarnation: u64,
    },
    /// Record the call that was just sent, if the master surely accepts it, and have the disk write it.
    Record {
        call: Arc<Request>,
        origin: Origin,
    },
    /// Drop the request in flight and the connection to the master.
    Disconnect,
    /// Give callers their answers.
    Answer(Answers),
    Report(Report),
}

/// Something that the recovery must know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Report {
    /// The connection of a batch ended before the answer. The master may have run the batch, and may be dead.
    Lost,
    /// The master has left a write unanswered for too long, and the mirror can answer all calls in flight.
    Late,
    /// The late master has answered its outstanding calls.
    LateAnswered,
    /// The master takes too long to answer a call.
    Slow,
}

/// Answers to callers. They may be given once the effects of their calls are safe.
#[derive(Debug, Default)]
pub(super) struct Answers {
    /// The last record that the answers wait for. See [`Ledger::durable`].
    pub(super) mark: Option<Mark>,
    /// The version of the mirror that a whole checkpoint must include before. See [`Ledger::attempted`].
    pub(super) version: Option<u64>,
    made: Vec<(Caller, CallAnswer, Option<Delivery>)>,
}

impl Answers {
    /// Gives the answers. If the effects of the calls are not safe, because this computer does not lead any more, the
    /// callers are sent to the computer that does.
    pub(super) fn give(self, is_safe: bool) {
        for (caller, answer, delivery) in self.made {
            let answer = match is_safe {
                true => answer,
                false => CallAnswer::Elsewhere,
            };
            caller.reply(answer, delivery);
        }
    }

    fn add(&mut self, mut item: Item, answer: CallAnswer) {
        item.log_eviction(&answer);
        if let Some(caller) = item.take_caller() {
            self.made.push((caller, answer, item.delivery));
        }
    }
}

/// The request to the master. There is one at most.
#[derive(Debug)]
enum Exchange {
    /// No request is in flight. The next one may be sent, but not before this time.
    Idle {
        not_before: Option<Instant>,
    },
    InFlight(InFlight),
    /// The connection of a batch ended before the answer, so the master may have run it. Nothing is sent until the gate
    /// has changed.
    Lost,
    /// The request with which the master was late has ended. Nothing is sent until the gate has left [`State::Late`].
    LateEnded,
}

#[derive(Debug)]
struct InFlight {
    incarnation: u64,
    /// The mirror's version when the request was sent.
    version: u64,
    work: Work,
    sent: Instant,
    /// Whether the recovery has been told that the master is late with this request.
    told_late: bool,
    /// Until when the request may continue although calls no longer pass to the master.
    grace: Option<Instant>,
}

/// What a request is for.
#[derive(Debug)]
enum Work {
    /// It carries these calls.
    Calls(Vec<Item>),
    /// It reads the master's state.
    Inspection,
    /// The mirror has answered its calls, because the master is late.
    AnsweredByMirror,
}

/// Calls with an effect that the answer does not show: rosrescue does not understand the call or the answer, or the
/// answer is a fault. Their answers wait until the mirror has been read from the master again and includes their
/// effects.
#[derive(Default)]
struct Opaque {
    incarnation: u64,
    answers: Vec<(Item, CallAnswer)>,
    mark: Mark,
}

/// Decides which queued writes go to the master and which ones the mirror answers.
pub(super) struct Dispatcher {
    ledger: Arc<Ledger>,
    judge: Arc<dyn MoveJudge>,
    stats: &'static Stats,
    /// Who answers writes first.
    writes: Writes,
    /// Calls that have not been sent, in the order of their arrival.
    queue: VecDeque<Item>,
    exchange: Exchange,
    opaque: Opaque,
    /// The number of the last master to which calls passed.
    incarnation: u64,
    inspections: ResyncSchedule,
    /// How long writes wait for the master.
    patience: Patience,
    /// Latest time to retry calls that wait until other calls are answered.
    held_until: Option<Instant>,
    /// When the master counts as late with the request in flight.
    late_at: Option<Instant>,
    /// Whether the last input has shown that a master will not run all calls that the mirror has answered first.
    has_left_out: bool,
    /// When to note in the journal which writes the master has run. `None` if there is nothing to note.
    acknowledge_at: Option<Instant>,
    actions: Vec<Action>,
}

impl Dispatcher {
    pub(super) fn new(
        ledger: Arc<Ledger>,
        judge: Arc<dyn MoveJudge>,
        stats: &'static Stats,
        writes: Writes,
        patience: Patience,
    ) -> Self {
        Self {
            ledger,
            judge,
            stats,
            writes,
            queue: VecDeque::new(),
            exchange: Exchange::Idle { not_before: None },
            opaque: Opaque::default(),
            incarnation: 0,
            inspections: ResyncSchedule::default(),
            patience,
            held_until: None,
            late_at: None,
            has_left_out: false,
            acknowledge_at: None,
            actions: Vec::new(),
        }
    }

    /// Takes an input, and returns what to do now. Must also be called with [`Input::Wake`] at [`Self::deadline`].
    pub(super) fn on(&mut self, view: &View, input: Input) -> Vec<Action> {
        match input {
            Input::Calls(items) => self.arrive(view, items),
            Input::Ended(result) => self.ended(view.now, result),
            Input::Compare => {
                if !matches!(&self.exchange, Exchange::InFlight(it) if it.is_inspection()) {
                    self.inspections.request();
                }
            }
            Input::Wake => {}
        }
        if view.gate
            != (State::Open {
                incarnation: self.incarnation,
            })
        {
            self.leave_out_answered();
        }
        if self.acknowledge_at.take_if(|at| *at <= view.now).is_some() {
            self.ledger.record_acknowledged();
        }
        // Drops calls that are answered or whose client has gone.
        self.queue.retain(|item| !item.is_dropped());
        if self.inspections.wake_at().is_some_and(|at| at <= view.now) {
            self.inspections.wake();
        }
        self.held_until = None;
        match &mut self.exchange {
            Exchange::Lost if view.gate_changed => self.exchange = Exchange::default(),
            Exchange::LateEnded if view.gate != State::Late => self.exchange = Exchange::default(),
            Exchange::Idle { not_before } => {
                not_before.take_if(|at| view.gate_changed || *at <= view.now);
            }
            Exchange::InFlight(batch) if !is_away(view.gate) || !view.leads => {
                batch.grace = None;
            }
            _ => {}
        }
        match view.gate {
            State::Elsewhere => self.send_elsewhere(),
            _ if !view.leads => {}
            State::Open { incarnation } => self.send(view.now, incarnation),
            State::StandingIn | State::Injecting => self.answer_from_mirror(view.now),
            State::Late => self.answer_for_late_master(view.now),
            State::Frozen | State::Unknown => {}
        }
        self.answer_unchanged(view);
        self.watch_master(view);
        std::mem::take(&mut self.actions)
    }

    /// When to call [`Self::on`] again without another input.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let exchange = match &self.exchange {
            Exchange::Idle { not_before } => *not_before,
            Exchange::InFlight(batch) => batch.grace,
            Exchange::Lost | Exchange::LateEnded => None,
        };
        let impatient = self.waiting().filter_map(Item::patience).min();
        let others = [
            self.held_until,
            self.late_at,
            self.acknowledge_at,
            self.inspections.wake_at(),
        ];
        let others = others.into_iter().flatten();
        exchange.into_iter().chain(impatient).chain(others).min()
    }

    /// When the request in flight was sent.
    pub(super) fn unanswered_since(&self) -> Option<Instant> {
        match &self.exchange {
            Exchange::InFlight(batch) => Some(batch.sent),
            _ => None,
        }
    }

    /// The calls that wait for an answer of the master.
    fn waiting(&self) -> impl Iterator<Item = &Item> {
        let in_flight = match &self.exchange {
            Exchange::InFlight(InFlight {
                work: Work::Calls(items),
                ..
            }) => items.as_slice(),
            _ => &[],
        };
        in_flight.iter().chain(&self.queue)
    }

    /// Queues calls. While the mirror is frozen and no other computer can lead, it answers those that change nothing at
    /// once.
    fn arrive(&mut self, view: &View, items: Vec<Item>) {
        for mut item in items {
            let is_answered = view.gate == State::Frozen
                && view.leads
                && item.patience().is_some()
                && self.answer_if_unchanged(view.now, &mut item);
            if !is_answered {
                if self.may_answer_first(view, &item) {
                    self.answer_first(view.now, &mut item);
                }
                self.queue.push_back(item);
            }
        }
    }

    /// Whether the mirror may answer this call before the master has run it. The master must run calls in the order in
    /// which the mirror has applied them, so no other call may wait for the master's answer.
    fn may_answer_first(&self, view: &View, item: &Item) -> bool {
        let waits = |item: &Item| !item.is_answered_first();
        let is_behind = match &self.exchange {
            Exchange::Idle { .. } => false,
            Exchange::InFlight(InFlight {
                work: Work::Calls(items),
                ..
            }) => items.iter().any(waits),
            _ => true,
        };
        self.writes == Writes::Mirror
            && view.leads
            && view.gate
                == (State::Open {
                    incarnation: self.incarnation,
                })
            && !is_behind
            && !self.queue.iter().any(waits)
            && self.opaque.answers.is_empty()
            && matches!(&item.made_by, MadeBy::Client { request: (head, _), .. } if head.is_for_rpc())
            && item.answerable().is_some_and(|call| {
                let judge = &self.judge;
                self.ledger
                    .with_mirror(|mirror| judge.first_move(mirror, &[call]).is_none())
            })
    }

    fn answer_first(&mut self, now: Instant, item: &mut Item) {
        let Some(call) = item.answerable() else {
            return;
        };
        let registers = registers(call);
        let first = self
            .ledger
            .answer_first(now, call, item.concern(), item.origin);
        let Some(AnsweredFirst {
            reply,
            mark,
            delivery,
            seq,
        }) = first
        else {
            return;
        };
        let Some(caller) = item.take_caller() else {
            return;
        };
        if registers {
            self.judge.note_registration();
        }
        item.set_first(First {
            reply: reply.clone(),
            seq,
            latest: now + FIRST_WAITS,
        });
        let answers = Answers {
            mark: self.ledger.to_await(mark),
            version: None,
            made: vec![(caller, CallAnswer::Made(reply), delivery)],
        };
        self.actions.push(Action::Answer(answers));
    }

    /// Leaves out the calls that the mirror has answered first: the state that a master gets has them.
    fn leave_out_answered(&mut self) {
        if Mutant::KeepsAnswered.lives() {
            return;
        }
        let (ledger, before) = (&self.ledger, self.queue.len());
        self.queue.retain(|item| {
            if let Some(First { seq, .. }) = item.first() {
                ledger.note_left_out(*seq, item.concern());
            }
            !item.is_answered_first()
        });
        self.has_left_out = self.queue.len() < before;
    }

    /// Notes what the master has answered to the calls that the mirror has answered first. Without `replies`, that is not
    /// known. False if another master is about to get the state.
    fn acknowledge(
        &mut self,
        now: Instant,
        incarnation: u64,
        items: &[Item],
        replies: &[Reply],
    ) -> bool {
        let acknowledged = items.iter().enumerate().filter_map(|(index, item)| {
            let First {
                reply: predicted,
                seq,
                ..
            } = item.first()?;
            Some(Acknowledged {
                seq: *seq,
                concern: item.concern(),
                predicted,
                reply: replies.get(index),
            })
        });
        let acknowledged: Vec<_> = acknowledged.collect();
        if acknowledged.is_empty() {
            return true;
        }
        self.acknowledge_at.get_or_insert(now + ACKNOWLEDGE_AFTER);
        self.ledger
            .acknowledge(now, incarnation, &acknowledged)
            .is_ok()
    }

    /// Answers the calls whose patience has ended, if they change nothing. A call that the master has answered already
    /// is not among them: only its answer still waits for the disk.
    fn answer_unchanged(&mut self, view: &View) {
        let is_due = |item: &Item| item.patience().is_some_and(|at| at <= view.now);
        if !self.waiting().any(is_due) {
            return;
        }
        let mut queue = std::mem::take(&mut self.queue);
        let mut exchange = std::mem::take(&mut self.exchange);
        let in_flight = match &mut exchange {
            Exchange::InFlight(InFlight {
                work: Work::Calls(items),
                ..
            }) => items.as_mut_slice(),
            _ => &mut [],
        };
        for item in in_flight.iter_mut().chain(&mut queue) {
            if !is_due(item) {
                continue;
            }
            if !view.gate.is_open() || !view.leads {
                // The gate may open later, and the master behind it may hang. Without a lease, another computer may have
                // acknowledged another value.
                item.set_patience(Some(view.now + PATIENCE));
                continue;
            }
            item.set_patience(None);
            self.actions.push(Action::Report(Report::Slow));
            self.answer_if_unchanged(view.now, item);
        }
        queue.retain(|item| !item.is_dropped());
        (self.queue, self.exchange) = (queue, exchange);
    }

    /// Answers a call from the mirror if it changes nothing. Returns whether it does.
    fn answer_if_unchanged(&mut self, now: Instant, item: &mut Item) -> bool {
        let Some(call) = item.answerable() else {
            return false;
        };
        let Some((reply, mark, delivery)) = self.ledger.answer_if_unchanged(now, call) else {
            return false;
        };
        let Some(caller) = item.take_caller() else {
            return false;
        };
        self.stats.calls_without_master.count();
        let answers = Answers {
            // The write that made this one redundant may not be recorded yet.
            mark: self.ledger.to_await(mark),
            version: None,
            made: vec![(caller, CallAnswer::Made(reply), delivery)],
        };
        self.actions.push(Action::Answer(answers));
        true
    }

    /// Decides when the mirror must answer in the master's place, and tells the recovery. Never while the mirror is in
    /// doubt, or a call is under way that only a master can answer: then only the probes find that the master hangs.
    fn watch_master(&mut self, view: &View) {
        self.late_at = None;
        let Exchange::InFlight(batch) = &mut self.exchange else {
            return;
        };
        let is_answerable = match &batch.work {
            Work::Calls(items) => items.iter().all(Item::is_answerable),
            Work::Inspection => !self.queue.is_empty(),
            Work::AnsweredByMirror => false,
        };
        if !view.gate.is_open() || batch.told_late || !is_answerable || self.ledger.is_doubted() {
            return;
        }
        let late_at = self
            .patience
            .late_at(view.now, batch.sent, view.silent_since);
        if late_at <= view.now {
            batch.told_late = true;
            self.actions.push(Action::Report(Report::Late));
            return;
        }
        self.late_at = Some(late_at);
    }

    /// Takes back what earlier masters were given: the one with this `incarnation` never got it.
    fn forget_earlier_masters(&mut self, incarnation: u64) {
        if let Exchange::InFlight(batch) = &self.exchange
            && batch.incarnation != incarnation
        {
            self.ledger.withdraw();
            self.actions.push(Action::Disconnect);
            self.take_back_in_flight();
            self.leave_out_answered();
        }
        if self.opaque.incarnation != incarnation {
            let opaque = std::mem::take(&mut self.opaque).answers;
            self.take_back(opaque.into_iter().map(|(item, _)| item).collect());
        }
        if std::mem::replace(&mut self.incarnation, incarnation) != incarnation {
            self.inspections.reset();
        }
    }

    /// Sends the next batch, if none is in flight and there is something to send.
    fn send(&mut self, now: Instant, incarnation: u64) {
        self.forget_earlier_masters(incarnation);
        if self.ledger.is_doubted() {
            self.inspections.doubted();
        }
        if !matches!(self.exchange, Exchange::Idle { not_before: None }) {
            return;
        }
        while let Some(own) = self.queue.front()
            && is_outdated(&self.ledger, own)
            && let Some(own) = self.queue.pop_front()
        {
            own.reply(CallAnswer::Close);
        }
        // The mirror has applied calls that the master has not got.
        let is_ahead = self.queue.iter().any(Item::is_answered_first);
        let is_early = is_ahead && !Mutant::ReadsTooEarly.lives();
        let inspects = !is_early && self.inspections.begin(now);
        let items = match inspects {
            true => Vec::new(),
            false => self.next_batch(now),
        };
        if items.is_empty() && self.queue.is_empty() {
            // No call is left: the callers of lost calls have gone.
            self.ledger.release(Order::calls_settled);
        }
        if items.is_empty() && !inspects {
            return;
        }
        self.stats.write_batches.count();
        self.ledger.with_order(|order, _| {
            let tells = items
                .iter()
                .flat_map(|item| item.concern().notified_subjects());
            let answers = items.iter().filter_map(|item| item.delivery.as_ref());
            order.calls_sent(tells, answers.map(Delivery::number).collect());
        });
        let single = match items.as_slice() {
            [item] if !item.is_answered_first() && item.request().is_some() => {
                item.call.clone().map(|call| (call, item.origin))
            }
            _ => None,
        };
        self.actions.push(match inspects {
            true => Action::Inspect { incarnation },
            false => Action::Send {
                incarnation,
                request: batch::outbound(&items),
            },
        });
        if let Some((call, origin)) = single {
            self.actions.push(Action::Record { call, origin });
        }
        self.exchange = Exchange::InFlight(InFlight {
            incarnation,
            version: self.ledger.version(),
            work: match inspects {
                true => Work::Inspection,
                false => Work::Calls(items),
            },
            sent: now,
            told_late: false,
            grace: None,
        });
    }

    /// Handles the end of the request in flight.
    fn ended(&mut self, now: Instant, result: Result<Received, Failure>) {
        let InFlight {
            incarnation,
            version,
            work,
            sent,
            ..
        } = match std::mem::take(&mut self.exchange) {
            Exchange::InFlight(batch) => batch,
            other => {
                self.exchange = other;
                return;
            }
        };
        match work {
            Work::AnsweredByMirror => return self.late_ended(now, result.is_ok()),
            Work::Inspection => {
                if result.as_ref().err() != Some(&Failure::NotConnected) {
                    self.inspections.ended(now, now.duration_since(sent));
                }
                match result {
                    Ok(Received::Held(state)) => self.inspected(incarnation, version, *state),
                    Ok(Received::Reply(_)) => {}
                    Err(failure) => self.not_inspected(now, failure),
                }
            }
            Work::Calls(items) => match result {
                Ok(Received::Reply(raw)) => {
                    let (took, calls) = (now.duration_since(sent), items.len());
                    self.ledger
                        .with_order(|order, _| order.master_answered(took, calls));
                    self.deliver(now, incarnation, items, raw);
                }
                Ok(Received::Held(_)) => self.take_back(items),
                Err(failure) => self.failed(now, items, failure),
            },
        }
        // A master that ran a lost batch may have notified nodes, and the mirror does not know yet of what.
        if !matches!(self.exchange, Exchange::Lost) {
            self.ledger.release(Order::calls_settled);
        }
    }

    /// Handles the end of a request whose calls the mirror has answered long ago. The master has answered it too, or
    /// never will.
    fn late_ended(&mut self, now: Instant, answered: bool) {
        self.exchange = Exchange::LateEnded;
        self.actions.push(Action::Report(match answered {
            true => {
                self.patience.was_late(now);
                self.ledger.late_answered(now);
                Report::LateAnswered
            }
            false => {
                self.ledger.abandon_batch();
                Report::Lost
            }
        }));
        self.ledger.release(Order::calls_settled);
    }

    fn inspected(&mut self, incarnation: u64, version: u64, state: Master) {
        let Ok(difference) = self.ledger.adopt_if(incarnation, version, state) else {
            // The gate was shut meanwhile, or the mirror has changed since.
            self.inspections.request();
            return;
        };
        if !difference.is_empty() {
            rarely!(
                warn,
                ?difference,
                "the master's state differed from the mirror, which now follows it; if a client changed the master directly, set its ROS_MASTER_URI to rosrescue's address"
            );
        }
        self.answer_opaque();
    }

    fn not_inspected(&mut self, now: Instant, failure: Failure) {
        let not_before = Some(now + RETRY_PAUSE);
        self.exchange = Exchange::Idle { not_before };
        match failure {
            Failure::NotConnected => self.inspections.request(),
            _ => self.inspections.failed(now),
        }
        if failure == Failure::Unreadable {
            // Clients need not wait for a state that cannot be read.
            self.answer_opaque();
        }
    }

    fn failed(&mut self, now: Instant, items: Vec<Item>, failure: Failure) {
        self.ledger.withdraw();
        self.take_back(items);
        if failure == Failure::MayHaveRun {
            self.ledger.abandon_batch();
            // Whether the master ran the batch is known only when the master is back. Until then the mirror answers.
            self.exchange = Exchange::Lost;
            self.actions.push(Action::Report(Report::Lost));
        } else {
            let not_before = Some(now + RETRY_PAUSE);
            self.exchange = Exchange::Idle { not_before };
        }
    }

    fn answer_opaque(&mut self) {
        let Opaque { answers, mark, .. } = std::mem::take(&mut self.opaque);
        let mark = mark.max(self.ledger.mark());
        self.answer(mark, self.ledger.unwritten(), answers);
    }

    fn take_back(&mut self, items: Vec<Item>) {
        for mut item in items.into_iter().rev() {
            item.delivery = None;
            self.queue.push_front(item);
        }
    }

    /// Ends the request in flight, and takes its calls back. Returns them.
    fn take_back_in_flight(&mut self) {
        if let Exchange::InFlight(InFlight {
            work: Work::Calls(items),
            ..
        }) = std::mem::take(&mut self.exchange)
        {
            self.take_back(items);
        }
    }

    /// Takes the next batch. A call that registers the port of another node is the first of its batch. The eviction,
    /// which unregisters that node, goes before it.
    fn next_batch(&mut self, now: Instant) -> Vec<Item> {
        let ledger = self.ledger.clone();
        let mut items = loop {
            let Batch { items, until } = ledger.with_order(|order, _| {
                let delivery = |number| Delivery::new(&ledger, number);
                batch::pack(&mut self.queue, order, now, delivery)
            });
            self.held_until = until;
            let any = !items.is_empty();
            let items: Vec<_> = items
                .into_iter()
                .filter_map(|item| merge::leave_out_conflicts(&ledger, item))
                .collect();
            // If all these calls were answered without the master, the next ones are taken.
            if !any || !items.is_empty() {
                break items;
            }
        };
        let Some(first) = items.first_mut() else {
            return items;
        };
        let mut length = 1;
        if first.request().is_some() && !first.way_made && !first.is_answered_first() {
            if let Some(call) = first.call.as_deref()
                && let Some(eviction) = self.judge.judge_move(&ledger, call)
            {
                first.way_made = true;
                if let Some(eviction) = eviction {
                    let by = call.caller().unwrap_or_default().to_owned();
                    self.take_back(items);
                    return vec![evict::unregistration(eviction, by)];
                }
            } else if items.len() > 1 {
                let calls = items.iter().map_while(|item| item.call.as_deref());
                let calls: Vec<_> = calls.collect();
                let judge = &self.judge;
                let apart = ledger.with_mirror(|mirror| judge.first_move(mirror, &calls));
                length = apart.unwrap_or(items.len()).max(1);
            }
        }
        let rest = items.split_off(length);
        self.take_back(rest);
        items
    }

    /// Records what the master answered, then answers the clients.
    fn deliver(&mut self, now: Instant, incarnation: u64, items: Vec<Item>, raw: RawReply) {
        let reply = xmlrpc::decode_reply(&raw.body)
            .ok()
            .filter(|_| raw.status.is_success());
        let mut opaque = false;
        let replies = match (items.as_slice(), reply) {
            ([item], Some(reply)) => {
                opaque = item.call.is_none() && matches!(reply, Reply::Value(_));
                vec![reply]
            }
            // The reply cannot be decoded, so the effect is unknown and the master's state must be read. Reading does
            // not show parameter subscriptions, so these are recorded as the mirror predicts.
            ([item], None) if raw.status.is_success() => {
                opaque = true;
                let call = item.call.as_deref().filter(|call| subscribes_params(call));
                call.map(|call| self.ledger.predict(call))
                    .into_iter()
                    .collect()
            }
            ([_], None) => Vec::new(),
            (_, Some(reply)) => match batch::unpack(&reply, items.len()) {
                Some(replies) => replies,
                None => return self.undeliverable(now, incarnation, items),
            },
            (_, None) => return self.undeliverable(now, incarnation, items),
        };
        if !self.acknowledge(now, incarnation, &items, &replies) {
            return self.superseded(items);
        }
        let answered: Vec<_> = items
            .iter()
            .zip(&replies)
            .filter(|(item, _)| !item.is_answered_first())
            .filter_map(|(item, reply)| {
                Some((item.call.as_deref()?, reply, &item.source, item.origin))
            })
            .collect();
        let registered = answered.iter().any(|(call, ..)| registers(call));
        let Ok(recorded) = self.ledger.record(now, incarnation, &answered) else {
            return self.superseded(items);
        };
        if registered {
            self.judge.note_registration();
        }
        // A multicall that is answered with a fault may have changed something before.
        opaque |= recorded.doubtful && matches!(replies.as_slice(), [Reply::Fault { .. }]);
        if opaque {
            self.ledger.doubt();
            // Answers may be waiting already: after a failed read of the state, calls are sent before the next read.
            self.opaque.incarnation = incarnation;
            self.opaque.mark = self.opaque.mark.max(recorded.mark);
            let answers = items
                .into_iter()
                .filter(|item| !item.is_answered_first())
                .map(|item| (item, CallAnswer::Raw(raw.clone())));
            self.opaque.answers.extend(answers);
            return;
        }
        let answers: Vec<_> = match items.len() {
            1 => items.into_iter().zip([CallAnswer::Raw(raw)]).collect(),
            _ => items
                .into_iter()
                .zip(replies.into_iter().map(CallAnswer::Made))
                .collect(),
        };
        let version = recorded.is_ahead.then(|| self.ledger.unwritten()).flatten();
        self.answer(recorded.mark, version, answers);
    }

    /// Takes back a batch whose answers do not count, because the gate is about to open for another master.
    fn superseded(&mut self, items: Vec<Item>) {
        self.ledger.withdraw();
        self.take_back(items);
        self.exchange = Exchange::Lost;
    }

    /// Handles a batch whose reply is one answer instead of a result for each call.
    fn undeliverable(&mut self, now: Instant, incarnation: u64, items: Vec<Item>) {
        self.acknowledge(now, incarnation, &items, &[]);
        rarely!(
            warn,
            calls = items.len(),
            "the master did not answer each call of a multicall; callers retry, and the master's state is read again"
        );
        self.ledger.doubt();
        for item in items {
            item.reply(CallAnswer::Close);
        }
    }

    /// Answers the batch in flight, then the queue, from the mirror. Calls that only a master can answer wait.
    fn answer_from_mirror(&mut self, now: Instant) {
        if let Exchange::InFlight(batch) = &mut self.exchange {
            if now < *batch.grace.get_or_insert(now + GRACE) {
                return;
            }
            if let Work::Calls(items) = &batch.work {
                let calls: Vec<_> = items.iter().map(Item::describe).collect();
                rarely!(
                    info,
                    ?calls,
                    "these writes were in flight when the master went away; the mirror answers them"
                );
            }
            self.ledger.abandon_batch();
            self.take_back_in_flight();
        }
        // A master that comes back is examined only when this connection has ended, because only then can no call of
        // this connection still be running.
        self.actions.push(Action::Disconnect);
        let answerable = |(item, _): &mut (Item, CallAnswer)| item.is_answerable();
        let opaque = self.opaque.answers.extract_if(.., answerable);
        let opaque = opaque.map(|(item, _)| item).collect();
        self.take_back(opaque);
        self.answer_queue(now);
        self.ledger.withdraw();
        self.ledger.release(Order::calls_settled);
    }

    /// Answers from the mirror the batch that the master is late with, then the queue. The batch continues. When the
    /// master has answered it, the recovery gives the master the writes that it missed.
    fn answer_for_late_master(&mut self, now: Instant) {
        match &mut self.exchange {
            Exchange::InFlight(batch) => {
                match std::mem::replace(&mut batch.work, Work::AnsweredByMirror) {
                    Work::AnsweredByMirror => {}
                    Work::Inspection => {
                        // A read of the master's state was under way, and must be repeated.
                        self.inspections.request();
                        self.ledger.fall_behind(now, Vec::new(), true);
                    }
                    Work::Calls(items) => self.answer_late_batch(now, items),
                }
            }
            // The master has answered the batch just now.
            Exchange::Idle { .. } | Exchange::Lost => {
                self.ledger.fall_behind(now, Vec::new(), !self.has_left_out);
                self.late_ended(now, true);
            }
            Exchange::LateEnded => {}
        }
        self.answer_queue(now);
    }

    fn answer_late_batch(&mut self, now: Instant, items: Vec<Item>) {
        let mut answers = MirrorAnswers::default();
        let mut tells = Vec::new();
        for mut item in items {
            item.delivery = None;
            tells.extend_from_slice(item.concern().notified_subjects());
            if let Some(First { seq, .. }) = item.first() {
                self.ledger.note_left_out(*seq, item.concern());
                continue;
            }
            if let Some(item) = answers.add(&self.ledger, now, item) {
                self.queue.push_front(item);
            }
        }
        self.ledger.fall_behind(now, tells, !self.has_left_out);
        self.give(answers);
    }

    /// Answers the queue from the mirror. Calls that only a master can answer wait.
    fn answer_queue(&mut self, now: Instant) {
        // The mirror must not apply these again: they may have been in flight until now.
        self.leave_out_answered();
        let ledger = self.ledger.clone();
        let mut answers = MirrorAnswers::default();
        for item in std::mem::take(&mut self.queue) {
            if is_outdated(&ledger, &item) {
                item.reply(CallAnswer::Close);
                continue;
            }
            let Some(item) = merge::leave_out_conflicts(&ledger, item) else {
                continue;
            };
            if let Some(item) = answers.add(&ledger, now, item) {
                self.queue.push_back(item);
            }
        }
        self.give(answers);
    }

    /// Redirects all calls to the other computer that has the master.
    fn send_elsewhere(&mut self) {
        self.actions.push(Action::Disconnect);
        let in_flight = match std::mem::take(&mut self.exchange) {
            Exchange::InFlight(InFlight {
                work: Work::Calls(items),
                ..
            }) => items,
            _ => Vec::new(),
        };
        self.ledger.withdraw();
        self.ledger.release(Order::calls_settled);
        let opaque = std::mem::take(&mut self.opaque).answers;
        let items = in_flight.into_iter();
        let items = items.chain(opaque.into_iter().map(|(item, _)| item));
        for item in items.chain(self.queue.drain(..)) {
            item.reply(CallAnswer::Elsewhere);
        }
    }

    fn give(&mut self, answers: MirrorAnswers) {
        self.stats.calls_without_master.add(answers.count());
        self.answer(answers.mark, None, answers.made);
    }

    /// Answers callers once the effects of their calls are safe.
    fn answer(&mut self, mark: Mark, version: Option<u64>, made: Vec<(Item, CallAnswer)>) {
        if made.is_empty() {
            return;
        }
        let mut answers = Answers {
            mark: self.ledger.to_await(mark),
            version,
            made: Vec::new(),
        };
        for (item, answer) in made {
            answers.add(item, answer);
        }
        self.actions.push(Action::Answer(answers));
    }
}

impl Default for Exchange {
    fn default() -> Self {
        Self::Idle { not_before: None }
    }
}

impl InFlight {
    fn is_inspection(&self) -> bool {
        matches!(self.work, Work::Inspection)
    }
}

/// Answers from the mirror.
#[derive(Default)]
struct MirrorAnswers {
    made: Vec<(Item, CallAnswer)>,
    /// Identifies the last record that these answers may have to wait for.
    mark: Mark,
}

impl MirrorAnswers {
    /// Answers `item`, or returns it if only a master can answer it.
    fn add(&mut self, ledger: &Arc<Ledger>, now: Instant, mut item: Item) -> Option<Item> {
        let call = item.answerable();
        let answer = |call| {
            let (concern, source, origin) = (item.concern(), &item.source, item.origin);
            ledger.answer_client_from_mirror(now, call, concern, source, origin)
        };
        let Some((reply, mark, delivery)) = call.and_then(answer) else {
            return Some(item);
        };
        item.delivery = delivery;
        self.mark = self.mark.max(mark);
        self.made.push((item, CallAnswer::Made(reply)));
        None
    }

    fn count(&self) -> u64 {
        self.made.len() as u64
    }
}

/// Whether the mirror answers in place of a master that is away or does not know its state yet.
fn is_away(gate: State) -> bool {
    matches!(gate, State::StandingIn | State::Injecting)
}

/// Whether `call`, or an entry of it, registers something for a node.
fn registers(call: &Request) -> bool {
    Write::all(call).any(|write| write.registrant().is_some())
}

/// Whether `call`, or an entry of it, subscribes to a parameter. The reply contains the parameter's
/// value.
fn subscribes_params(call: &Request) -> bool {
    Write::all(call).any(|write| matches!(write.effect, Effect::SubscribeParam { .. }))
}

#[cfg(test)]
mod tests;
