//! `/events`: what changes, as server-sent events, to a few listeners. There is work only while somebody
//! listens, and it is done once for all of them.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use bytes::Bytes;
use hyper::{Response, StatusCode};
use serde::Serialize;
use serde_json::{Map, Value};
use tokio::{
    sync::{mpsc, watch},
    task::AbortHandle,
};

use super::robot::Robot;
use crate::{
    gate::State,
    health::Health,
    server::{
        Server,
        replies::{Content, HttpReply, text},
    },
};

/// Most listeners. Each holds a connection; more pages ask for the status now and then.
const LISTENERS: usize = 16;
/// After this time a listener gives its place to one that has none. The kernel takes many events for a peer that never
/// reads, so a write does not show whether a listener reads. A browser that is ended comes again.
const TURN: Duration = Duration::from_secs(15);
/// Pause between two looks.
const PAUSE: Duration = Duration::from_millis(500);
/// Shortest pause, when the gate moves.
const SHORT_PAUSE: Duration = Duration::from_millis(50);
/// Without news for so long, the old ones are sent: both sides see that the other one is there.
const SILENCE: Duration = Duration::from_secs(15);
/// A browser that has lost its connection comes again after so many milliseconds.
const BEGIN: &[u8] = b"retry: 1000\n\n";

/// Members of the status that change all the time, and are sent apart from the rest.
const LIVELY: [&str; 4] = ["counters", "pending_writes", "journal", "cluster"];
/// Members of the status that are left out: there may be many.
const LEFT_OUT: [&str; 4] = ["clients", "slowest_callers", "calls_per_second", "uptime"];

/// The latest of each kind of event.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Latest {
    status: Bytes,
    now: Bytes,
}

/// Members of `now` beside those of [`LIVELY`].
#[derive(Debug, Serialize)]
struct Now {
    /// Where calls go: `open`, `standing_in`, `injecting`, `elsewhere` or `unknown`.
    gate: &'static str,
    /// Grows with every change of the state, parameters included.
    version: u64,
    /// Another number means that nodes, topics or services have changed.
    registrations: u64,
    #[serde(flatten)]
    lively: Map<String, Value>,
}

/// Listeners are told of a disk's free bytes in such steps.
const DISK_STEP: u64 = 100_000_000;

/// Listeners and what they are told.
#[derive(Debug)]
pub(crate) struct Feed {
    latest: watch::Sender<Latest>,
    /// The listeners and their beginnings, the oldest first.
    listeners: Mutex<VecDeque<(Instant, AbortHandle)>>,
    /// Somebody looks for news.
    running: AtomicBool,
}

impl Default for Feed {
    fn default() -> Self {
        Self {
            latest: watch::Sender::default(),
            listeners: Mutex::default(),
            running: AtomicBool::new(false),
        }
    }
}

/// The reply to somebody who wants to listen.
pub(super) fn listen(server: &Arc<Server>) -> HttpReply {
    let feed = &server.pages.desk.feed;
    let listeners = feed.listeners.lock();
    let mut listeners = listeners.unwrap_or_else(PoisonError::into_inner);
    listeners.retain(|(_, task)| !task.is_finished());
    if listeners.len() >= LISTENERS {
        let oldest = listeners.front();
        let Some((_, task)) = oldest.filter(|(begin, _)| begin.elapsed() >= TURN) else {
            return text(
                StatusCode::SERVICE_UNAVAILABLE,
                format!("{LISTENERS} listen already; ask for /status.json now and then\n"),
            );
        };
        task.abort();
        listeners.pop_front();
    }
    let (events, body) = mpsc::channel(1);
    let mut latest = feed.latest.subscribe();
    latest.mark_changed();
    let stop = server.pages.stop.clone();
    let task = tokio::spawn(async move {
        tokio::select! {
            () = tell(latest, &events) => {}
            () = events.closed() => {}
            () = stop.cancelled() => {}
        }
    });
    listeners.push_back((Instant::now(), task.abort_handle()));
    if !feed.running.swap(true, Ordering::AcqRel) {
        tokio::spawn(look(server.clone()));
    }
    Response::new(Content::Events(body))
}

/// Sends what is new. A listener that reads slowly misses what is outdated.
async fn tell(mut latest: watch::Receiver<Latest>, events: &mpsc::Sender<Bytes>) {
    let mut sent = Latest::default();
    let mut next = Bytes::from_static(BEGIN);
    while events.send(next).await.is_ok() {
        next = loop {
            let news = tokio::time::timeout(SILENCE, latest.changed()).await;
            match news {
                Ok(Ok(())) => {}
                Ok(Err(_)) => return,
                Err(_) => break sent.now.clone(),
            }
            let Latest { status, now } = latest.borrow_and_update().clone();
            let mut news = Vec::new();
            for (old, new) in [(&mut sent.status, status), (&mut sent.now, now)] {
                if *old != new {
                    news.extend_from_slice(&new);
                    *old = new;
                }
            }
            if !news.is_empty() {
                break news.into();
            }
        };
    }
}

/// Looks for news as long as somebody listens.
async fn look(server: Arc<Server>) {
    let pages = &server.pages;
    let mut gate = pages.gate.clone();
    let mut known = Known::default();
    let mut shut = gate.look();
    loop {
        let asked = server.clone();
        let look = move || {
            let latest = known.look(&asked, shut);
            (known, latest)
        };
        let Ok((same, latest)) = tokio::task::spawn_blocking(look).await else {
            // It panicked. The next listener starts another one.
            pages.desk.feed.running.store(false, Ordering::Release);
            break;
        };
        known = same;
        pages.desk.feed.latest.send_if_modified(|before| {
            let is_new = *before != latest;
            *before = latest;
            is_new
        });
        tokio::select! {
            () = pages.stop.cancelled() => break,
            () = async {
                tokio::time::sleep(SHORT_PAUSE).await;
                let _ = tokio::time::timeout(PAUSE - SHORT_PAUSE, gate.changed()).await;
            } => {}
        }
        shut = gate.look();
        if pages.desk.feed.latest.receiver_count() == 0 {
            pages.desk.feed.running.store(false, Ordering::Release);
            // Somebody may have come just before that.
            let is_needed = pages.desk.feed.latest.receiver_count() > 0;
            if !is_needed || pages.desk.feed.running.swap(true, Ordering::AcqRel) {
                break;
            }
        }
    }
}

/// What the last look has found.
#[derive(Default)]
struct Known {
    version: Option<u64>,
    health: Vec<Health>,
    removed: usize,
    registrations: u64,
}

impl Known {
    fn look(&mut self, server: &Server, gate: State) -> Latest {
        let pages = &server.pages;
        let version = pages.ledger.version();
        let lives = pages.nodes.lives();
        let health: Vec<_> = lives.values().map(|life| life.health).collect();
        let removed = pages.nodes.removed.list().len();
        let is_same =
            self.version == Some(version) && (&self.health, self.removed) == (&health, removed);
        if !is_same {
            let robot = Robot::read(&pages.ledger, &pages.nodes);
            self.registrations = robot.digest();
        }
        (self.version, self.health, self.removed) = (Some(version), health, removed);
        let mut status = serde_json::to_value(pages.status()).unwrap_or_default();
        settle(&mut status);
        let Value::Object(mut status) = status else {
            return Latest::default();
        };
        let mut lively = Map::new();
        for name in LIVELY {
            lively.extend(
                status
                    .shift_remove(name)
                    .map(|value| (name.to_owned(), value)),
            );
        }
        for name in LEFT_OUT {
            status.shift_remove(name);
        }
        let now = Now {
            gate: match gate {
                State::Open { .. } => "open",
                State::StandingIn | State::Late => "standing_in",
                State::Injecting => "injecting",
                State::Elsewhere => "elsewhere",
                State::Unknown => "unknown",
            },
            version,
            registrations: self.registrations,
            lively,
        };
        Latest {
            status: event("status", &status),
            now: event("now", &now),
        }
    }
}

/// Times of day, which are counted back from now, differ a little each time, and so does a disk's room.
fn settle(value: &mut Value) {
    match value {
        Value::Number(number) if number.is_f64() => {
            if let Some(seconds) = number.as_f64().filter(|seconds| *seconds > 1e9) {
                *value = ((seconds * 10.0).round() / 10.0).into();
            }
        }
        Value::Number(number) => {
            if let Some(bytes) = number.as_u64().filter(|bytes| *bytes > DISK_STEP) {
                *value = (bytes / DISK_STEP * DISK_STEP).into();
            }
        }
        Value::Array(elements) => elements.iter_mut().for_each(settle),
        Value::Object(members) => members.values_mut().for_each(settle),
        _ => {}
    }
}

/// One event. JSON has no newline in it.
fn event(name: &str, data: &impl Serialize) -> Bytes {
    let data = serde_json::to_string(data).unwrap_or_default();
    format!("event: {name}\ndata: {data}\n\n").into()
}
