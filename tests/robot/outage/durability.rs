//! What an answer promises: that what it tells of was done, once, and is as safe as `--sync` says, also if
//! rosrescue or the mirror had to find out first what was done.

use std::fs;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::support::{
    Client, FailingDisk, FakeNode, Mode, Relay, Robot, Rosmaster, Scratch, Setup, Trouble,
    eventually, holds, params, signal, status, stop, unreadable,
};
use rosrescue::xmlrpc::{Reply, Value};
use rustix::process::Signal;

/// Runs `work` while nothing is forced to `disk`, and sees that it ends only after that.
#[track_caller]
fn held_up<T: Send + 'static>(disk: &FailingDisk, work: impl FnOnce() -> T + Send + 'static) -> T {
    disk.begin(Trouble::HangsOnSync);
    let work = thread::spawn(work);
    let waits = holds(Duration::from_millis(700), || !work.is_finished());
    disk.heal();
    assert!(waits, "it did not wait for the disk");
    work.join().unwrap()
}

#[track_caller]
fn assert_done(reply: &Reply) {
    let done = matches!(reply, Reply::Value(Value::Array(answer)) if answer[0] == Value::Int(1));
    assert!(done, "{reply:?}");
}

#[test]
fn a_checkpoint_that_is_opened_late_is_waited_for_like_any_other() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let disk = FailingDisk::new(&scratch);
    // Where its folder is to be.
    let obstacle = scratch.path("obstacle");
    fs::write(&obstacle, "").unwrap();
    let setup =
        Setup::proxy(&scratch, master.port).at_checkpoint(obstacle.join("latest-chkpt.yaml"));
    let mut rescue = disk.under(setup.args(["--sync", "always"])).start();
    let client = rescue.client();
    rescue.wait_line("that it has no checkpoint", |line| {
        line.contains("a crash of rosrescue itself would lose")
    });
    client.set_param("/unprotected", 1);
    fs::remove_file(&obstacle).unwrap();
    rescue.wait_line("that it has one", |line| line.contains("protected again"));
    for value in 0..2 {
        let client = client.clone();
        held_up(&disk, move || client.set_param("/protected", value));
    }
}

#[test]
fn a_write_in_an_outage_is_on_the_disk_before_its_answer() {
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
    // What changes nothing is no safer than what made it so.
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

/// rosrescue and the master are killed when it has been answered.
#[test]
fn what_a_call_did_that_cannot_be_read_is_in_the_file_before_its_answer() {
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

/// Without a file to write to nobody waits for it.
#[test]
fn a_call_that_cannot_be_read_is_answered_without_a_checkpoint() {
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

/// Both wait for a look, and the first two looks do not come back.
#[test]
fn calls_that_cannot_be_read_wait_together_for_a_look_that_shows_what_they_did() {
    let scratch = Scratch::new();
    let (master, relay, rescue) = Relay::between(&scratch);
    relay.swallow("getSystemState", 2);
    let first = send_unreadable(&rescue.client(), "/first");
    eventually("a look is lost", || relay.to_swallow() == 1);
    let second = send_unreadable(&rescue.client(), "/second");
    for call in [first, second] {
        assert_done(&call.join().unwrap());
    }
    assert_eq!(relay.to_swallow(), 0);
    assert_eq!(status(&rescue.client())["state"]["params"], 2);
    assert_eq!(master.client().param("/second"), Some(1.into()));
}

/// Not even a topic or a parameter is left in it by which it could be told from an empty one.
#[test]
fn what_was_unregistered_in_a_hang_is_told_to_a_master_that_holds_nothing_else() {
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

/// The master that goes on runs it itself.
#[test]
fn an_unsubscription_under_way_in_a_master_that_hangs_is_done_once_it_goes_on() {
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
    let told = node.heard("paramUpdate").len();
    client.set_param("/key", 1);
    let quiet = || node.heard("paramUpdate").len() == told;
    assert!(holds(Duration::from_millis(500), quiet));
    assert_eq!(robot.state().publishers_of("/topic"), ["/node"]);
    assert_eq!(status(&client)["counters"]["divergences"], 0);
    let log = robot.rescue.stderr().join("\n");
    assert!(!log.contains("differs from what was injected"), "{log}");
}

/// The node is asked what it publishes while it does not, and before anything follows from that it does
/// again: its registration, in the outage that has begun meanwhile, is the last word.
#[test]
fn what_a_node_registers_anew_is_not_taken_from_it_by_an_older_answer() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let node = FakeNode::start("/node");
    for topic in ["/topic", "/other"] {
        node.publish(&client, topic, "std_msgs/String");
    }
    let subscriber = FakeNode::start("/subscriber");
    subscriber.subscribe(&client, "/topic", "std_msgs/String");
    let asked = |method: &str| node.heard(method).len();
    eventually("it has been asked as a new node", || asked("getPid") == 1);
    node.claim_publication("/topic", None);
    robot.crash_master();
    // What it lacks is believed at the second time.
    eventually("it is asked once", || asked("getSubscriptions") == 1);
    node.hold();
    eventually("it is asked again", || asked("getPid") == 3);
    let dead = robot.master_pid();
    robot.kill_master_at_once(dead);
    eventually("the gate is shut", || !robot.is_open());
    let updates = subscriber.updates("/topic").len();
    let params = params!["/node", "/topic", "std_msgs/String", node.api.as_str()];
    client.ok("registerPublisher", params);
    node.release();
    eventually("it has answered", || {
        asked("getSubscriptions") == 2 && asked("getPublications") == 2
    });
    node.claim_publication("/topic", Some("std_msgs/String"));
    robot.revive_master();
    robot.await_recovery(dead);
    eventually("the health check is over", || {
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
