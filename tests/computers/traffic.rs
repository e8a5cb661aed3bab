//! Writers and readers on each computer, which record each call.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, RwLock, RwLockWriteGuard};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ros1_master::xmlrpc::Value;

use crate::computer::{Computer, Downtimes, NAMES, PORT};
use crate::fleet::Fleet;
use crate::network::{enter, within};
use crate::support::{Client, FakeNode, Finish, State, eventually, params};

/// Pause between two calls of a client.
const PAUSE: Duration = Duration::from_millis(50);

/// A parameter that always has the same value. Each reader must get it, never a default.
const STEADY: &str = "/steady";

pub(crate) const TYPE: &str = "std_msgs/String";

#[derive(Clone, Debug)]
struct Call {
    round: usize,
    number: i32,
    start: Instant,
    end: Instant,
    failed: Option<String>,
}

/// The recorded calls of one client.
type Log = Arc<Mutex<Vec<Call>>>;

#[derive(Debug)]
struct Caller {
    log: Log,
    downtimes: Downtimes,
    thread: Option<JoinHandle<()>>,
}

/// Writers and readers that call until this is dropped.
#[derive(Debug)]
pub(crate) struct Traffic {
    nodes: Vec<Named>,
    writers: Vec<Caller>,
    readers: Vec<Caller>,
    common: Arc<Common>,
}

#[derive(Debug, Default)]
struct Common {
    finish: AtomicBool,
    round: AtomicUsize,
    /// Held for reading during each call.
    pause: RwLock<()>,
}

impl Traffic {
    #[track_caller]
    pub(crate) fn start(fleet: &Fleet) -> Self {
        fleet.computers[0].set_param(STEADY, 7);
        let common = Arc::new(Common::default());
        let nodes = fleet.computers.iter();
        let nodes =
            nodes.map(|computer| Named::new(computer, &format!("/writer_{}", computer.name)));
        let nodes: Vec<_> = nodes.collect();
        let writers = fleet.computers.iter().zip(&nodes).map(|(computer, node)| {
            let (node, name) = (node.clone(), computer.name);
            let work =
                move |client: &Client, round, number| write(client, node.it(), name, round, number);
            Caller::start(computer, &common, work)
        });
        let writers = writers.collect();
        let readers = fleet.computers.iter();
        let readers = readers.map(|computer| {
            Caller::start(computer, &common, |client, _round, _number| read(client))
        });
        let readers = readers.collect();
        Self {
            nodes,
            writers,
            readers,
            common,
        }
    }

    /// Waits until each of these computers' writers has made another call that was answered.
    #[track_caller]
    pub(crate) fn await_writes(&self, those: &[usize]) {
        let now = Instant::now();
        for &index in those {
            let writer = &self.writers[index];
            eventually(&format!("a write on {} is answered", NAMES[index]), || {
                let log = writer.log.lock().unwrap();
                log.last()
                    .is_some_and(|last| last.start > now && last.failed.is_none())
            });
        }
    }

    /// Waits until the calls under way have ended, and prevents further calls while the lock is held.
    fn pause(&self) -> RwLockWriteGuard<'_, ()> {
        self.common.pause.write().unwrap()
    }

    /// The longest write and read of these computers since `since`. Panics if a call failed or returned a wrong value.
    #[track_caller]
    pub(crate) fn longest(&self, those: &[usize], since: Instant) -> [Duration; 2] {
        [&self.writers, &self.readers].map(|callers| {
            let longest = those
                .iter()
                .map(|&index| callers[index].longest(NAMES[index], since));
            longest.max().unwrap_or_default()
        })
    }

    /// Waits until all computers have the same state, and checks that it has every acknowledged write. The next round
    /// uses new parameters.
    #[track_caller]
    pub(crate) fn assert_nothing_lost(&self, fleet: &Fleet) {
        let _pause = self.pause();
        let state = fleet.await_same_state();
        let round = self.common.round.fetch_add(1, Ordering::Relaxed);
        let mut total = 0;
        for (writer, name) in self.writers.iter().zip(NAMES) {
            let log = writer.log.lock().unwrap();
            let answered = log.iter().filter(|call| call.failed.is_none());
            let last = answered.clone().rfind(|call| counts(call.number));
            let count = state
                .params
                .as_struct()
                .unwrap()
                .get(&format!("count_{name}"));
            assert!(
                last.is_none_or(|last| count.and_then(Value::as_int) >= Some(last.number)),
                "the last acknowledged count on {name} was {last:?}, and the state has {count:?}"
            );
            // The parameters of earlier rounds have been deleted.
            let kept = answered.filter(|call| {
                registers(call.number) || call.round == round && !counts(call.number)
            });
            let kept = kept.inspect(|_| total += 1);
            let lost: Vec<_> = kept.filter(|call| !holds(&state, name, call)).collect();
            assert!(
                lost.is_empty(),
                "acknowledged on {name}, and lost in round {round}: {} calls, the first: {:?}, the last: {:?}",
                lost.len(),
                lost.first(),
                lost.last()
            );
        }
        for node in &self.nodes {
            let told = node.it().received("shutdown");
            assert!(told.is_empty(), "{node:?} is told to shut down: {told:?}");
        }
        assert!(total > 0, "nothing was written in round {round}");
        println!("round {round}: none of {total} writes is lost");
        let all = format!("/round{round}");
        let leader = fleet.await_whole();
        let leader = &fleet.computers[leader];
        leader.within(|| {
            leader
                .client()
                .ok("deleteParam", params!["/test", all.as_str()])
        });
    }
}

impl Drop for Traffic {
    fn drop(&mut self) {
        drop(Finish(&self.common.finish));
        if thread::panicking() {
            return;
        }
        for caller in self.writers.iter_mut().chain(&mut self.readers) {
            let ended = caller.thread.take().unwrap().join();
            ended.expect("a writer or reader panicked");
        }
    }
}

impl Caller {
    fn start(
        computer: &Computer,
        common: &Arc<Common>,
        work: impl Fn(&Client, usize, i32) -> Result<(), String> + Send + 'static,
    ) -> Self {
        let log = Log::default();
        let namespace = computer.namespace.clone();
        let (common, calls) = (Arc::clone(common), Arc::clone(&log));
        let downtimes = computer.downtimes.clone();
        let down = downtimes.clone();
        let thread = thread::spawn(move || {
            enter(&namespace);
            let client = Client::new(PORT);
            for number in 0.. {
                if common.finish.load(Ordering::Relaxed) {
                    return;
                }
                let Ok(calling) = common.pause.read() else {
                    return;
                };
                if !down.lasts() {
                    let round = common.round.load(Ordering::Relaxed);
                    let start = Instant::now();
                    let failed = work(&client, round, number).err();
                    let end = Instant::now();
                    calls.lock().unwrap().push(Call {
                        round,
                        number,
                        start,
                        end,
                        failed,
                    });
                }
                drop(calling);
                thread::sleep(PAUSE);
            }
        });
        Self {
            log,
            downtimes,
            thread: Some(thread),
        }
    }

    #[track_caller]
    fn longest(&self, name: &str, since: Instant) -> Duration {
        let log = self.log.lock().unwrap();
        let recent = log.iter().rev().take_while(|call| call.end >= since);
        let counted = recent.filter(|call| !self.downtimes.touch(call.start, call.end));
        let mut longest = Duration::ZERO;
        for call in counted {
            assert!(call.failed.is_none(), "a call on {name} failed: {call:?}");
            longest = longest.max(call.end - call.start);
        }
        longest
    }
}

/// A fake node on a computer. It never dies, but may be unreachable for a while.
#[derive(Clone, Debug)]
pub(crate) struct Named {
    namespace: String,
    node: Option<Arc<FakeNode>>,
}

impl Named {
    pub(crate) fn new(computer: &Computer, name: &str) -> Self {
        let address = computer.address().parse().unwrap();
        let node = computer.within(|| FakeNode::start_on(name, address, 0));
        Self {
            namespace: computer.namespace.clone(),
            node: Some(Arc::new(node)),
        }
    }

    pub(crate) fn it(&self) -> &FakeNode {
        self.node.as_ref().unwrap()
    }
}

impl Drop for Named {
    fn drop(&mut self) {
        // The node's server ends by a connection to itself, which must be made in the computer's network.
        let node = self.node.take();
        within(&self.namespace, || drop(node));
    }
}

/// Whether this call of a writer registers a publisher. All other calls set a parameter.
fn registers(number: i32) -> bool {
    number % 10 == 0
}

/// Whether this call of a writer sets the parameter that is used in all rounds.
fn counts(number: i32) -> bool {
    number % 10 == 5
}

fn topic(name: &str, number: i32) -> String {
    format!("/of_{name}/t{number}")
}

fn write(
    client: &Client,
    node: &FakeNode,
    name: &str,
    round: usize,
    number: i32,
) -> Result<(), String> {
    let caller = node.name.as_str();
    let done = if registers(number) {
        let topic = topic(name, number);
        node.claim_publication(&topic, Some(TYPE));
        let params = params![caller, topic, TYPE, node.api.as_str()];
        answer(client, "registerPublisher", params)
    } else {
        let key = match counts(number) {
            true => format!("/count_{name}"),
            false => format!("/round{round}/{name}/k{number}"),
        };
        answer(client, "setParam", params![caller, key, number])
    };
    done.map(drop)
}

fn read(client: &Client) -> Result<(), String> {
    let value = answer(client, "getParam", params!["/reader", STEADY])?;
    match value {
        Value::Int(7) => Ok(()),
        other => Err(format!("{STEADY} is {other:?}")),
    }
}

/// Whether the state has the result of this call.
fn holds(state: &State, name: &str, call: &Call) -> bool {
    let Call { round, number, .. } = call;
    if registers(*number) {
        let publishers = state.publishers_of(&topic(name, *number));
        return publishers == [format!("/writer_{name}")];
    }
    let keys = [
        format!("round{round}"),
        name.to_owned(),
        format!("k{number}"),
    ];
    let found = keys
        .iter()
        .try_fold(&state.params, |at, key| at.as_struct()?.get(key));
    found == Some(&Value::Int(*number))
}

fn answer(client: &Client, method: &str, params: Vec<Value>) -> Result<Value, String> {
    match client.status(method, params) {
        Ok((1, _, value)) => Ok(value),
        other => Err(format!("{other:?}")),
    }
}
