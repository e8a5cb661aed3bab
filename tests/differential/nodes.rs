//! Nodes that record every callback they get.

use std::cell::Cell;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ros1_master::{
    master::Notice,
    xmlrpc::{Call, Reply, Struct, Value, decode_call},
};

use crate::oracle::Heard;
use crate::support::{FakeMaster, is_from_rosrescue, sorted, unordered};

thread_local! {
    /// Whether a failure was found, so that only a shorter script is searched for. Each test has its own thread, so
    /// that the failure of one test does not hurry the others.
    pub(crate) static HURRIED: Cell<bool> = const { Cell::new(false) };
}

/// Longest wait for callbacks. rosmaster's notifier threads look for work ten times a second.
pub(crate) fn patience() -> Duration {
    Duration::from_secs(if HURRIED.get() { 3 } else { 60 })
}

/// The calls of the health check.
const QUESTIONS: [&str; 3] = ["getPid", "getPublications", "getSubscriptions"];

/// A node that records callbacks.
pub(crate) struct Node {
    pub(crate) api: String,
    heard: Arc<Mutex<Vec<Heard>>>,
    _server: FakeMaster,
}

impl Node {
    pub(crate) fn start() -> Self {
        let heard = Arc::new(Mutex::new(Vec::new()));
        let notes = Arc::clone(&heard);
        let server = FakeMaster::start_with_heads(move |head, body| {
            let call = decode_call(body).unwrap();
            // A call of the health check changes nothing in a node. The fault proves that the node lives, and reports
            // no registrations, because those in the master are random.
            let reply = if QUESTIONS.contains(&call.method.as_str()) {
                let text = "no such method".to_owned();
                Reply::Fault { code: 1, text }
            } else {
                notes.lock().unwrap().push(Heard {
                    call: blank(call),
                    by_rosrescue: is_from_rosrescue(head),
                });
                Reply::Value(vec![Value::Int(1), "".into(), 0.into()].into())
            };
            FakeMaster::proper(&reply)
        });
        Self {
            api: format!("http://127.0.0.1:{}/", server.port()),
            heard,
            _server: server,
        }
    }

    /// Waits for a callback that `last` accepts, and takes all callbacks so far.
    pub(crate) fn take(&self, last: impl Fn(&Call) -> bool) -> Result<Vec<Heard>, String> {
        let deadline = Instant::now() + patience();
        loop {
            let mut heard = self.heard.lock().unwrap();
            if heard.iter().any(|it| last(&it.call)) {
                return Ok(std::mem::take(&mut *heard));
            }
            if Instant::now() > deadline {
                return Err(format!("the last callback did not come: {heard:?}"));
            }
            drop(heard);
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Takes the callbacks so far.
    pub(crate) fn take_now(&self) -> Vec<Heard> {
        std::mem::take(&mut *self.heard.lock().unwrap())
    }
}

/// The receiver and the call of a callback. Structs are left out: rosmaster encodes a callback when it sends it, and a
/// dict of the parameter tree may have changed by then.
pub(crate) fn as_call(notice: &Notice) -> (&str, Call) {
    let master = || Value::from("/master");
    match notice {
        Notice::PublisherUpdate {
            to,
            topic,
            publishers,
        } => {
            let params = vec![master(), topic.as_str().into(), publishers.clone().into()];
            (to, Call::new("publisherUpdate", params))
        }
        Notice::ParamUpdate { to, key, value } => {
            let params = vec![master(), key.as_str().into(), value.clone()];
            (to, blank(Call::new("paramUpdate", params)))
        }
        Notice::Shutdown { to, reason } => (
            to,
            Call::new("shutdown", vec![master(), reason.as_str().into()]),
        ),
    }
}

pub(crate) fn blank(mut call: Call) -> Call {
    for param in &mut call.params {
        match param {
            Value::Struct(members) => *members = Struct::new(),
            list if unordered() => *list = sorted(list),
            _ => {}
        }
    }
    call
}
