//! A client that calls all the time.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use rosrescue::xmlrpc::{Reply, Value};

use crate::shared::support::{Client, Wire, http_request};

/// Between an answer, or a failure, and the next call.
const PAUSE: Duration = Duration::from_millis(1);

/// When the answers came, and what they were.
#[derive(Debug, Default)]
struct Log {
    /// Whether the answer was a success.
    answers: Vec<(Instant, bool)>,
    failures: Vec<Instant>,
}

/// What a client saw in a span of time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// The longest time between two answers, in milliseconds.
    pub(crate) pause: f64,
    /// Calls without an answer.
    pub(crate) failed: usize,
    /// Answers that were no success.
    pub(crate) refused: usize,
}

/// The client, in a thread of its own.
#[derive(Debug)]
pub(crate) struct Caller {
    log: Arc<Mutex<Log>>,
    done: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Caller {
    /// Starts one that sends to `master` what `call` makes of the number of the call, on one connection for
    /// as long as it lasts.
    pub(crate) fn start(master: Client, call: impl Fn(i32) -> Vec<u8> + Send + 'static) -> Self {
        let log = Arc::new(Mutex::new(Log::default()));
        let done = Arc::new(AtomicBool::new(false));
        let (theirs, end) = (log.clone(), done.clone());
        let thread = thread::spawn(move || {
            let mut wire = None;
            for number in 0.. {
                if end.load(Ordering::Relaxed) {
                    return;
                }
                let answer = exchange(&master, &mut wire, &http_request(&call(number)));
                let now = Instant::now();
                let mut log = theirs.lock().expect("the log");
                match answer {
                    Some(success) => log.answers.push((now, success)),
                    None => {
                        wire = None;
                        log.failures.push(now);
                    }
                }
                drop(log);
                thread::sleep(PAUSE);
            }
        });
        Self {
            log,
            done,
            thread: Some(thread),
        }
    }

    /// Whether an answer has come since `then`.
    pub(crate) fn answered_since(&self, then: Instant) -> bool {
        let log = self.log.lock().expect("the log");
        log.answers.last().is_some_and(|(at, _)| *at > then)
    }

    /// What it saw since `begin`.
    pub(crate) fn seen_since(&self, begin: Instant) -> Seen {
        let log = self.log.lock().expect("the log");
        let pauses = log.answers.windows(2).filter(|pair| pair[1].0 > begin);
        let longest = pauses.map(|pair| pair[1].0.duration_since(pair[0].0)).max();
        let since = log.answers.iter().filter(|(at, _)| *at > begin);
        Seen {
            pause: longest.map_or(f64::NAN, |longest| longest.as_secs_f64() * 1e3),
            failed: log.failures.iter().filter(|at| **at > begin).count(),
            refused: since.filter(|(_, success)| !success).count(),
        }
    }
}

impl Drop for Caller {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Whether the call was a success; nothing if it got no answer.
fn exchange(master: &Client, wire: &mut Option<Wire>, request: &[u8]) -> Option<bool> {
    if wire.is_none() {
        *wire = master.connect().ok();
    }
    let wire = wire.as_mut()?;
    wire.send(request).ok()?;
    let reply = wire.response().ok()?.reply();
    let Reply::Value(Value::Array(fields)) = reply else {
        return Some(false);
    };
    Some(fields.first() == Some(&Value::Int(1)))
}
