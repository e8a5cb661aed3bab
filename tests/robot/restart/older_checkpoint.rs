//! rosrescue is started again with a checkpoint that is older than the living master, because the disk was
//! full or a copy was restored. The master keeps the state that it holds.

use std::fs;
use std::path::Path;

use ros1_master::xmlrpc::Value;

use super::sessions::another_boot;
use crate::support::{
    Client, FakeNode, Rescue, Rosmaster, Scratch, Setup, SmallDisk, State, eventually, free_port,
    params, status,
};

/// The changing nodes of a robot: they start, end and move. Parameters change as well.
struct Nodes {
    old: FakeNode,
    leaving: FakeNode,
    /// A node that keeps its address.
    staying: FakeNode,
    moved: Option<FakeNode>,
}

impl Nodes {
    fn begin(client: &Client) -> Self {
        let nodes = Self {
            old: FakeNode::start("/moving"),
            leaving: FakeNode::start("/leaving"),
            staying: FakeNode::start("/staying"),
            moved: None,
        };
        nodes.old.publish(client, "/topic", "std_msgs/String");
        nodes.leaving.publish(client, "/topic", "std_msgs/String");
        nodes.leaving.offer(client, "/leaving/service");
        nodes.staying.subscribe(client, "/topic", "std_msgs/String");
        for key in ["/changed", "/deleted"] {
            client.set_param(key, 1);
        }
        nodes
    }

    fn change(&mut self, client: &Client) {
        self.leaving.unpublish(client, "/topic");
        self.leaving.withdraw(client, "/leaving/service");
        let moved = FakeNode::start("/moving");
        moved.publish(client, "/topic", "std_msgs/String");
        self.moved = Some(moved);
        self.staying.publish(client, "/late", "std_msgs/String");
        client.set_param("/changed", 2);
        client.set_param("/added", 2);
        client.ok("deleteParam", params!["/test", "/deleted"]);
    }
}

/// Waits until calls pass to the same master, and checks that the master still has the state `wanted`.
#[track_caller]
fn assert_goes_on(rescue: &Rescue, bare: &Client, pid: u32, wanted: &State, nodes: &Nodes) {
    let client = rescue.client();
    eventually("calls pass to the master", || {
        status(&client)["open"] == true
    });
    eventually("the health check has finished", || {
        status(&client)["last_recovery"]["health_check_ms"].is_number()
    });
    assert_eq!(
        bare.master_pid(),
        Some(pid),
        "the same master must stay in use"
    );
    wanted.assert_same(&State::read(bare), "in the master");
    wanted.assert_same(&State::read(&client), "through rosrescue");
    let moved = nodes.moved.as_ref().unwrap();
    for node in [&nodes.staying, moved] {
        assert_eq!(node.received("shutdown"), Vec::<Vec<Value>>::new());
    }
}

fn is_unprotected(rescue: &Rescue) -> bool {
    !status(&rescue.client())["unprotected"].is_null()
}

/// The disk fills up while `rescue` serves the master at `bare`, and the robot changes. rosrescue ends by `end` while
/// the disk is full and is started again, and a second time when the disk has room.
fn a_full_disk(mut rescue: Rescue, bare: &Client, disk: &SmallDisk, end: impl Fn(&mut Rescue)) {
    let client = rescue.client();
    let mut nodes = Nodes::begin(&client);
    let pid = bare.master_pid().unwrap();
    let filler = disk.fill();
    let mut count = 0;
    eventually("rosrescue reports that it is unprotected", || {
        count += 1;
        client.set_param("/count", count);
        is_unprotected(&rescue)
    });
    nodes.change(&client);
    let wanted = State::read(bare);

    end(&mut rescue);
    rescue.start_again();
    rescue.wait_serving();
    assert_goes_on(&rescue, bare, pid, &wanted, &nodes);
    rescue.wait_line("the log says that the master is newer", |line| {
        line.contains("the master's state is newer than the checkpoint")
    });
    assert!(is_unprotected(&rescue));
    client.set_param("/changed", 3);
    let wanted = State::read(bare);

    end(&mut rescue);
    fs::remove_file(filler).unwrap();
    rescue.start_again();
    rescue.wait_serving();
    assert_goes_on(&rescue, bare, pid, &wanted, &nodes);
    eventually("rosrescue is protected", || !is_unprotected(&rescue));
}

#[test]
fn the_master_of_a_killed_core_keeps_its_state_after_a_full_disk() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    let port = free_port();
    let rescue = Setup::core(&scratch, port)
        .arg("--no-rosout")
        .at_checkpoint(disk.folder.join("latest-chkpt.yaml"))
        .wrapped(|command| disk.on(command))
        .start();
    a_full_disk(rescue, &Client::new(port), &disk, |rescue| rescue.kill());
}

#[test]
fn the_master_of_a_stopped_proxy_keeps_its_state_after_a_full_disk() {
    let scratch = Scratch::new();
    let disk = SmallDisk::new(&scratch, "1m");
    let master = Rosmaster::start(&scratch);
    let rescue = Setup::proxy(&scratch, master.port)
        .at_checkpoint(disk.folder.join("latest-chkpt.yaml"))
        .wrapped(|command| disk.on(command))
        .start();
    a_full_disk(rescue, &master.client(), &disk, |rescue| {
        assert_eq!(rescue.terminate().code(), Some(0));
    });
}

/// Restores `copy` in place of the checkpoint at `path`, as from a backup or a snapshot of the file system.
fn put_back(copy: &[u8], path: &Path) {
    let folder = path.parent().unwrap();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        if entry.file_name().to_string_lossy().contains("chkpt.yaml") {
            fs::remove_file(entry.path()).unwrap();
        }
    }
    fs::write(path, copy).unwrap();
}

#[test]
fn a_master_keeps_its_state_although_an_older_checkpoint_was_restored() {
    for stopped in [false, true] {
        let scratch = Scratch::new();
        let master = Rosmaster::start(&scratch);
        let mut rescue = Setup::proxy(&scratch, master.port).start();
        let client = rescue.client();
        let mut nodes = Nodes::begin(&client);
        let copy = fs::read(rescue.checkpoint()).unwrap();
        nodes.change(&client);
        let wanted = State::read(&master.client());
        match stopped {
            false => rescue.kill(),
            true => assert_eq!(rescue.terminate().code(), Some(0)),
        }
        put_back(&copy, &rescue.checkpoint());
        rescue.start_again();
        rescue.wait_serving();
        assert_goes_on(&rescue, &master.client(), master.pid(), &wanted, &nodes);
    }
}

/// The power of rosrescue's computer fails, and the disk loses everything that was not synced. The master and
/// some nodes are on another computer and live on.
#[test]
fn a_master_keeps_its_state_after_a_power_cut_of_rosrescues_computer() {
    let cases = [("never", "auto"), ("never", "always"), ("always", "always")];
    for (sync, restore) in cases {
        let scratch = Scratch::new();
        let master = Rosmaster::start(&scratch);
        let setup = Setup::proxy(&scratch, master.port);
        let setup = setup.args(["--sync", sync, "--restore", restore]);
        let mut rescue = setup.start();
        let client = rescue.client();
        let mut nodes = Nodes::begin(&client);
        let synced = fs::read(rescue.checkpoint()).unwrap();
        nodes.change(&client);
        let wanted = State::read(&master.client());
        rescue.kill();
        if sync != "always" {
            put_back(&synced, &rescue.checkpoint());
        }
        rescue.start_after_reboot(&another_boot(&scratch));
        rescue.wait_serving();
        assert_goes_on(&rescue, &master.client(), master.pid(), &wanted, &nodes);
        // The next start knows this state.
        eventually("rosrescue is protected", || !is_unprotected(&rescue));
        rescue.kill();
        rescue.start_again();
        rescue.wait_serving();
        assert_goes_on(&rescue, &master.client(), master.pid(), &wanted, &nodes);
    }
}

/// Since the copy was made the master has died, and the next master got the state in the next session.
#[test]
fn a_checkpoint_of_an_earlier_session_does_not_replace_the_masters_state() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    client.set_param("/of_before", 1);
    let copy = fs::read(rescue.checkpoint()).unwrap();
    // No node is alive.
    assert_eq!(rescue.terminate().code(), Some(0));
    rescue.start_again();
    rescue.wait_serving();
    let mut nodes = Nodes::begin(&client);
    client.ok("deleteParam", params!["/test", "/of_before"]);
    let dead = master.pid();
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    eventually("the next master is served", || {
        client.master_pid().is_some_and(|pid| pid != dead) && status(&client)["open"] == true
    });
    nodes.change(&client);
    let wanted = State::read(&master.client());
    rescue.kill();
    put_back(&copy, &rescue.checkpoint());
    rescue.start_again();
    rescue.wait_serving();
    assert_goes_on(&rescue, &master.client(), master.pid(), &wanted, &nodes);
}

/// Writes that are answered before the master has been examined count, even if they change nothing in an
/// older checkpoint.
#[test]
fn writes_answered_before_the_master_is_examined_are_kept() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/back", 1);
    let copy = fs::read(rescue.checkpoint()).unwrap();
    node.unpublish(&client, "/topic");
    client.set_param("/back", 2);
    client.set_param("/new", 2);
    client.set_param("/going", 2);
    rescue.kill();
    put_back(&copy, &rescue.checkpoint());
    crate::support::stop(master.pid());
    rescue.start_again();
    eventually("rosrescue answers", || client.param("/back").is_some());
    // The mirror of the older checkpoint does not have this parameter.
    client
        .call("deleteParam", params!["/node", "/going"])
        .unwrap();
    client.set_param("/back", 1);
    node.publish(&client, "/topic", "std_msgs/String");
    crate::support::signal(master.pid(), rustix::process::Signal::CONT);
    rescue.wait_serving();
    let bare = master.client();
    eventually("calls pass to the master", || {
        status(&client)["open"] == true
    });
    assert_eq!(bare.param("/back"), Some(1.into()));
    assert_eq!(bare.param("/new"), Some(2.into()));
    assert_eq!(bare.param("/going"), None);
    assert_eq!(State::read(&bare).publishers_of("/topic"), ["/node"]);
}
