//! A client that makes calls all the time.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::{Reply, Value};

use super::support::{Client, Wire, http_request};

/// Pause between an answer, or a failure, and the next call.
const PAUSE: Duration = Duration::from_millis(1);

#[derive(Clone, Copy, Debug)]
struct Answer {
    /// When the call was made, and when the answer arrived.
    asked: Instant,
    at: Instant,
    success: bool,
}

/// All answers, and when they arrived.
#[derive(Debug, Default)]
struct Log {
    answers: Vec<Answer>,
    failures: Vec<Instant>,
    /// The number of the last call that succeeded.
    last: Option<i32>,
}

/// What a client saw in a span of time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// The longest time between two answers, in milliseconds.
    pub(crate) pause: f64,
    /// The longest time of a call that was answered, in milliseconds.
    pub(crate) longest: f64,
    /// The time until the first call that began in the span succeeded, in milliseconds.
    pub(crate) first: f64,
    /// Number of calls without an answer.
    pub(crate) failed: usize,
    /// Number of answers that report no success.
    pub(crate) refused: usize,
}

/// A client in a thread of its own.
#[derive(Debug)]
pub(crate) struct Caller {
    log: Arc<Mutex<Log>>,
    done: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Caller {
    /// Starts a client that calls `master` with what `call` returns for the number of the call. It uses one
    /// connection as long as that lasts.
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
                let request = http_request(&call(number));
                let asked = Instant::now();
                let answer = exchange(&master, &mut wire, &request);
                let at = Instant::now();
                let mut log = theirs.lock().expect("the log");
                match answer {
                    Some(success) => {
                        log.answers.push(Answer { asked, at, success });
                        if success {
                            log.last = Some(number);
                        }
                    }
                    None => {
                        wire = None;
                        log.failures.push(at);
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

    /// Whether a call that began after `then` has been answered.
    pub(crate) fn answered_since(&self, then: Instant) -> bool {
        let log = self.log.lock().expect("the log");
        log.answers.last().is_some_and(|answer| answer.asked > then)
    }

    /// The number of the last call that succeeded.
    pub(crate) fn last(&self) -> Option<i32> {
        self.log.lock().expect("the log").last
    }

    /// What the client has seen since `begin`.
    pub(crate) fn seen_since(&self, begin: Instant) -> Seen {
        let ms = |time: Option<Duration>| time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3);
        let log = self.log.lock().expect("the log");
        let pauses = log.answers.windows(2).filter(|pair| pair[1].at > begin);
        let pauses = pauses.map(|pair| pair[1].at.duration_since(pair[0].at));
        let since: Vec<_> = log.answers.iter().filter(|of| of.at > begin).collect();
        let first = since.iter().find(|of| of.asked > begin && of.success);
        Seen {
            pause: ms(pauses.max()),
            longest: ms(since.iter().map(|of| of.at.duration_since(of.asked)).max()),
            first: ms(first.map(|of| of.at.duration_since(begin))),
            failed: log.failures.iter().filter(|at| **at > begin).count(),
            refused: since.iter().filter(|of| !of.success).count(),
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

/// Makes a call. Returns whether it succeeded, or `None` if there was no answer.
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
