//! An answered write was done once and is as safe as `--sync` says, even if rosrescue or the mirror had to find out
//! first which writes the master has run.

use std::fs;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::support::{
    Client, FailingDisk, FakeNode, Mode, Relay, Robot, Rosmaster, Scratch, Setup, Trouble,
    eventually, holds, params, signal, status, stop, unreadable,
};
use ros1_master::xmlrpc::{Reply, Value};
use rustix::process::Signal;

/// Runs `work` while no sync of `disk` finishes, and checks that `work` ends only after the sync.
#[track_caller]
fn held_up<T: Send + 'static>(disk: &FailingDisk, work: impl FnOnce() -> T + Send + 'static) -> T {
    disk.begin(Trouble::HangsOnSync);
    let work = thread::spawn(work);
    let waits = holds(Duration::from_millis(700), || !work.is_finished());
    disk.heal();
    assert!(waits, "the answer did not wait for the disk");
    work.join().unwrap()
}

#[track_caller]
fn assert_done(reply: &Reply) {
    let done = matches!(reply, Reply::Value(Value::Array(answer)) if answer[0] == Value::Int(1));
    assert!(done, "{reply:?}");
}

#[test]
fn answers_wait_for_a_checkpoint_that_was_opened_late() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let disk = FailingDisk::new(&scratch);
    // A file where the checkpoint's folder is to be.
    let obstacle = scratch.path("obstacle");
    fs::write(&obstacle, "").unwrap();
    let setup =
        Setup::proxy(&scratch, master.port).at_checkpoint(obstacle.join("latest-chkpt.yaml"));
    let mut rescue = disk.under(setup.args(["--sync", "always"])).start();
    let client = rescue.client();
    rescue.wait_line("the log says that there is no checkpoint", |line| {
        line.contains("a crash of rosrescue itself would lose")
    });
    client.set_param("/unprotected", 1);
    fs::remove_file(&obstacle).unwrap();
    rescue.wait_line("the log says that there is a checkpoint", |line| {
        line.contains("protected again")
    });
    for value in 0..2 {
        let client = client.clone();
        held_up(&disk, move || client.set_param("/protected", value));
    }
}

#[test]
fn a_write_during_an_outage_is_on_the_disk_before_its_answer() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let disk = FailingDisk::new(&scratch);
    let setup = Setup::proxy(&scratch, master.port).args(["--sync", "always"]);
    let rescue = disk.under(setup).start();
    let client = rescue.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    master.kill();
    eventually("the gate is shut", || status(&client)["open"] == false);
    let leaving = client.clone();
    held_up(&disk, move || node.unpublish(&leaving, "/topic"));
    // The answer to a write that changes nothing also waits until the write before it is on the disk.
    held_up(&disk, move || {
        let first = thread::spawn({
            let client = client.clone();
            move || client.set_param("/same", 1)
        });
        eventually("the mirror has it", || client.param("/same").is_some());
        client.set_param("/same", 1);
        first
    })
    .join()
    .unwrap();
}

/// rosrescue and the master are killed after the call has been answered.
#[test]
fn the_effect_of_an_undecodable_call_is_on_the_disk_before_its_answer() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let disk = FailingDisk::new(&scratch);
    let mut rescue = disk.under(Setup::proxy(&scratch, master.port)).start();
    for key in ["/a", "/b"] {
        let client = rescue.client();
        let reply = held_up(&disk, move || {
            client.exchange(&unreadable(key, 1)).unwrap().reply()
        });
        assert_done(&reply);
        signal(rescue.pid(), Signal::KILL);
        master.kill();
        rescue.wait();
        master = Rosmaster::start_at(&scratch, master.port);
        rescue.start_again();
        rescue.wait_serving();
        assert_eq!(rescue.client().param(key), Some(1.into()));
    }
}

/// If there is no checkpoint file, clients do not wait for it.
#[test]
fn an_undecodable_call_is_answered_without_a_checkpoint() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let obstacle = scratch.path("obstacle");
    fs::write(&obstacle, "").unwrap();
    let setup = Setup::proxy(&scratch, master.port).at_checkpoint(obstacle.join("checkpoint"));
    let rescue = setup.start();
    assert_done(
        &rescue
            .client()
            .exchange(&unreadable("/a", 1))
            .unwrap()
            .reply(),
    );
}

fn send_unreadable(client: &Client, key: &'static str) -> JoinHandle<Reply> {
    let client = client.clone();
    thread::spawn(move || client.exchange(&unreadable(key, 1)).unwrap().reply())
}

/// Both calls wait until the state has been read from the master, and the first two attempts to read it are
/// lost.
#[test]
fn undecodable_calls_share_the_read_of_the_master_that_shows_their_effect() {
    let scratch = Scratch::new();
    let (master, relay, rescue) = Relay::between(&scratch);
    relay.swallow("getSystemState", 2);
    let first = send_unreadable(&rescue.client(), "/first");
    eventually("one attempt to read the state is lost", || {
        relay.to_swallow() < 2
    });
    let second = send_unreadable(&rescue.client(), "/second");
    for call in [first, second] {
        assert_done(&call.join().unwrap());
    }
    assert_eq!(relay.to_swallow(), 0);
    assert_eq!(status(&rescue.client())["state"]["params"], 2);
    assert_eq!(master.client().param("/second"), Some(1.into()));
}

/// The master has nothing left that would distinguish it from an empty one, not even a topic type or a parameter.
#[test]
fn an_unregistration_during_a_hang_reaches_a_master_that_holds_nothing_else() {
    let probes = ["--probe-interval", "100", "--probe-timeout", "300"];
    let robot = Robot::start_with(Mode::Proxy, &probes);
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.watch_param(&client, "/key");
    let pid = robot.master_pid();
    stop(pid);
    eventually("the gate is shut", || !robot.is_open());
    let params = params!["/node", node.api.as_str(), "/key"];
    client.ok("unsubscribeParam", params);
    signal(pid, Signal::CONT);
    eventually("the gate is open", || robot.is_open());
    assert_eq!(robot.bare().ask("lookupNode", params!["/n", "/node"]), None);
    assert_eq!(robot.master_pid(), pid);
}

/// The master that continues runs the call itself.
#[test]
fn an_unsubscription_under_way_in_a_hung_master_takes_effect_when_it_continues() {
    let probes = ["--probe-interval", "100", "--probe-timeout", "300"];
    let robot = Robot::start_with(Mode::Proxy, &probes);
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    node.watch_param(&client, "/key");
    let pid = robot.master_pid();
    stop(pid);
    client.ok(
        "unsubscribeParam",
        params!["/node", node.api.as_str(), "/key"],
    );
    signal(pid, Signal::CONT);
    eventually("the gate is open", || robot.is_open());
    assert_eq!(robot.master_pid(), pid);
    let told = node.received("paramUpdate").len();
    client.set_param("/key", 1);
    let quiet = || node.received("paramUpdate").len() == told;
    assert!(holds(Duration::from_millis(500), quiet));
    assert_eq!(robot.state().publishers_of("/topic"), ["/node"]);
    assert_eq!(status(&client)["counters"]["divergences"], 0);
    let log = robot.rescue.stderr().join("\n");
    assert!(!log.contains("differs from what was injected"), "{log}");
}

/// The node is asked what it publishes while it publishes nothing, and publishes again before that has any
/// effect. Its registration, during the outage that has begun in the meantime, wins.
#[test]
fn a_new_registration_is_not_removed_because_of_an_older_report_of_the_node() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let node = FakeNode::start("/node");
    for topic in ["/topic", "/other"] {
        node.publish(&client, topic, "std_msgs/String");
    }
    let subscriber = FakeNode::start("/subscriber");
    subscriber.subscribe(&client, "/topic", "std_msgs/String");
    let asked = |method: &str| node.received(method).len();
    eventually("the node has been asked after it registered", || {
        asked("getPid") > 0
    });
    node.claim_publication("/topic", None);
    // A topic that the node does not report is unregistered only after the second report.
    let second = asked("getPid") + 2;
    node.hold_at("getPid", second);
    robot.crash_master();
    eventually("the node is asked again", || asked("getPid") >= second);
    let dead = robot.master_pid();
    robot.kill_master_at_once(dead);
    eventually("the gate is shut", || !robot.is_open());
    let updates = subscriber.updates("/topic").len();
    let params = params!["/node", "/topic", "std_msgs/String", node.api.as_str()];
    client.ok("registerPublisher", params);
    node.release();
    eventually("the node has answered", || {
        asked("getSubscriptions") >= 2 && asked("getPublications") >= 2
    });
    node.claim_publication("/topic", Some("std_msgs/String"));
    robot.revive_master();
    robot.await_recovery(dead);
    eventually("the health check has finished", || {
        let report = status(&client)["last_recovery"].clone();
        !report["health_check_ms"].is_null()
    });
    let told = &subscriber.updates("/topic")[updates..];
    assert!(
        told.iter().all(|list| *list == [node.api.as_str()]),
        "{told:?}"
    );
    assert_eq!(robot.state().publishers_of("/topic"), ["/node"]);
}
