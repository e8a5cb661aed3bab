//! No node is ever told to shut down that a master which never died would have let live: neither a
//! node that came back under its name at another address, nor one that has the old address now.

use std::sync::atomic::{AtomicI32, Ordering};
use std::time::{Duration, Instant};

use crate::support::{
    Client, FakeNode, Library, Mode, Robot, State, eventually, eventually_some, holds,
    in_both_modes, params, status,
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
fn assert_not_shut_down(node: &FakeNode, round: usize) {
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
fn assert_none_shut_down(nodes: &[FakeNode]) {
    let spared = |node: &FakeNode| node.heard("shutdown").is_empty();
    let all = holds(Duration::from_secs(2), || nodes.iter().all(spared));
    let shut_down = nodes.iter().filter(|node| !spared(node));
    let names: Vec<_> = shut_down.map(|node| node.name.as_str()).collect();
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

in_both_modes!(a_node_that_came_back_under_its_name_in_the_outage_stays);

fn a_node_that_came_back_under_its_name_in_the_outage_stays(mode: Mode) {
    let mut robot = Robot::start(mode);
    let client = robot.client();
    let witness = Witness::start(&client);
    witness
        .0
        .subscribe(&client, "/phoenix/topic", "std_msgs/String");
    let mut node = FakeNode::start("/phoenix");
    claim(&node, &client);
    for round in 0..rounds(mode, 15) {
        // What came late of the round before.
        assert_not_shut_down(&node, round);
        // The old one is dead, or still there: then it is told to make way, as ever.
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
    assert_none_shut_down(&[node, witness.0]);
}

fn api_of(robot: &Robot, node: &str) -> Option<String> {
    let api = robot.bare().ask("lookupNode", params!["/test", node])?;
    api.as_str().map(str::to_owned)
}

/// A node dies and comes back at another port, and its old port goes to somebody else, in either order: all in
/// one outage. Whoever tells the node at the old port to shut down must see that it is another one. Where the
/// port was taken first even a master that never died shuts down its new owner; rosrescue need not.
#[test]
fn who_has_the_port_of_a_node_that_moved_on_stays() {
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

in_both_modes!(who_has_the_port_of_a_dead_node_stays);

/// A node dies and its port goes to another one; nobody comes back.
fn who_has_the_port_of_a_dead_node_stays(mode: Mode) {
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
        eventually("the dead one is taken out", || {
            State::try_read(&robot.bare()).is_ok_and(|state| !state.knows(&name))
        });
        assert_not_shut_down(&node, round);
        witness.hear(&client);
        assert!(robot.state().knows(&heir), "round {round}");
        // A node is told from the next one at its port by its process id, which is asked for now.
        eventually("the health check is over", || {
            let report = status(&client)["last_recovery"].clone();
            report["health_check_ms"].is_number()
        });
    }
    assert_none_shut_down(&[node]);
}

/// A master that is back already knows a newer node of a name when rosrescue comes to look.
#[test]
fn what_the_new_master_knows_already_wins() {
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

/// Real nodes that are killed and started again under their names while there is no master.
#[test]
fn real_nodes_that_are_restarted_in_the_outage_stay() {
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
