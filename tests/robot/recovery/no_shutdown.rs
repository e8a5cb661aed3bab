//! No node is ever told to shut down that a master which never died would have let live: neither a
//! node that came back under its name at another address, nor one that has the old address now.

use std::sync::atomic::{AtomicI32, Ordering};
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Library, Mode, Robot, State, eventually, eventually_some, holds, params,
};
use rosrescue::xmlrpc::Value;
use rustix::process::Signal;

/// How often each thing is done. `ROSRESCUE_TEST_ROUNDS` says otherwise. A core restarts a master at
/// once for the first five deaths within a minute only.
fn rounds(mode: Mode, usual: usize) -> usize {
    let rounds = std::env::var("ROSRESCUE_TEST_ROUNDS");
    match mode {
        Mode::Core => 4,
        Mode::Proxy => rounds.map_or(usual, |text| text.parse().unwrap()),
    }
}

#[track_caller]
fn assert_innocent(node: &FakeNode, round: usize) {
    assert_eq!(
        node.heard("shutdown"),
        Vec::<Vec<Value>>::new(),
        "{} in round {round}",
        node.name
    );
}

/// Hears of a parameter from the master, whose threads take what it has to tell in order: what was to be
/// told before has been told, or is being told.
struct Witness(FakeNode);

impl Witness {
    fn start(client: &Client) -> Self {
        let node = FakeNode::start("/witness");
        node.watch_param(client, "/round");
        Self(node)
    }

    #[track_caller]
    fn hear(&self, client: &Client) {
        let before = self.0.heard("paramUpdate").len();
        let number = i32::try_from(before).unwrap() + 1_000_000;
        client.set_param("/round", number);
        eventually("the master tells its news", || {
            let heard = self.0.heard("paramUpdate");
            heard.iter().any(|told| told[2] == Value::Int(number))
        });
    }
}

/// The master calls beside everything else: long enough for it to have done so.
#[track_caller]
fn assert_all_innocent(nodes: &[FakeNode]) {
    let innocent = |node: &FakeNode| node.heard("shutdown").is_empty();
    let all = holds(Duration::from_secs(2), || nodes.iter().all(innocent));
    let guilty = nodes.iter().filter(|node| !innocent(node));
    let names: Vec<_> = guilty.map(|node| node.name.as_str()).collect();
    assert!(all, "told to shut down: {names:?}");
}

/// Makes the node a process of its own, and registers this and that.
fn claim(node: &FakeNode, client: &Client) {
    static PIDS: AtomicI32 = AtomicI32::new(1_000_000);
    node.claim_pid(PIDS.fetch_add(1, Ordering::Relaxed));
    node.publish(client, &format!("{}/topic", node.name), "std_msgs/String");
    node.subscribe(client, "/shared", "std_msgs/String");
    node.offer(client, &format!("{}/service", node.name));
}

/// Takes back what [`claim`] registered.
fn give_up(node: &FakeNode, client: &Client) {
    node.unpublish(client, &format!("{}/topic", node.name));
    node.unsubscribe(client, "/shared");
    node.withdraw(client, &format!("{}/service", node.name));
}

/// The master's death, with what `meanwhile` does to the nodes until the new master is there.
fn outage<T>(robot: &mut Robot, meanwhile: impl FnOnce(&Client) -> T) -> T {
    let dead = robot.master_pid();
    robot.kill_master();
    let result = meanwhile(&robot.client());
    robot.revive_master();
    robot.await_recovery(dead);
    result
}

#[test]
fn a_node_that_came_back_under_its_name_in_the_outage_stays() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        let witness = Witness::start(&client);
        witness
            .0
            .subscribe(&client, "/phoenix/topic", "std_msgs/String");
        let mut node = FakeNode::start("/phoenix");
        claim(&node, &client);
        for round in 0..rounds(mode, 50) {
            // What came late of the round before.
            assert_innocent(&node, round);
            // The old one is dead, or still there: then it is told to make way, as ever.
            let old = (round % 2 == 1).then_some(node);
            node = outage(&mut robot, |client| {
                let new = FakeNode::start("/phoenix");
                claim(&new, client);
                new
            });
            assert_innocent(&node, round);
            let api = node.api.clone();
            assert_eq!(api_of(&robot, &node.name), Some(api), "round {round}");
            if let Some(old) = old {
                eventually("the old one is told to make way", || {
                    old.heard("shutdown").len() == 1
                });
            }
            let state = robot.state();
            assert_eq!(state.publishers_of("/phoenix/topic"), ["/phoenix"]);
            witness.hear(&client);
        }
        eventually("the witness knows the last one", || {
            witness.0.updates("/phoenix/topic").last() == Some(&vec![node.api.clone()])
        });
        assert_all_innocent(&[node, witness.0]);
    }
}

fn api_of(robot: &Robot, node: &str) -> Option<String> {
    let api = robot.bare().ask("lookupNode", params!["/test", node])?;
    api.as_str().map(str::to_owned)
}

/// A node dies, comes back at another port, and then its old port goes to somebody else: all in one
/// outage. Whoever tells the node at the old port to shut down must see that it is another one.
#[test]
fn who_has_the_port_of_a_node_that_moved_on_stays() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let witness = Witness::start(&client);
    let mut stay = Vec::new();
    for round in 0..rounds(Mode::Proxy, 50) {
        let old = FakeNode::start("/moving");
        claim(&old, &client);
        let port = old.port();
        let (moved, heir) = outage(&mut robot, |client| {
            drop(old);
            let moved = FakeNode::start("/moving");
            claim(&moved, client);
            let heir = FakeNode::start_at(&format!("/heir{round}"), port);
            claim(&heir, client);
            (moved, heir)
        });
        witness.hear(&client);
        assert_innocent(&moved, round);
        assert_innocent(&heir, round);
        let state = robot.state();
        assert_eq!(state.publishers_of("/moving/topic"), ["/moving"]);
        assert!(state.knows(&heir.name), "round {round}\n{state}");
        for node in [&moved, &heir] {
            give_up(node, &client);
        }
        stay.extend([moved, heir]);
    }
    assert_all_innocent(&stay);
}

/// The old port goes to somebody else first, and then the node comes back elsewhere. Here even a
/// master that never died shuts down the new owner of the port; rosrescue need not.
#[test]
fn who_had_the_port_before_the_node_moved_on_stays_too() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let witness = Witness::start(&client);
    let mut stay = Vec::new();
    for round in 0..rounds(Mode::Proxy, 50) {
        let old = FakeNode::start("/moving");
        claim(&old, &client);
        let port = old.port();
        let (moved, heir) = outage(&mut robot, |client| {
            drop(old);
            let heir = FakeNode::start_at(&format!("/heir{round}"), port);
            claim(&heir, client);
            let moved = FakeNode::start("/moving");
            claim(&moved, client);
            (moved, heir)
        });
        witness.hear(&client);
        assert_innocent(&moved, round);
        assert_innocent(&heir, round);
        for node in [&moved, &heir] {
            give_up(node, &client);
        }
        stay.extend([moved, heir]);
    }
    assert_all_innocent(&stay);
}

/// A node dies and its port goes to another one; nobody comes back.
#[test]
fn who_has_the_port_of_a_dead_node_stays() {
    for mode in [Mode::Core, Mode::Proxy] {
        let mut robot = Robot::start(mode);
        let client = robot.client();
        let witness = Witness::start(&client);
        let mut node = FakeNode::start("/first");
        claim(&node, &client);
        for round in 0..rounds(mode, 15) {
            let heir = format!("/heir{round}");
            let port = node.port();
            let name = node.name.clone();
            assert_innocent(&node, round);
            node = outage(&mut robot, |client| {
                drop(node);
                let node = FakeNode::start_at(&heir, port);
                claim(&node, client);
                node
            });
            eventually("the dead one is taken out", || {
                State::try_read(&robot.bare()).is_ok_and(|state| !state.knows(&name))
            });
            assert_innocent(&node, round);
            witness.hear(&client);
            assert!(robot.state().knows(&heir), "round {round}");
        }
        assert_all_innocent(&[node]);
    }
}

/// A master that is back already knows a newer node of a name when rosrescue comes to look.
#[test]
fn what_the_new_master_knows_already_wins() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let witness = Witness::start(&client);
    let mut old = FakeNode::start("/both");
    claim(&old, &client);
    for round in 0..rounds(Mode::Proxy, 15) {
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
        assert_innocent(&old, round);
        assert_innocent(&new, round);
        old = new;
    }
    assert_all_innocent(&[old]);
}

/// Real nodes that are killed and started again under their names while there is no master.
#[test]
fn real_nodes_that_are_restarted_in_the_outage_stay() {
    for library in [Library::Rospy, Library::Roscpp] {
        let mut robot = Robot::start(Mode::Core);
        let mut talker = robot.node(library, "talker", &[]);
        let listener = robot.node(library, "listener", &[]);
        listener.wait_messages("/talker", 5);
        for _ in 0..3 {
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
