//! The new master dies at every single call of the injection, alone or in the middle of more deaths.
//! The one that lives has the exact state, whatever came before, and no node notices.

use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

use crate::support::{
    Client, FakeNode, Rescue, SICK_ROSMASTER, Scratch, Setup, Sickness, State, Zygote, eventually,
    eventually_some, free_port, holds, params, status,
};
use rosrescue::xmlrpc::Value;
use rustix::process::Signal;

/// Calls that a master gets before the injection: the look.
const LOOK: usize = 5;

/// rosrescue proxy before masters that this test starts.
struct Ward {
    rescue: Rescue,
    zygote: Zygote,
    port: u16,
    #[allow(dead_code, reason = "its drop ends everything")]
    scratch: Scratch,
}

impl Ward {
    fn new() -> Self {
        let scratch = Scratch::new();
        let mut zygote = Zygote::new(&scratch);
        let port = free_port();
        zygote.start(port, "");
        let rescue = Setup::proxy(&scratch, port).args(["--hold", "60"]).start();
        Self {
            rescue,
            zygote,
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
        let pid = self.zygote.start(self.port, "");
        self.await_open(pid);
        pid
    }

    /// A master that dies of this.
    fn die(&mut self, sickness: &str) {
        let pid = self.zygote.start(self.port, sickness);
        self.zygote.wait(pid);
    }
}

/// A state for which an injection takes some 300 calls, of nodes that a master or rosrescue can call.
fn fill(client: &Client) -> Vec<FakeNode> {
    let nodes: Vec<_> = (0..5).map(|i| FakeNode::start(&format!("/n{i}"))).collect();
    for i in 0..20 {
        client.set_param(&format!("/p{}/q{i}", i % 7), i);
    }
    for (i, node) in nodes.iter().enumerate() {
        let (name, api) = (node.name.as_str(), node.api.as_str());
        for j in 0..16 {
            node.publish(client, &format!("/t{i}_{}", j % 14), "a/B");
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
fn ward_with_state() -> (Ward, State, Nodes) {
    let ward = Ward::new();
    let nodes = fill(&ward.rescue.client());
    let before = State::read(&ward.bare());
    let nodes = Nodes::new(nodes, &before);
    (ward, before, nodes)
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
    let (mut ward, before, nodes) = ward_with_state();
    let mut pid = ward.bare().master_pid().unwrap();
    let mut number = LOOK;
    loop {
        number += 1;
        ward.zygote.kill(pid);
        let sick = ward.zygote.start(ward.port, &format!("call {number}"));
        let client = ward.rescue.client();
        let mut lives = None;
        eventually("the master has died or has the state", || {
            let status = status(&client);
            let whole = status["open"] == true && status["last_recovery"]["master_pid"] == sick;
            lives = (whole || !crate::support::alive(sick)).then_some(whole);
            lives.is_some()
        });
        if lives == Some(true) {
            ward.zygote.kill(sick);
            break;
        }
        ward.zygote.wait(sick);
        pid = ward.live();
        let when = format!("after a death at call {number}");
        before.assert_same(&State::read(&ward.bare()), &when);
        if number.is_multiple_of(10) {
            nodes.assert_nobody_disturbed();
        }
    }
    ward.live();
    before.assert_same(&State::read(&ward.bare()), "at the end");
    println!("{} calls in an injection", number - LOOK - 1);
    assert!(
        number - LOOK >= 300,
        "the injection had only {number} calls"
    );
    nodes.assert_nobody_disturbed();
}

#[test]
fn many_times_in_a_row() {
    let (mut ward, before, nodes) = ward_with_state();
    let mut pid = ward.bare().master_pid().unwrap();
    for (number, deaths) in (LOOK + 1..340).step_by(9).zip((3..=7).cycle()) {
        ward.zygote.kill(pid);
        // At the same call, or at another one each time.
        for death in 0..deaths {
            let call = match deaths % 2 {
                0 => number,
                _ => LOOK + 1 + (number * (death + 1) * 31) % 250,
            };
            ward.die(&format!("call {call}"));
        }
        pid = ward.live();
        let when = format!("after {deaths} deaths about call {number}");
        before.assert_same(&State::read(&ward.bare()), &when);
        nodes.assert_nobody_disturbed();
    }
    nodes.assert_nobody_disturbed();
}

/// What no master can take is nobody's outage, and whoever takes it back brings the next master to life.
#[test]
fn a_record_that_kills_the_masters_of_others() {
    let (mut ward, before, nodes) = ward_with_state();
    let client = ward.rescue.client();
    let pid = ward.bare().master_pid().unwrap();
    ward.zygote.kill(pid);
    for _ in 0..5 {
        ward.die("name /s2_1");
        before.assert_same(&State::read(&client), "in the mirror");
    }
    let status = status(&client);
    assert_eq!(status["deaths"], 6, "{status}");
    nodes.assert_nobody_disturbed();
    let params = params!["/n2", "/s2_1", "rosrpc://n2:1"];
    assert_eq!(client.ok("unregisterService", params), Value::Int(1));
    let pid = ward.zygote.start(ward.port, "name /s2_1");
    ward.await_open(pid);
    let mut after = before.clone();
    after.services.retain(|(name, _)| name != "/s2_1");
    after.service_apis.retain(|(name, _)| name != "/s2_1");
    after.assert_same(&State::read(&ward.bare()), "without the service that kills");
    nodes.assert_nobody_disturbed();
}

/// Somebody else starts the masters: their crash loop is said too.
#[test]
fn the_crash_loop_of_somebody_elses_master() {
    let (mut ward, before, nodes) = ward_with_state();
    let client = ward.rescue.client();
    let mut pid = ward.bare().master_pid().unwrap();
    for _ in 0..6 {
        ward.zygote.kill(pid);
        pid = ward.live();
    }
    eventually("the status says crash loop", || {
        status(&client)["crash_loop"] == true
    });
    ward.rescue.wait_line("the crash loop", |line| {
        line.contains("crash loop: the master has died")
    });
    before.assert_same(&State::read(&ward.bare()), "in the crash loop");
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
        let scratch = Scratch::new();
        let sickness = Sickness::new(&scratch);
        let port = free_port();
        let rescue = Setup::core(&scratch, port)
            .args(["--no-rosout", "--rosmaster", SICK_ROSMASTER])
            .env("SICK", &sickness.file)
            .start();
        let client = rescue.client();
        let all = ["/n0", "/n1"].map(FakeNode::start);
        client.set_param("/p0/q", 1);
        for node in &all {
            node.publish(&client, "/topic", "a/B");
            node.offer(&client, &format!("{}/service", node.name));
            // The second publisher is news to the first subscriber, which every recovery tells again.
            node.subscribe(&client, "/topic", "a/B");
            node.watch_param(&client, "/p0");
        }
        eventually("the parameters of core are set", || {
            let keys = ["/rosversion", "/rosdistro", "/run_id"];
            keys.iter().all(|key| client.param(key).is_some())
        });
        let bare = Client::new(port);
        let before = State::read(&bare);
        let nodes = Nodes::new(all.into(), &before);
        for deaths in 1..=2 {
            number += 1;
            sickness.set(&format!("call {number}\ntimes {deaths}"));
            let pid = bare.master_pid().unwrap();
            crate::support::signal(pid, Signal::KILL);
            let survived = eventually_some("the gate is open to another master", || {
                let status = status(&client);
                let now = u32::try_from(status["last_recovery"]["master_pid"].as_u64()?).ok()?;
                let died = sickness.deaths().len() == deaths;
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
            before.assert_same(&State::read(&bare), &when);
        }
    }
}
