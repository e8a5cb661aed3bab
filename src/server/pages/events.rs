//! `/events`: sends changes as server-sent events to a few listeners. Changes are looked for only while there are
//! listeners, once for all of them.

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
use rescue_core::health::Health;
use serde::Serialize;
use serde_json::{Map, Value};
use tokio::{
    sync::{mpsc, watch},
    task::AbortHandle,
};

use super::robot::Robot;
use crate::{
    gate::State,
    server::{
        Server,
        replies::{HttpReply, ReplyBody, text},
    },
};

/// Maximum number of listeners, because each holds a connection. Further pages poll the status.
const LISTENERS: usize = 16;
/// Time after which a listener must make room for a new one. The kernel accepts many events for a peer that never
/// reads, so a write does not show whether the listener reads. A browser reconnects.
const TURN: Duration = Duration::from_secs(15);
/// Pause between two checks for changes.
const PAUSE: Duration = Duration::from_millis(500);
/// Pause between two checks if another side answers calls now: the master, the mirror or another computer.
const SHORT_PAUSE: Duration = Duration::from_millis(50);
/// Time without changes after which the last events are sent again, so that both sides know that the other is alive.
const SILENCE: Duration = Duration::from_secs(15);
/// Tells a browser to reconnect this many milliseconds after losing its connection.
const BEGIN: &[u8] = b"retry: 1000\n\n";

/// Fields of the status that change all the time. They are sent as a separate event.
const LIVELY: [&str; 4] = ["counters", "pending_writes", "journal", "cluster"];
/// Fields of the status that are left out, because they may be long.
const LEFT_OUT: [&str; 5] = [
    "clients",
    "slowest_callers",
    "calls_per_second",
    "uptime",
    "node_health",
];

/// The latest event of each kind.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Latest {
    status: Bytes,
    now: Bytes,
}

/// Fields of the `now` event, in addition to [`LIVELY`].
#[derive(Debug, Serialize)]
struct Now {
    /// The gate's state: `open`, `standing_in`, `injecting`, `elsewhere` or `unknown`.
    gate: &'static str,
    /// Grows with every change of the state, including parameters.
    version: u64,
    /// Changes whenever nodes, topics or services change.
    registrations: u64,
    #[serde(flatten)]
    lively: Map<String, Value>,
}

/// Free bytes on the disk are rounded to multiples of this, so that not every byte is an event.
const DISK_STEP: u64 = 100_000_000;

/// The listeners and the latest events.
#[derive(Debug)]
pub(crate) struct Feed {
    latest: watch::Sender<Latest>,
    /// The listeners with the time of their start, oldest first.
    listeners: Mutex<VecDeque<(Instant, AbortHandle)>>,
    /// Whether a task is looking for changes.
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

/// Adds a listener, and returns the stream of events as the reply.
pub(super) fn listen(server: &Arc<Server>) -> HttpReply {
    let feed = &server.pages.state.feed;
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
    let task = crate::task::spawn(async move {
        tokio::select! {
            () = send_events(latest, &events) => {}
            () = events.closed() => {}
            () = stop.cancelled() => {}
        }
    });
    listeners.push_back((Instant::now(), task.abort_handle()));
    if !feed.running.swap(true, Ordering::AcqRel) {
        crate::task::spawn(watch_for_changes(server.clone()));
    }
    Response::new(ReplyBody::Events(body))
}

/// Sends new events. A listener that reads slowly misses outdated events.
async fn send_events(mut latest: watch::Receiver<Latest>, events: &mpsc::Sender<Bytes>) {
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

/// Watches for changes while there are listeners.
async fn watch_for_changes(server: Arc<Server>) {
    let pages = &server.pages;
    let mut gate = pages.gate.clone();
    let mut last = LastCheck::default();
    let mut shut = gate.observe();
    loop {
        let asked = server.clone();
        let look = move || {
            let latest = last.latest(&asked, shut);
            (last, latest)
        };
        let Ok((same, latest)) = crate::task::spawn_blocking(look).await else {
            // The task panicked. The next listener starts another one.
            pages.state.feed.running.store(false, Ordering::Release);
            break;
        };
        last = same;
        pages.state.feed.latest.send_if_modified(|before| {
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
        shut = gate.observe();
        if pages.state.feed.latest.receiver_count() == 0 {
            pages.state.feed.running.store(false, Ordering::Release);
            // A listener may have been added just before.
            let is_needed = pages.state.feed.latest.receiver_count() > 0;
            if !is_needed || pages.state.feed.running.swap(true, Ordering::AcqRel) {
                break;
            }
        }
    }
}

/// What the last check for changes has found.
#[derive(Default)]
struct LastCheck {
    version: Option<u64>,
    health: Vec<Health>,
    removed: usize,
    registrations: u64,
}

impl LastCheck {
    fn latest(&mut self, server: &Server, gate: State) -> Latest {
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
                State::Injecting | State::Frozen => "injecting",
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

/// Rounds values that would differ each time without a real change: times of day, which are computed from the present
/// time, and the free bytes of the disk.
fn settle(value: &mut Value) {
    match value {
        Value::Number(number) if number.is_f64() => {
            if let Some(seconds) = number.as_f64().filter(|seconds| *seconds > 1e9) {
                *value = ((seconds * 10.0).round() / 10.0).into();
            }
        }
        Value::Array(elements) => elements.iter_mut().for_each(settle),
        Value::Object(members) => {
            for (name, member) in members {
                match member.as_u64() {
                    Some(bytes) if name == "disk_free_bytes" => {
                        *member = (bytes / DISK_STEP * DISK_STEP).into();
                    }
                    _ => settle(member),
                }
            }
        }
        _ => {}
    }
}

/// Formats one event. JSON contains no newline.
fn event(name: &str, data: &impl Serialize) -> Bytes {
    let data = serde_json::to_string(data).unwrap_or_default();
    format!("event: {name}\ndata: {data}\n\n").into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_and_free_bytes_are_rounded_and_counters_are_not() {
        let mut status = serde_json::json!({
            "counters": {"calls": 100_000_007},
            "journal": {"disk_free_bytes": 123_456_789_012_u64},
            "nodes": [{"since": 1_764_528_823.123_456, "seconds": 0.123_456}],
        });
        settle(&mut status);
        let expected = serde_json::json!({
            "counters": {"calls": 100_000_007},
            "journal": {"disk_free_bytes": 123_400_000_000_u64},
            "nodes": [{"since": 1_764_528_823.1, "seconds": 0.123_456}],
        });
        assert_eq!(status, expected);
    }
}
