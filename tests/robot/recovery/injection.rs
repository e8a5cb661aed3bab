//! The new master dies at every single call of the injection, alone or in the middle of more deaths.
//! The one that lives has the exact state, whatever came before, and no node notices.

use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

use crate::support::{
    Client, Failing, FakeNode, Forkserver, Rescue, Scratch, Setup, State, eventually,
    eventually_some, free_port, holds, params, status,
};
use rosrescue::xmlrpc::Value;

/// Calls that a master gets before the injection: the look.
const LOOK: usize = 5;

/// rosrescue proxy before masters that this test starts.
struct Proxied {
    rescue: Rescue,
    forkserver: Forkserver,
    port: u16,
    #[allow(dead_code, reason = "its drop ends everything")]
    scratch: Scratch,
}

impl Proxied {
    fn new() -> Self {
        let scratch = Scratch::new();
        let mut forkserver = Forkserver::new(&scratch);
        let port = free_port();
        forkserver.start(port, "");
        let rescue = Setup::proxy(&scratch, port).args(["--hold", "60"]).start();
        Self {
            rescue,
            forkserver,
            port,
            scratch,
        }
    }

    fn bare(&self) -> Client {
        Client::new(self.port)
    }

    fn await_open(&self, pid: u32) {
        let client = self.rescue.client();
        eventually("the gate is open to the new master", || {
            let status = status(&client);
            status["open"] == true && status["last_recovery"]["master_pid"] == pid
        });
    }

    /// A master that has the state when this returns.
    fn live(&mut self) -> u32 {
        let pid = self.forkserver.start(self.port, "");
        self.await_open(pid);
        pid
    }

    /// A master that dies of this.
    fn die(&mut self, failures: &str) {
        let pid = self.forkserver.start(self.port, failures);
        self.forkserver.wait(pid);
    }
}

/// A state for which an injection takes some 80 calls, of nodes that a master or rosrescue can call.
fn fill(client: &Client) -> Vec<FakeNode> {
    let nodes: Vec<_> = (0..3).map(|i| FakeNode::start(&format!("/n{i}"))).collect();
    for i in 0..10 {
        client.set_param(&format!("/p{}/q{i}", i % 7), i);
    }
    for (i, node) in nodes.iter().enumerate() {
        let (name, api) = (node.name.as_str(), node.api.as_str());
        for j in 0..7 {
            node.publish(client, &format!("/t{i}_{}", j % 6), "a/B");
            node.subscribe(client, &format!("/t{j}_{i}"), "a/B");
        }
        for j in 0..3 {
            let (service, service_api) = (format!("/s{i}_{j}"), format!("rosrpc://n{i}:{j}"));
            client.ok("registerService", params![name, service, service_api, api]);
        }
        for j in 0..5 {
            node.watch_param(client, &format!("/p{j}"));
        }
    }
    nodes
}

/// rosrescue with a state, the state, and its nodes.
fn proxied_with_state() -> (Proxied, State, Nodes) {
    let proxied = Proxied::new();
    let nodes = fill(&proxied.rescue.client());
    let before = State::read(&proxied.bare());
    let nodes = Nodes::new(nodes, &before);
    (proxied, before, nodes)
}

/// The nodes, what a living master last told them, and what they may be told.
struct Nodes {
    all: Vec<FakeNode>,
    heard: Vec<usize>,
    /// The publishers of every topic.
    full: BTreeMap<String, Value>,
    params: Value,
}

impl Nodes {
    /// Waits until the master has told them everything.
    fn new(all: Vec<FakeNode>, state: &State) -> Self {
        let api = |name: &String| {
            let found = state.nodes.iter().find(|(node, _)| node == name);
            found.unwrap().1.as_str()
        };
        let full = state.subscribers.iter().map(|(topic, _)| {
            let publishers = state.publishers_of(topic);
            let list: Vec<_> = publishers.iter().map(api).collect();
            (topic.clone(), Value::from(list))
        });
        let full: BTreeMap<_, _> = full.collect();
        let calls = || {
            all.iter()
                .map(|node| node.calls().len())
                .collect::<Vec<_>>()
        };
        eventually("what was still to be told has been told", || {
            let before = calls();
            holds(Duration::from_millis(500), || calls() == before)
        });
        let heard = calls();
        Self {
            all,
            heard,
            full,
            params: state.params.clone(),
        }
    }

    /// G6: no node is told to shut down, no master calls a node at all, and whatever rosrescue tells is
    /// the whole truth. That must not happen later either: idle threads of a master look every 100 ms
    /// whether there is something to tell.
    #[track_caller]
    fn assert_nobody_disturbed(&self) {
        self.look();
        thread::sleep(Duration::from_millis(250));
        self.look();
    }

    #[track_caller]
    fn look(&self) {
        for (node, heard) in self.all.iter().zip(&self.heard) {
            for call in &node.calls()[*heard..] {
                let name = call.params.get(1).and_then(Value::as_str).unwrap_or("");
                let right = match call.method.as_str() {
                    "getPid" | "getPublications" | "getSubscriptions" => true,
                    "publisherUpdate" => self.full.get(name) == Some(&call.params[2]),
                    "paramUpdate" => {
                        let key = name.trim_matches('/');
                        let Value::Struct(tree) = &self.params else {
                            panic!("parameters: {:?}", self.params);
                        };
                        tree.get(key) == Some(&call.params[2])
                    }
                    _ => false,
                };
                assert!(right && call.from_rosrescue, "{}: {call:?}", node.name);
            }
        }
    }
}

#[test]
fn at_every_call() {
    let (mut proxied, before, nodes) = proxied_with_state();
    let mut pid = proxied.bare().master_pid().unwrap();
    let mut number = LOOK;
    loop {
        number += 1;
        proxied.forkserver.kill(pid);
        let failing = proxied
            .forkserver
            .start(proxied.port, &format!("call {number}"));
        let client = proxied.rescue.client();
        let mut lives = None;
        eventually("the master has died or has the state", || {
            let status = status(&client);
            let whole = status["open"] == true && status["last_recovery"]["master_pid"] == failing;
            lives = (whole || !crate::support::alive(failing)).then_some(whole);
            lives.is_some()
        });
        if lives == Some(true) {
            proxied.forkserver.kill(failing);
            break;
        }
        proxied.forkserver.wait(failing);
        pid = proxied.live();
        let when = format!("after a death at call {number}");
        before.assert_same(&State::read(&proxied.bare()), &when);
        if number.is_multiple_of(10) {
            nodes.assert_nobody_disturbed();
        }
    }
    proxied.live();
    before.assert_same(&State::read(&proxied.bare()), "at the end");
    println!("{} calls in an injection", number - LOOK - 1);
    assert!(
        number - LOOK >= 60,
        "the injection had only {} calls",
        number - LOOK
    );
    nodes.assert_nobody_disturbed();
}

#[test]
fn many_times_in_a_row() {
    let (mut proxied, before, nodes) = proxied_with_state();
    let mut pid = proxied.bare().master_pid().unwrap();
    for (number, deaths) in (LOOK + 1..90).step_by(8).zip((3..=7).cycle()) {
        proxied.forkserver.kill(pid);
        // At the same call, or at another one each time.
        for death in 0..deaths {
            let call = match deaths % 2 {
                0 => number,
                _ => LOOK + 1 + (number * (death + 1) * 31) % 60,
            };
            proxied.die(&format!("call {call}"));
        }
        pid = proxied.live();
        let when = format!("after {deaths} deaths about call {number}");
        before.assert_same(&State::read(&proxied.bare()), &when);
        nodes.assert_nobody_disturbed();
    }
    nodes.assert_nobody_disturbed();
}

/// Somebody else starts the masters: their crash loop is said too.
#[test]
fn the_crash_loop_of_somebody_elses_master() {
    let (mut proxied, before, nodes) = proxied_with_state();
    let client = proxied.rescue.client();
    let mut pid = proxied.bare().master_pid().unwrap();
    for _ in 0..6 {
        proxied.forkserver.kill(pid);
        pid = proxied.live();
    }
    eventually("the status says crash loop", || {
        status(&client)["crash_loop"] == true
    });
    proxied.rescue.wait_line("the crash loop", |line| {
        line.contains("crash loop: the master has died")
    });
    before.assert_same(&State::read(&proxied.bare()), "in the crash loop");
    eventually("it is over", || status(&client)["crash_loop"] == false);
    assert_eq!(status(&client)["open"], true);
    nodes.assert_nobody_disturbed();
}

/// A small state, because a core restarts its masters at once for the first five deaths within a minute:
/// two of four deaths to a core are in the injection.
#[test]
fn at_every_call_in_core_mode() {
    let mut number = 0;
    loop {
        let robot = Failing::core(&[]);
        let client = robot.client();
        let all = ["/n0", "/n1"].map(FakeNode::start);
        client.set_param("/p0/q", 1);
        for node in &all {
            node.publish(&client, "/topic", "a/B");
            node.offer(&client, &format!("{}/service", node.name));
            // The second publisher is news to the first subscriber, which every recovery tells again.
            node.subscribe(&client, "/topic", "a/B");
            node.watch_param(&client, "/p0");
        }
        let before = robot.state();
        let nodes = Nodes::new(all.into(), &before);
        for deaths in 1..=2 {
            number += 1;
            robot
                .failures
                .set(&format!("call {number}\ntimes {deaths}"));
            let pid = robot.kill_master();
            let survived = eventually_some("the gate is open to another master", || {
                let status = status(&client);
                let now = u32::try_from(status["last_recovery"]["master_pid"].as_u64()?).ok()?;
                let died = robot.failures.deaths().len() == deaths;
                // In this order: what lives after the death is not the one that dies.
                let open = status["open"] == true && now != pid && crate::support::alive(now);
                open.then_some(!died)
            });
            nodes.assert_nobody_disturbed();
            if survived {
                println!("{} calls in an injection", number - 1);
                // Parameters, two of each kind of registration, what is read back, and the mark.
                assert!(number > 10, "the injection had only {number} calls");
                return;
            }
            let when = format!("after a death at call {number}");
            before.assert_same(&robot.state(), &when);
        }
    }
}
