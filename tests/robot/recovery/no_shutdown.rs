//! No node is told to shut down if it would live on with a master that never dies: neither a node that came back under
//! its name at another address, nor a node that now has the old address.

use std::sync::atomic::{AtomicI32, Ordering};
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Library, Mode, Robot, State, eventually, eventually_some, holds,
    in_both_modes, params, status,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// How often each scenario is run. `ROSRESCUE_TEST_ROUNDS` overrides it. A core restarts its master at once
/// only for the first five deaths within a minute.
fn rounds(mode: Mode, usual: usize) -> usize {
    let rounds = std::env::var("ROSRESCUE_TEST_ROUNDS");
    match mode {
        Mode::Core => 4,
        Mode::Proxy => rounds.map_or(usual, |text| text.parse().unwrap()),
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

in_both_modes!(a_node_restarted_during_an_outage_is_not_shut_down);

fn a_node_restarted_during_an_outage_is_not_shut_down(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let witness = Witness::start(&client);
    witness
        .0
        .subscribe(&client, "/phoenix/topic", "std_msgs/String");
    let mut node = FakeNode::start("/phoenix");
    claim(&node, &client);
    for round in 0..rounds(mode, 15) {
        // The previous round may have had a late effect.
        assert_not_shut_down(&node, round);
        // The old node is dead, or still runs and is told to shut down as usual.
        let old = (round % 2 == 1).then_some(node);
        node = outage(&mut robot, |client| {
            let new = FakeNode::start("/phoenix");
            claim(&new, client);
            new
        });
        assert_not_shut_down(&node, round);
        let api = node.api.clone();
        assert_eq!(api_of(&robot, &node.name), Some(api), "round {round}");
        if let Some(old) = old {
            eventually("the old node is told to shut down", || {
                old.received("shutdown").len() == 1
            });
        }
        let state = robot.state();
        assert_eq!(state.publishers_of("/phoenix/topic"), ["/phoenix"]);
        witness.hear(&client);
    }
    eventually("the witness knows the last node", || {
        witness.0.updates("/phoenix/topic").last() == Some(&vec![node.api.clone()])
    });
    assert_none_shut_down(&[node, witness.0]);
}

fn api_of(robot: &Robot, node: &str) -> Option<String> {
    let api = robot.bare().ask("lookupNode", params!["/test", node])?;
    api.as_str().map(str::to_owned)
}

/// During one outage a node dies and comes back at another port, and its old port goes to another node, in either
/// order. rosrescue must notice that the node at the old port is another one, and not shut it down. If the port was
/// taken first, even a master that never dies shuts down its new owner.
#[test]
fn a_node_that_has_the_old_port_of_a_moved_node_is_not_shut_down() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let witness = Witness::start(&client);
    let mut stay = Vec::new();
    for round in 0..rounds(Mode::Proxy, 20) {
        let old = FakeNode::start("/moving");
        claim(&old, &client);
        let port = old.port();
        let both = outage(&mut robot, |client| {
            drop(old);
            let mut begin = [("/moving".to_owned(), 0), (format!("/heir{round}"), port)];
            if round % 2 == 1 {
                begin.reverse();
            }
            begin.map(|(name, port)| {
                let node = FakeNode::start_at(&name, port);
                claim(&node, client);
                node
            })
        });
        witness.hear(&client);
        let state = robot.state();
        for node in both {
            assert_not_shut_down(&node, round);
            assert!(state.knows(&node.name), "round {round}\n{state}");
            give_up(&node, &client);
            stay.push(node);
        }
    }
    assert_none_shut_down(&stay);
}

in_both_modes!(a_node_that_has_the_port_of_a_dead_node_is_not_shut_down);

/// A node dies and its port goes to another node. The dead node does not come back.
fn a_node_that_has_the_port_of_a_dead_node_is_not_shut_down(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let witness = Witness::start(&client);
    let mut node = FakeNode::start("/first");
    claim(&node, &client);
    for round in 0..rounds(mode, 10) {
        let heir = format!("/heir{round}");
        let port = node.port();
        let name = node.name.clone();
        assert_not_shut_down(&node, round);
        node = outage(&mut robot, |client| {
            drop(node);
            let node = FakeNode::start_at(&heir, port);
            claim(&node, client);
            node
        });
        eventually("the dead node is unregistered", || {
            State::try_read(&robot.bare()).is_ok_and(|state| !state.knows(&name))
        });
        assert_not_shut_down(&node, round);
        witness.hear(&client);
        assert!(robot.state().knows(&heir), "round {round}");
        // Two nodes at the same port are distinguished by their process ids, which rosrescue asks for now.
        eventually("the health check has finished", || {
            let report = status(&client)["last_recovery"].clone();
            report["health_check_ms"].is_number()
        });
    }
    assert_none_shut_down(&[node]);
}

/// When rosrescue examines a master that has come back, it already knows a newer node of the same name.
#[test]
fn a_newer_node_that_the_new_master_knows_is_not_shut_down() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let witness = Witness::start(&client);
    let mut old = FakeNode::start("/both");
    claim(&old, &client);
    for round in 0..rounds(Mode::Proxy, 8) {
        let dead = robot.master_pid();
        crate::support::stop(robot.rescue.pid());
        robot.kill_master();
        robot.revive_master();
        let new = FakeNode::start("/both");
        claim(&new, &robot.bare());
        robot.rescue.signal(Signal::CONT);
        robot.await_recovery(dead);
        witness.hear(&client);
        assert_eq!(api_of(&robot, "/both"), Some(new.api.clone()));
        assert_not_shut_down(&old, round);
        assert_not_shut_down(&new, round);
        old = new;
    }
    assert_none_shut_down(&[old]);
}

/// Real nodes are killed and started again under the same names while there is no master.
#[test]
fn real_nodes_restarted_during_an_outage_are_not_shut_down() {
    for library in [Library::Rospy, Library::Roscpp] {
        let mut robot = Robot::start(Mode::Core);
        let mut talker = robot.node(library, "talker", &[]);
        let listener = robot.node(library, "listener", &[]);
        listener.wait_messages("/talker", 5);
        for _ in 0..2 {
            let dead = robot.master_pid();
            robot.kill_master();
            talker.kill();
            let start = Instant::now();
            talker = robot.node(library, "talker", &[]);
            robot.await_recovery(dead);
            listener.wait_messages("/talker", 20);
            let alive = eventually_some("a while has passed", || {
                let ended = talker.exited();
                (ended.is_some() || start.elapsed() > Duration::from_secs(4)).then_some(ended)
            });
            assert_eq!(alive, None, "{library:?}: the new talker was shut down");
        }
    }
}
