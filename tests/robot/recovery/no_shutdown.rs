//! No node is told to shut down if it would live on with a master that never dies: neither a node that came back under
//! its name at another address, nor a node that now has the old address.

use std::sync::atomic::{AtomicI32, Ordering};
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Library, Mode, Node, Robot, eventually, eventually_some, holds,
    in_both_modes, params, status,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// Number of outages. For a proxy, `ROSRESCUE_TEST_ROUNDS` overrides it. A core restarts its master at once only for the
/// first five deaths within a minute.
fn outages(mode: Mode) -> usize {
    let rounds = std::env::var("ROSRESCUE_TEST_ROUNDS");
    match mode {
        Mode::Core => 3,
        Mode::Proxy => rounds.map_or(4, |text| text.parse().unwrap()),
    }
}

#[track_caller]
fn assert_not_shut_down(node: &FakeNode, round: usize) {
    assert_eq!(
        node.received("shutdown"),
        Vec::<Vec<Value>>::new(),
        "{} in round {round}",
        node.name
    );
}

/// A node that the master notifies of a parameter. The threads of the master send notifications in order, so anything
/// earlier has been sent or is being sent by then.
struct Witness(FakeNode);

impl Witness {
    fn start(client: &Client) -> Self {
        let node = FakeNode::start("/witness");
        node.watch_param(client, "/round");
        Self(node)
    }

    #[track_caller]
    fn hear(&self, client: &Client) {
        let before = self.0.received("paramUpdate").len();
        let number = i32::try_from(before).unwrap() + 1_000_000;
        client.set_param("/round", number);
        eventually("the master notifies the witness", || {
            let heard = self.0.received("paramUpdate");
            heard.iter().any(|told| told[2] == Value::Int(number))
        });
    }
}

/// Checks for a while that no node is shut down, because the master makes its calls in other threads.
#[track_caller]
fn assert_none_shut_down(nodes: &[FakeNode]) {
    let spared = |node: &FakeNode| node.received("shutdown").is_empty();
    let all = holds(Duration::from_secs(2), || nodes.iter().all(spared));
    let shut_down = nodes.iter().filter(|node| !spared(node));
    let names: Vec<_> = shut_down.map(|node| node.name.as_str()).collect();
    assert!(all, "told to shut down: {names:?}");
}

/// Gives the node a new process id, and makes some registrations.
fn claim(node: &FakeNode, client: &Client) {
    static PIDS: AtomicI32 = AtomicI32::new(1_000_000);
    node.claim_pid(PIDS.fetch_add(1, Ordering::Relaxed));
    node.publish(client, &format!("{}/topic", node.name), "std_msgs/String");
    node.subscribe(client, "/shared", "std_msgs/String");
    node.offer(client, &format!("{}/service", node.name));
}

/// Undoes the registrations that [`claim`] made.
fn give_up(node: &FakeNode, client: &Client) {
    node.unpublish(client, &format!("{}/topic", node.name));
    node.unsubscribe(client, "/shared");
    node.withdraw(client, &format!("{}/service", node.name));
}

/// Kills the master, and runs `meanwhile` before the next one is there.
fn outage<T>(robot: &mut Robot, meanwhile: impl FnOnce(&Client) -> T) -> T {
    let dead = robot.master_pid();
    robot.kill_master();
    let result = meanwhile(&robot.client());
    robot.revive_master();
    robot.await_recovery(dead);
    result
}

fn api_of(robot: &Robot, node: &str) -> Option<String> {
    let api = robot.bare().ask("lookupNode", params!["/test", node])?;
    api.as_str().map(str::to_owned)
}

/// Starts a node at `port`, or at any port if it is 0, that makes some registrations.
fn claimed(name: &str, port: u16, client: &Client) -> FakeNode {
    let node = FakeNode::start_at(name, port);
    claim(&node, client);
    node
}

in_both_modes!(nodes_that_start_during_an_outage_are_not_shut_down);

/// In each outage
///
/// * two nodes start again under their names. The first old one is dead. The second one still runs, and is told to shut
///   down as usual.
/// * two nodes die, and their ports go to other nodes. The dead nodes do not come back.
/// * two nodes die and come back at other ports, and their old ports go to other nodes, in either order. rosrescue must
///   notice that the node at the old port is another one, and not shut it down. If the port was taken first, even a master
///   that never dies shuts down its new owner.
fn nodes_that_start_during_an_outage_are_not_shut_down(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let client = robot.client();
    let witness = Witness::start(&client);
    let both = |name: &str| [0, 1].map(|i| claimed(&format!("{name}{i}"), 0, &client));
    let mut phoenixes = both("/phoenix");
    for node in &phoenixes {
        let topic = format!("{}/topic", node.name);
        witness.0.subscribe(&client, &topic, "std_msgs/String");
    }
    let mut mortals = both("/mortal");
    let mut stay = Vec::new();
    for round in 0..outages(mode) {
        // The previous round may have had a late effect.
        for node in phoenixes.iter().chain(&mortals) {
            assert_not_shut_down(node, round);
        }
        let moving = both("/moving");
        let gone = mortals.each_ref().map(|node| node.name.clone());
        let [dead, alive] = phoenixes;
        let moved: Vec<[FakeNode; 2]>;
        (phoenixes, mortals, moved) = outage(&mut robot, |client| {
            let again = [&dead, &alive].map(|node| node.name.clone());
            drop(dead);
            let phoenixes = again.map(|name| claimed(&name, 0, client));
            let mut number = 0;
            let heirs = mortals.map(|node| {
                let port = node.port();
                drop(node);
                number += 1;
                claimed(&format!("/heir{round}_{number}"), port, client)
            });
            let moved = moving.into_iter().enumerate().map(|(i, node)| {
                let (name, port) = (node.name.clone(), node.port());
                drop(node);
                let mut begin = [(name, 0), (format!("/taker{round}_{i}"), port)];
                if i == 1 {
                    begin.reverse();
                }
                begin.map(|(name, port)| claimed(&name, port, client))
            });
            (phoenixes, heirs, moved.collect())
        });
        eventually("the old node is told to shut down", || {
            alive.received("shutdown").len() == 1
        });
        for name in gone {
            eventually("the dead node is unregistered", || {
                api_of(&robot, &name).is_none()
            });
        }
        witness.hear(&client);
        let state = robot.state();
        for node in &phoenixes {
            let found = api_of(&robot, &node.name);
            assert_eq!(found.as_ref(), Some(&node.api), "round {round}");
            let publishers = state.publishers_of(&format!("{}/topic", node.name));
            assert_eq!(publishers, [node.name.as_str()]);
        }
        for node in mortals.iter().chain(moved.iter().flatten()) {
            assert!(
                state.knows(&node.name),
                "{} in round {round}\n{state}",
                node.name
            );
        }
        // Two nodes at the same port are distinguished by their process ids, which rosrescue asks for now.
        eventually("the health check has finished", || {
            let report = status(&client)["last_recovery"].clone();
            report["health_check_ms"].is_number()
        });
        for node in moved.into_iter().flatten() {
            assert_not_shut_down(&node, round);
            give_up(&node, &client);
            stay.push(node);
        }
    }
    eventually("the witness knows the last nodes", || {
        phoenixes.iter().all(|node| {
            let topic = format!("{}/topic", node.name);
            witness.0.updates(&topic).last() == Some(&vec![node.api.clone()])
        })
    });
    stay.push(witness.0);
    stay.extend(phoenixes);
    stay.extend(mortals);
    assert_none_shut_down(&stay);
}

/// When rosrescue examines a master that has come back, it already knows newer nodes of the same names.
#[test]
fn a_newer_node_that_the_new_master_knows_is_not_shut_down() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let witness = Witness::start(&client);
    let names = ["/one", "/two", "/three"];
    let mut old = names.map(|name| claimed(name, 0, &client));
    for round in 0..3 {
        let dead = robot.master_pid();
        crate::support::stop(robot.rescue.pid());
        robot.kill_master();
        robot.revive_master();
        let new = names.map(|name| claimed(name, 0, &robot.bare()));
        robot.rescue.signal(Signal::CONT);
        robot.await_recovery(dead);
        witness.hear(&client);
        for node in &new {
            assert_eq!(api_of(&robot, &node.name), Some(node.api.clone()));
        }
        for node in old.iter().chain(&new) {
            assert_not_shut_down(node, round);
        }
        old = new;
    }
    assert_none_shut_down(&old);
}

/// Real nodes are killed and started again under the same names while there is no master.
#[test]
fn real_nodes_restarted_during_an_outage_are_not_shut_down() {
    let mut robot = Robot::start(Mode::Core);
    let start = |robot: &Robot| {
        let talkers = [(Library::Roscpp, "cpp"), (Library::Rospy, "py")];
        Node::all_ready(talkers.map(|(library, name)| {
            robot.spawn_node(library, "talker", &[&format!("__name:={name}")])
        }))
    };
    let mut talkers = start(&robot);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    let hears_both = |more: usize| {
        for name in ["/cpp", "/py"] {
            listener.wait_messages(name, more);
        }
    };
    hears_both(5);
    let dead = robot.master_pid();
    robot.kill_master();
    for talker in &mut talkers {
        talker.kill();
    }
    let restarted = Instant::now();
    let mut talkers = start(&robot);
    robot.await_recovery(dead);
    hears_both(20);
    let ended = eventually_some("a while has passed", || {
        let ended = talkers.each_mut().map(|talker| talker.exited());
        let is_over = restarted.elapsed() > Duration::from_secs(4);
        (is_over || ended.iter().any(Option::is_some)).then_some(ended)
    });
    assert_eq!(ended, [None, None], "a new talker was shut down");
}
