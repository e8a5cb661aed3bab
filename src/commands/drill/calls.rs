//! Calls the Master API continuously, as nodes do, and measures how long each call takes.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::{Call, Value};
use serde::Serialize;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::node::NodeLog;
use crate::nodes::client::{self, Reaction};

/// Longest time for a call. A call that takes longer has failed, because rosrescue answers all calls sooner.
const LIMIT: Duration = Duration::from_secs(10);
/// Pause between two calls of a loop.
const PAUSE: Duration = Duration::from_millis(5);
/// Maximum number of failures that are reported.
const MOST: usize = 5;

/// The Master API at an address, called by one node.
#[derive(Clone, Debug)]
pub(super) struct Api {
    pub(super) uri: String,
    pub(super) caller: String,
}

/// An answer, with how long it took.
struct Answer {
    value: Result<Value, String>,
    /// Whether the answer says that the call failed, as for a name that does not exist.
    is_refused: bool,
    took: Duration,
    /// Whether the connection broke and the call was repeated, as rospy and roscpp do.
    again: bool,
}

impl Api {
    async fn timed_call(&self, method: &str, params: &[Value]) -> Answer {
        let own = std::iter::once(Value::from(self.caller.as_str()));
        let call = Call::new(method, own.chain(params.iter().cloned()).collect());
        let start = Instant::now();
        let mut again = false;
        loop {
            let (sign, value) = client::call_for_value(&self.uri, &call, LIMIT).await;
            let took = start.elapsed();
            let is_refused = (sign, &value) == (Reaction::Alive, &None);
            let value = match (sign, value) {
                (_, Some(value)) => Ok(value),
                (Reaction::Alive, None) => Err("was refused".to_owned()),
                (Reaction::Dead, None) => Err("found no listener".to_owned()),
                (Reaction::Silent, None) if took >= LIMIT => {
                    Err(format!("had no answer in {} s", LIMIT.as_secs()))
                }
                (Reaction::Silent, None) if !again => {
                    again = true;
                    continue;
                }
                (Reaction::Silent, None) => Err("lost its connection twice".to_owned()),
            };
            let value = value.map_err(|why| {
                let first = params.first().and_then(Value::as_str).unwrap_or_default();
                format!("{method}({first}) {why}")
            });
            return Answer {
                value,
                is_refused,
                took,
                again,
            };
        }
    }

    pub(super) async fn call(&self, method: &str, params: &[Value]) -> Result<Value, String> {
        self.timed_call(method, params).await.value
    }

    /// The address of a node. `None` if no node has this name.
    pub(super) async fn lookup_node(&self, name: &str) -> Result<Option<String>, String> {
        let answer = self.timed_call("lookupNode", &[name.into()]).await;
        match answer.value {
            Ok(api) => Ok(Some(api.as_str().unwrap_or_default().to_owned())),
            Err(_) if answer.is_refused => Ok(None),
            Err(why) => Err(why),
        }
    }
}

/// Results of all calls of one kind.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Waits {
    pub(super) calls: u64,
    pub(super) longest_ms: f64,
    /// Number of calls that were repeated because the connection had broken.
    pub(super) again: u64,
    pub(super) failed: u64,
    /// The first failures, at most [`MOST`].
    pub(super) failures: Vec<String>,
}

impl Waits {
    fn succeed(&mut self, took: Duration) {
        self.calls += 1;
        self.longest_ms = self.longest_ms.max(took.as_secs_f64() * 1e3);
    }

    fn fail(&mut self, why: String) {
        self.failed += 1;
        if self.failures.len() < MOST {
            self.failures.push(why);
        }
    }

    fn add(&mut self, answer: Answer) -> Option<Value> {
        self.succeed(answer.took);
        self.again += u64::from(answer.again);
        answer.value.map_err(|why| self.fail(why)).ok()
    }

    fn merge(mut self, other: Self) -> Self {
        self.calls += other.calls;
        self.longest_ms = self.longest_ms.max(other.longest_ms);
        self.again += other.again;
        self.failed += other.failed;
        self.failures.extend(other.failures);
        self.failures.truncate(MOST);
        self
    }
}

/// Results of all calls.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct CallResults {
    pub(super) reads: Waits,
    pub(super) writes: Waits,
    /// Times from a write to the notification of its subscriber.
    pub(super) notifications: Waits,
}

/// What the callers need. All of it belongs to the drill.
#[derive(Clone, Debug)]
pub(super) struct Callers {
    pub(super) api: Api,
    /// Address of the drill's node.
    pub(super) node_api: String,
    pub(super) log: Arc<NodeLog>,
    /// A parameter that no other node uses.
    pub(super) key: String,
    /// A topic that no other node uses.
    pub(super) topic: String,
}

impl Callers {
    /// Makes calls of all kinds until `stop`.
    pub(super) async fn run(self, stop: CancellationToken) -> CallResults {
        let (reads, (written, read_back, notifications), registered) =
            tokio::join!(self.read(&stop), self.write(&stop), self.register(&stop));
        CallResults {
            reads: reads.merge(read_back),
            writes: written.merge(registered),
            notifications,
        }
    }

    /// Reads in a loop, like a node that looks up another one.
    async fn read(&self, stop: &CancellationToken) -> Waits {
        let mut waits = Waits::default();
        let name = [self.api.caller.as_str().into()];
        while !stop.is_cancelled() {
            let answer = self.api.timed_call("lookupNode", &name).await;
            if let Some(found) = waits.add(answer)
                && found.as_str() != Some(&self.node_api)
            {
                waits.fail("lookupNode gave a wrong address".to_owned());
            }
            sleep(PAUSE).await;
        }
        waits
    }

    /// Sets a parameter, waits for the notification, and reads the parameter back, in a loop.
    async fn write(&self, stop: &CancellationToken) -> (Waits, Waits, Waits) {
        let (mut written, mut read, mut told) = <(Waits, Waits, Waits)>::default();
        let mut seen = self.log.param.subscribe();
        let mut number = 0;
        // The master does not notify a node of its own writes, so a second node writes.
        let another = Api {
            caller: format!("{}_writer", self.api.caller),
            ..self.api.clone()
        };
        while !stop.is_cancelled() {
            number += 1;
            let start = Instant::now();
            let set = [self.key.as_str().into(), number.into()];
            let answer = another.timed_call("setParam", &set).await;
            if written.add(answer).is_none() {
                sleep(PAUSE).await;
                continue;
            }
            let answer = self
                .api
                .timed_call("getParam", &[self.key.as_str().into()])
                .await;
            if let Some(value) = read.add(answer)
                && value.as_int() != Some(number)
            {
                read.fail("getParam gave another value than was set before".to_owned());
            }
            let notified = timeout(LIMIT, seen.wait_for(|seen| *seen >= number));
            match notified.await {
                Ok(_) => told.succeed(start.elapsed()),
                Err(_) => told.fail(format!(
                    "no paramUpdate in {} s: neither rosrescue nor the master reaches nodes at {}",
                    LIMIT.as_secs(),
                    self.node_api
                )),
            }
            sleep(PAUSE).await;
        }
        (written, read, told)
    }

    /// Registers and unregisters a subscriber in a loop. With the type `*` it leaves no topic type behind.
    async fn register(&self, stop: &CancellationToken) -> Waits {
        let mut waits = Waits::default();
        let (topic, api) = (self.topic.as_str(), self.node_api.as_str());
        while !stop.is_cancelled() {
            let register = [topic.into(), "*".into(), api.into()];
            // The node claims the subscription before it registers, and until it has unregistered. Otherwise a health
            // check could remove the registration, which would count as a failure here.
            self.log.subscribes(topic, true);
            let answer = self.api.timed_call("registerSubscriber", &register).await;
            waits.add(answer);
            sleep(PAUSE).await;
            let unregister = [topic.into(), api.into()];
            let answer = self
                .api
                .timed_call("unregisterSubscriber", &unregister)
                .await;
            self.log.subscribes(topic, false);
            // The first call may have run although its answer was lost with the connection.
            let again = answer.again;
            if waits.add(answer) == Some(Value::Int(0)) && !again {
                waits.fail(format!(
                    "the registration as a subscriber of {topic} was gone"
                ));
            }
            sleep(PAUSE).await;
        }
        waits
    }
}
