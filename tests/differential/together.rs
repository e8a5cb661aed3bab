//! Compares many simultaneous callers through rosrescue with the same callers, one after the other, at a bare
//! rosmaster. Each caller must get the same bytes from both. Calls that queue up travel to the master as one multicall,
//! and rosrescue encodes the replies.
//!
//! Each caller uses its own names, so that its replies do not depend on other callers. Calls whose answers contain
//! other callers' names are left out: `getSystemState`, `getTopicTypes`, `getParamNames`, `getParam('/')`, topics,
//! services or parameters of two callers, callers in the root namespace, and the process id. One service exists from
//! the start, because a master that never had a service answers differently.

use std::net::TcpListener;

use ros1_master::{
    master::Request,
    xmlrpc::{Call, Reply, Value, decode_reply, encode_call},
};

use crate::dice::{Cast, Dice};
use crate::real::Rosmaster;
use crate::support::{Client, Scratch, Setup, eventually, http_request, short, status};
use crate::{NO_HANGS, number};

const CALLERS: usize = 24;
const CALLS: usize = 150;
/// Methods of calls that may share a batch.
#[rustfmt::skip]
const SHARE: [&str; 9] = [
    "registerPublisher", "registerSubscriber", "registerService", "unregisterPublisher",
    "unregisterSubscriber", "unregisterService", "unsubscribeParam", "setParam", "deleteParam",
];

/// The calls of one caller, with names that no other caller uses.
struct Caller {
    dice: Dice,
    cast: Cast,
    space: String,
}

impl Caller {
    /// Creates a caller whose nodes are at `silent`.
    fn new(seed: u64, index: usize, silent: &str, unreturnable: bool) -> Self {
        let space = format!("/c{index}");
        let apis = (1..3).map(|node| format!("http://{silent}{space}/{node}/"));
        Self {
            dice: Dice(seed.wrapping_add(index as u64 * 1000)),
            cast: Cast {
                apis: apis.collect(),
                unreturnable,
                errors: true,
                process: false,
            },
            space,
        }
    }

    /// A name: absolute, relative to the caller's namespace, or private.
    fn name(&mut self, among: &[&str]) -> Value {
        let name = self.dice.pick(among);
        match self.dice.below(8) {
            0 => name.into(),
            1 => format!("~{name}").into(),
            2 => self.dice.pick(&["", "~", "a b", "x:y", "~~"]).into(),
            3 => format!("/{}//{name}/", self.space).into(),
            _ => format!("{}/{name}", self.space).into(),
        }
    }

    fn topic(&mut self) -> Value {
        self.name(&["t0", "t1", "n/t2", "s"])
    }

    fn key(&mut self) -> Value {
        self.name(&["a", "a/b", "a/b/c", "d", "n/e", "t0"])
    }

    fn api(&mut self) -> Value {
        let index = usize::from(self.dice.once_in(6));
        self.cast.apis[index].as_str().into()
    }

    fn service_api(&mut self) -> Value {
        self.dice
            .pick(&["rosrpc://h:1", "rosrpc://h:2", "http://h"])
            .into()
    }

    fn call(&mut self, levels: usize) -> Call {
        let node = self.dice.pick(&["n", "n", "m", "n/o"]);
        let mut params = vec![Value::from(format!("{}/{node}", self.space))];
        let topic_type = |dice: &mut Dice| dice.pick(&["a/B", "a/C", "*", "", "a"]).into();
        let method = match self.dice.below(100) {
            kind @ 0..=29 => {
                params.extend([self.topic(), topic_type(&mut self.dice), self.api()]);
                ["registerPublisher", "registerSubscriber"][kind % 2]
            }
            30..=35 => {
                params.extend([self.topic(), self.service_api(), self.api()]);
                "registerService"
            }
            kind @ 36..=49 => {
                params.extend([self.topic(), self.api()]);
                ["unregisterPublisher", "unregisterSubscriber"][kind % 2]
            }
            50..=54 => {
                params.extend([self.topic(), self.service_api()]);
                "unregisterService"
            }
            55..=74 => {
                params.extend([self.key(), self.dice.value(&self.cast, 2)]);
                "setParam"
            }
            75..=82 => {
                params.push(self.key());
                "deleteParam"
            }
            83..=84 => {
                params.extend([self.api(), self.key()]);
                "subscribeParam"
            }
            85..=87 => {
                params.extend([self.api(), self.key()]);
                "unsubscribeParam"
            }
            read @ 88..=95 => {
                params.push(self.key());
                ["getParam", "hasParam", "searchParam", "getParam"][read % 4]
            }
            96 => {
                params.push(self.topic());
                "lookupService"
            }
            97 => {
                params.push(format!("{}/n", self.space).into());
                "lookupNode"
            }
            98 if levels > 0 => {
                let calls = (0..self.dice.below(5)).map(|_| self.call(0));
                return Call::multicall(calls.collect::<Vec<_>>());
            }
            _ => {
                params.push(format!("{}/", self.space).into());
                "getPublishedTopics"
            }
        };
        if self.dice.once_in(10) {
            self.spoil(&mut params);
        }
        Call::new(method, params)
    }

    /// Makes the parameters wrong: too few, too many, or one of a type that is not a name.
    fn spoil(&mut self, params: &mut Vec<Value>) {
        match self.dice.below(4) {
            0 => params.push(self.dice.value(&self.cast, 1)),
            1 => drop(params.pop()),
            _ => {
                let index = self.dice.below(params.len());
                params[index] = match self.dice.value(&self.cast, 1) {
                    Value::String(_) | Value::DateTime(_) => Value::Nil,
                    value => value,
                };
            }
        }
    }

    /// Calls that show the resulting state, without other callers' parts.
    fn state(&self) -> Vec<Call> {
        let ask = |method: &str, name: &str| {
            let name = format!("{}{name}", self.space);
            Call::new(method, vec!["/test".into(), name.into()])
        };
        let mut calls = vec![ask("getPublishedTopics", "")];
        for key in ["", "/a", "/a/b", "/d", "/n", "/t0", "/~a"] {
            calls.push(ask("getParam", key));
        }
        for node in ["/n", "/m", "/n/o"] {
            calls.push(ask("lookupNode", node));
        }
        for service in ["/t0", "/t1", "/n/t2", "/s", "/n/t0"] {
            calls.push(ask("lookupService", service));
        }
        calls
    }
}

/// The bodies of the answers to `calls`, made one after the other on one connection.
fn ask(port: u16, calls: &[Call]) -> Vec<Vec<u8>> {
    let mut wire = Client::new(port).connect().unwrap();
    let answers = calls.iter().map(|call| {
        wire.send(&http_request(&encode_call(call))).unwrap();
        let answer = wire.response();
        answer
            .unwrap_or_else(|error| panic!("{call:?}: {error}"))
            .body
    });
    answers.collect()
}

/// The entries of `getSystemState` in the namespace `space`.
fn registrations(port: u16, space: &str) -> Vec<Vec<Value>> {
    let state = ask(port, &[Call::new("getSystemState", vec!["/test".into()])]);
    let Ok(Reply::Value(Value::Array(answer))) = decode_reply(&state[0]) else {
        panic!("{state:?}")
    };
    let lists = answer[2].as_array().unwrap().iter();
    let own = |entry: &&Value| {
        let name = entry.as_array().unwrap()[0].as_str().unwrap();
        name.starts_with(&format!("{space}/"))
    };
    lists
        .map(|list| {
            list.as_array()
                .unwrap()
                .iter()
                .filter(own)
                .cloned()
                .collect()
        })
        .collect()
}

#[track_caller]
fn same(seed: u64, calls: &[Call], theirs: &[Vec<u8>], ours: &[Vec<u8>]) {
    for (nth, ((call, theirs), ours)) in calls.iter().zip(theirs).zip(ours).enumerate() {
        assert!(
            theirs == ours,
            "seed {seed}, number {nth}, {call:?} answered\n{}\ninstead of\n{}",
            String::from_utf8_lossy(ours),
            String::from_utf8_lossy(theirs)
        );
    }
    assert_eq!(theirs.len(), ours.len());
}

/// Plays all callers. With `unreturnable` there are values that a master cannot return. Without them, the master behind
/// rosrescue is killed at the end, and its successor must answer the same. `reads` says whether the master or the
/// mirror answers reads.
fn play(seed: u64, unreturnable: bool, reads: &str) {
    let mut bare = Rosmaster::start();
    let mut behind = Rosmaster::start();
    drop((bare.ready(), behind.ready()));
    let scratch = Scratch::new();
    let rescue = Setup::proxy(&scratch, behind.port)
        .args(["--reads", reads])
        .args(NO_HANGS)
        .start();
    // Other tests check the callbacks. rosrescue does not take a node that does not answer for dead.
    let silent = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let address = silent.local_addr().unwrap().to_string();
    let mut callers: Vec<_> = (0..CALLERS)
        .map(|index| Caller::new(seed, index, &address, unreturnable))
        .collect();
    let scripts: Vec<Vec<Call>> = callers
        .iter_mut()
        .map(|caller| (0..CALLS).map(|_| caller.call(1)).collect())
        .collect();
    let params = ["/first", "/first", "rosrpc://h:1", "http://h:1/"].map(Value::from);
    let first = [Call::new("registerService", params.into())];
    same(
        seed,
        &first,
        &ask(bare.port, &first),
        &ask(rescue.port(), &first),
    );
    let through: Vec<_> = std::thread::scope(|scope| {
        let port = rescue.port();
        let clients: Vec<_> = scripts
            .iter()
            .map(|calls| scope.spawn(move || ask(port, calls)))
            .collect();
        clients.into_iter().map(|it| it.join().unwrap()).collect()
    });
    for (calls, ours) in scripts.iter().zip(&through) {
        same(seed, calls, &ask(bare.port, calls), ours);
    }

    let counters = status(&rescue.client())["counters"].clone();
    let counter = |name: &str| counters[name].as_u64().unwrap();
    assert_eq!(counter("divergences"), 0, "seed {seed}");
    let mutating = scripts
        .iter()
        .flatten()
        .filter(|call| Request::from((*call).clone()).kind().mutates());
    let (shared, alone): (Vec<_>, Vec<_>) =
        mutating.partition(|call| SHARE.contains(&call.method.as_str()));
    let batches = usize::try_from(counter("write_batches")).unwrap() - alone.len();
    if !unreturnable {
        // With such values, the mirror cannot answer most of the time.
        assert_eq!(counter("calls_from_mirror") > 100, reads == "mirror");
    }
    println!(
        "seed {seed}, unreturnable {unreturnable}, reads by the {reads}: {} calls, of which {} went alone and {} in {batches} batches",
        CALLERS * CALLS,
        alone.len(),
        shared.len()
    );
    assert!(
        batches * 3 < shared.len(),
        "{} calls made {batches} batches: hardly any went together",
        shared.len()
    );

    let states = |port: u16, behind: u16, when: &str| {
        for caller in &callers {
            let calls = caller.state();
            same(seed, &calls, &ask(bare.port, &calls), &ask(port, &calls));
            let [theirs, ours] = [bare.port, behind].map(|port| registrations(port, &caller.space));
            assert!(
                theirs == ours,
                "seed {seed}, {when}: {}\ninstead of\n{}",
                short(&ours),
                short(&theirs)
            );
        }
    };
    states(behind.port, behind.port, "at the end");
    if !unreturnable {
        let port = behind.port;
        let restored = || status(&rescue.client())["counters"]["masters_restored"].clone();
        let before = restored();
        behind.kill();
        let mut behind = Rosmaster::start_at(port);
        drop(behind.ready());
        eventually("the state is back", || {
            restored() != before && status(&rescue.client())["open"] == true
        });
        states(rescue.port(), port, "after a crash");
    }
}

#[test]
fn simultaneous_callers_get_the_bytes_of_a_bare_rosmaster() {
    let seed = number("ROSRESCUE_SEED", u64::from(std::process::id()) << 20);
    let unreturnable = std::process::id().is_multiple_of(2);
    let plays = [
        (unreturnable, "mirror"),
        (!unreturnable, "master"),
        (unreturnable, "master"),
        (!unreturnable, "mirror"),
    ];
    // Each run plays two of the four, which is half the time; one with a given seed plays all.
    let played = match std::env::var_os("ROSRESCUE_SEED") {
        Some(_) => plays.len(),
        None => 2,
    };
    for (unreturnable, reads) in &plays[..played] {
        play(seed, *unreturnable, reads);
    }
}
