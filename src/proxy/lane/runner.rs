//! The one who travels.

use std::{
    collections::{BTreeSet, VecDeque},
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::mpsc;

use super::overtaken::is_overtaken;
use crate::{
    cli::Sync,
    master::{Kind, Master},
    proxy::{
        Proxy,
        flight::{Cargo, Landed, travel},
        gate::{StandIn, State},
        journey::{self, Answer, LaneItem, TravelError},
        look::LookError,
        upstream::{CallError, Connection, RawReply},
    },
    wait,
    xmlrpc::{self, Call, Reply},
};

/// Pause before a failed journey is tried again while the gate stays open: whoever watches the
/// master needs a moment to see why it failed.
const RETRY_PAUSE: Duration = Duration::from_millis(20);
/// A call that gets no reply so often is given up and its connection closed: a master that breaks
/// off each reply must not hold up the lane for ever.
const ATTEMPTS: u32 = 3;
/// Pause before a master that could not be looked at is looked at again.
const LOOK_PAUSE: Duration = Duration::from_secs(1);
/// Calls on their way to the master, or a resync if there are none.
struct Flight {
    incarnation: u64,
    /// Of the mirror, when it took off.
    version: u64,
    items: Vec<LaneItem>,
    landing: Pin<Box<dyn Future<Output = Landed> + Send>>,
}

/// The single traveller.
pub struct LaneRunner {
    items: mpsc::Receiver<LaneItem>,
    max_parked: usize,
    queue: VecDeque<LaneItem>,
    connection: Option<(u64, Connection)>,
    flight: Option<Flight>,
    /// The one that was open last.
    incarnation: u64,
    resync_due: bool,
    /// When a resync is due that could not be made before.
    resync_at: Option<tokio::time::Instant>,
    retry_at: Option<tokio::time::Instant>,
    /// Calls that we do not understand, answered with success: the answers wait until the mirror
    /// has been made anew, and knows what the calls did.
    opaque: Opaque,
}

#[derive(Default)]
struct Opaque {
    incarnation: u64,
    answers: Vec<(LaneItem, Answer)>,
    /// The journal's last record of them.
    seq: Option<u64>,
}

impl LaneRunner {
    /// A runner of the calls that come by `items`.
    pub(super) fn new(items: mpsc::Receiver<LaneItem>, max_parked: usize) -> Self {
        Self {
            items,
            max_parked,
            queue: VecDeque::new(),
            connection: None,
            flight: None,
            incarnation: 0,
            resync_due: false,
            resync_at: None,
            retry_at: None,
            opaque: Opaque::default(),
        }
    }

    /// Runs until every [`Lane`](super::Lane) is gone.
    pub async fn run(mut self, proxy: Arc<Proxy>) {
        let mut gate = proxy.gate.clone();
        let mut resync = proxy.config.resync_interval.map(tokio::time::interval);
        loop {
            tokio::select! {
                item = self.items.recv() => match item {
                    Some(item) => self.queue.push_back(item),
                    None => return,
                },
                () = gate.changed() => self.retry_at = None,
                landed = wait::for_some(self.flight.as_mut().map(|flight| &mut flight.landing)) => {
                    // A look that takes longer than the interval must leave time for calls.
                    if matches!(landed.result, Ok(Cargo::Resynced(_))) && let Some(resync) = &mut resync {
                        resync.reset();
                    }
                    self.landed(&proxy, landed);
                }
                () = wait::until(self.retry_at) => self.retry_at = None,
                () = wait::tick(&mut resync) => {
                    self.resync_due |= self.flight.as_ref().is_none_or(|flight| !flight.items.is_empty());
                }
                () = wait::until(self.resync_at) => {
                    self.resync_at = None;
                    self.resync_due = true;
                }
            }
            while let Ok(item) = self.items.try_recv() {
                self.queue.push_back(item);
            }
            self.forget_abandoned();
            match gate.look() {
                State::Open { incarnation } => self.depart(&proxy, incarnation),
                State::Shut(StandIn::Unregistrations) => self.unregister(&proxy),
                State::Shut(_) => {}
            }
        }
    }

    /// A client that has gone away, or was sent away, will ask again; but nobody says twice that it
    /// unregisters.
    fn forget_abandoned(&mut self) {
        let crowded = self.queue.len() > 2 * self.max_parked;
        self.queue
            .retain(|item| !item.answer.is_closed() || (item.kind == Kind::Unregister && !crowded));
    }

    /// Starts the next flight, if there is none and something to carry.
    fn depart(&mut self, proxy: &Arc<Proxy>, incarnation: u64) {
        if let Some(flight) = self
            .flight
            .take_if(|flight| flight.incarnation != incarnation)
        {
            // Its master has been succeeded, and the new one never saw these calls.
            self.take_back(flight.items);
        }
        if self.opaque.incarnation != incarnation {
            let opaque = std::mem::take(&mut self.opaque).answers;
            self.take_back(opaque.into_iter().map(|(item, _)| item).collect());
        }
        if std::mem::replace(&mut self.incarnation, incarnation) != incarnation {
            // What was doubted is gone.
            self.resync_due = false;
        }
        self.resync_due |= proxy.shadow.take_doubt();
        if self.flight.is_some() || self.retry_at.is_some() {
            return;
        }
        while let Some(own) = self.queue.front()
            && is_overtaken(proxy, own)
            && let Some(own) = self.queue.pop_front()
        {
            let _ = own.answer.send(Answer::Close);
        }
        let items = if self.resync_due {
            Vec::new()
        } else {
            journey::pack(&mut self.queue)
        };
        if items.is_empty() && !self.resync_due {
            return;
        }
        self.resync_due = false;
        self.resync_at = None;
        let connection = self
            .connection
            .take()
            .filter(|(of, connection)| *of == incarnation && !connection.is_closed());
        proxy.stats.journeys.count();
        let landing = Box::pin(travel(proxy.clone(), incarnation, connection, &items));
        self.flight = Some(Flight {
            incarnation,
            version: proxy.shadow.version(),
            items,
            landing,
        });
    }

    fn landed(&mut self, proxy: &Arc<Proxy>, landed: Landed) {
        let Some(Flight {
            incarnation,
            version,
            items,
            ..
        }) = self.flight.take()
        else {
            return;
        };
        self.connection = landed.connection;
        match landed.result {
            Ok(Cargo::Resynced(state)) => self.resync(proxy, incarnation, version, *state),
            Ok(Cargo::Reply(raw)) => self.deliver(proxy, incarnation, items, raw),
            Err(error) => self.failed(proxy, incarnation, items, &error),
        }
    }

    fn resync(&mut self, proxy: &Arc<Proxy>, incarnation: u64, version: u64, state: Master) {
        let Ok(difference) = proxy.shadow.adopt_if(incarnation, version, state) else {
            // The gate was shut meanwhile, and the mirror has taken what this look does not show.
            self.resync_due = true;
            return;
        };
        if !difference.is_empty() {
            tracing::warn!(
                ?difference,
                "the master differed from the mirror, which was made anew from it"
            );
        }
        self.answer_opaque(proxy);
    }

    fn answer_opaque(&mut self, proxy: &Arc<Proxy>) {
        let Opaque { answers, seq, .. } = std::mem::take(&mut self.opaque);
        send(proxy, seq, proxy.shadow.unwritten(), answers);
    }

    fn failed(
        &mut self,
        proxy: &Arc<Proxy>,
        incarnation: u64,
        mut items: Vec<LaneItem>,
        error: &TravelError,
    ) {
        tracing::debug!(%error, calls = items.len(), "journey");
        let now = tokio::time::Instant::now();
        self.retry_at = Some(now + RETRY_PAUSE);
        if items.is_empty() {
            match error {
                TravelError::Connect(_) => self.resync_due = true,
                _ => self.resync_at = Some(now + LOOK_PAUSE),
            }
            if matches!(error, TravelError::Look(LookError::NotAMaster(_))) {
                // It lives and shows nothing: a client need not wait for that.
                self.answer_opaque(proxy);
            }
            return;
        }
        let sent =
            matches!(error, TravelError::Call(error) if !matches!(error, CallError::NotSent(_)));
        if sent && proxy.shadow.incarnation() == incarnation {
            // The master may live, and have done all of it.
            self.resync_due = true;
            let calls = items.iter().filter_map(|item| item.call.as_ref());
            let foretold = proxy.shadow.foretell(calls);
            let calls = items.iter_mut().filter(|item| item.call.is_some());
            for (item, foretold) in calls.zip(foretold) {
                item.foretold.get_or_insert(foretold);
            }
        }
        let mut again = Vec::with_capacity(items.len());
        for mut item in items {
            item.attempts += u32::from(sent);
            if item.attempts < ATTEMPTS {
                again.push(item);
            } else {
                tracing::warn!(%error, caller_id = item.caller(), "gave up a call");
                let _ = item.answer.send(Answer::Close);
            }
        }
        self.take_back(again);
    }

    fn take_back(&mut self, items: Vec<LaneItem>) {
        for item in items.into_iter().rev() {
            self.queue.push_front(item);
        }
    }

    /// Records what the master answered, and only then answers the clients.
    fn deliver(
        &mut self,
        proxy: &Arc<Proxy>,
        incarnation: u64,
        items: Vec<LaneItem>,
        raw: RawReply,
    ) {
        let reply = xmlrpc::decode_reply(&raw.body)
            .ok()
            .filter(|_| raw.status.is_success());
        let mut opaque = false;
        let replies = match (items.as_slice(), reply) {
            ([item], Some(reply)) => {
                opaque = item.call.is_none() && matches!(reply, Reply::Value(_));
                vec![reply]
            }
            // What we cannot read may have changed anything, and only a look shows what. A subscription
            // of parameters no look shows: it is recorded as if it had gone as foretold.
            ([item], None) if raw.status.is_success() => {
                opaque = true;
                let call = item.call.iter().filter(|call| subscribes_params(call));
                proxy.shadow.foretell(call)
            }
            ([_], None) => Vec::new(),
            (_, Some(reply)) => match journey::unpack(&reply, items.len()) {
                Some(replies) => replies,
                None => return self.undeliverable(items),
            },
            (_, None) => return self.undeliverable(items),
        };
        let travelled: Vec<_> = items
            .iter()
            .zip(&replies)
            .filter_map(|(item, reply)| Some((item.call.as_ref()?, reply)))
            .collect();
        let Ok(recorded) = proxy.shadow.record(Instant::now(), incarnation, &travelled) else {
            return self.take_back(items);
        };
        self.resync_due |= recorded.doubtful || opaque;
        if opaque {
            // Others may be held already: after a look that failed calls travel before the next one.
            self.opaque.incarnation = incarnation;
            self.opaque.seq = self.opaque.seq.max(recorded.seq);
            let answers = items
                .into_iter()
                .map(|item| (item, Answer::Raw(raw.clone())));
            self.opaque.answers.extend(answers);
            return;
        }
        let alone = items.len() == 1;
        let replies = replies.into_iter().map(Some).chain(std::iter::repeat(None));
        let answers: Vec<_> = items
            .into_iter()
            .zip(replies)
            .map(|(item, reply)| {
                let first = reply.as_ref().and_then(|reply| item.done_before(reply));
                let answer = match first.or_else(|| reply.filter(|_| !alone)) {
                    Some(reply) => Answer::Made(reply),
                    None => Answer::Raw(raw.clone()),
                };
                (item, answer)
            })
            .collect();
        send(proxy, recorded.seq, None, answers);
    }

    /// A multicall of ours was answered as a whole by something else than its results. The calls
    /// can be told apart only if they travel alone.
    fn undeliverable(&mut self, items: Vec<LaneItem>) {
        tracing::warn!(
            calls = items.len(),
            "the master did not answer each call of a multicall"
        );
        self.resync_due = true;
        for item in items {
            let _ = item.answer.send(Answer::Close);
        }
    }

    /// Answers unregistrations from the mirror, unless registrations of the same nodes are under way
    /// before them.
    fn unregister(&mut self, proxy: &Arc<Proxy>) {
        let parked = self.queue.iter().filter_map(|item| item.call.as_ref());
        proxy.shadow.note_parked(parked);
        if !self.queue.iter().any(|item| item.kind == Kind::Unregister) {
            return;
        }
        let flying = self.flight.as_ref().map_or(&[][..], |flight| &flight.items);
        let mut busy: BTreeSet<String> = flying.iter().flat_map(LaneItem::registrants).collect();
        let mut waiting = VecDeque::with_capacity(self.queue.len());
        let (mut last, mut answers) = (None, Vec::new());
        for item in self.queue.drain(..) {
            if is_overtaken(proxy, &item) {
                let _ = item.answer.send(Answer::Close);
                continue;
            }
            let registrants = item.registrants();
            if item.kind == Kind::Unregister
                && busy.is_disjoint(&registrants)
                && let Some(call) = &item.call
                && let Some((reply, seq)) = proxy.shadow.unregister(Instant::now(), call)
            {
                proxy.stats.stood_in.count();
                last = last.max(seq);
                answers.push((item, Answer::Made(reply)));
            } else {
                busy.extend(registrants);
                waiting.push_back(item);
            }
        }
        self.queue = waiting;
        send(proxy, last, None, answers);
    }
}

/// Sends answers when what they tell of is safe: the journal up to `seq` is on the disk, if `--sync` wants
/// that, and the mirror of this version in a whole checkpoint.
fn send(
    proxy: &Arc<Proxy>,
    seq: Option<u64>,
    version: Option<u64>,
    answers: Vec<(LaneItem, Answer)>,
) {
    let seq = seq.filter(|_| proxy.config.sync == Sync::Always);
    let send = move || {
        for (item, answer) in answers {
            let _ = item.answer.send(answer);
        }
    };
    if (seq, version) == (None, None) {
        return send();
    }
    let proxy = proxy.clone();
    tokio::spawn(async move {
        if let Some(seq) = seq {
            proxy.shadow.durable(seq).await;
        }
        if let Some(version) = version {
            proxy.shadow.attempted(version).await;
        }
        send();
    });
}

/// Whether `call`, or an entry of it, subscribes a parameter. Its reply holds the parameter's value.
fn subscribes_params(call: &Call) -> bool {
    let entries = call.entries();
    let mut calls = entries.iter().chain([call]);
    calls.any(|call| call.method == "subscribeParam")
}
