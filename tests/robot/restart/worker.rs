//! Restarts of rosrescue itself. It adopts a living master, fills an empty one, restores the parts of the checkpoint
//! that still apply, and takes over a system that ran without it.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::Path;
use std::thread;
use std::time::Duration;

use crate::support::{
    Client, FakeNode, Library, Mode, NODES, Node, Rescue, Robot, Rosmaster, Scratch, Setup, State,
    alive, eventually, eventually_some, free_port, signal, status,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

#[test]
fn a_killed_rosrescue_adopts_the_living_master_when_restarted() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let talker = robot.node(Library::Roscpp, "talker", &[]);
    let listener = robot.node(Library::Rospy, "listener", &[]);
    let node = FakeNode::start("/fake");
    client.set_param("/watched", 1);
    node.watch_param(&client, "/watched");
    node.subscribe(&client, "/chatter", "std_msgs/String");
    listener.wait_messages("/talker", 5);
    let before = robot.settled_state();
    let master = robot.master_pid();
    // rosrescue itself tells subscribers the state a second after it has adopted the master.
    let updates = || {
        let calls = node.calls().into_iter();
        let by_master = calls.filter(|call| !call.from_rosrescue);
        by_master
            .filter(|call| call.method == "publisherUpdate")
            .count()
    };
    let updates_before = updates();

    robot.rescue.kill();
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    assert_eq!(
        robot.master_pid(),
        master,
        "the living master was replaced instead of adopted"
    );
    before.assert_same(&robot.state(), "after rosrescue's own restart");
    assert_eq!(updates(), updates_before, "the living master was injected");

    // rosrescue can restore everything that it adopted. It knows parameter subscriptions from the checkpoint.
    robot.crash_master();
    before.assert_same(&robot.state(), "after the master's crash that followed");
    client.set_param("/watched", 2);
    eventually("the parameter's subscriber is notified", || {
        node.received("paramUpdate")
            .last()
            .is_some_and(|call| call[2] == Value::Int(2))
    });
    assert_eq!(node.received("shutdown"), Vec::<Vec<_>>::new());
    listener.wait_messages("/talker", 5);
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}

/// Between opening its port and examining the living master, rosrescue knows only the checkpoint. Anything
/// that it acknowledges then must also be true in the master that it adopts.
#[test]
fn unregistrations_while_rosrescue_starts_reach_the_adopted_master() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let [leaving, staying] = ["/leaving", "/staying"].map(FakeNode::start);
    for node in [&leaving, &staying] {
        node.publish(&client, "/topic", "std_msgs/String");
    }
    let after = robot.settled_state().without_node("/leaving");
    let master = robot.master_pid();
    robot.rescue.kill();
    crate::support::stop(master);
    robot.rescue.start_again();
    eventually("rosrescue listens", || client.connect().is_ok());
    // The master is still stopped.
    leaving.unpublish(&client, "/topic");
    signal(master, Signal::CONT);
    robot.rescue.wait_serving();
    robot.await_gate();
    robot.await_state(&after, "in the adopted master");
    after.assert_same(&State::read(&robot.client()), "through rosrescue");
}

/// rosrescue has answered the registration of a node without the master, and dies. The node starts again at another port,
/// and only the master hears of that. It must not get the older registration, or it would shut the living node down.
#[test]
fn an_ended_node_does_not_displace_the_one_that_has_taken_its_name() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let master = robot.master_pid();
    robot.rescue.kill();
    crate::support::stop(master);
    robot.rescue.start_again();
    eventually("rosrescue listens", || client.connect().is_ok());
    let ended = FakeNode::start("/node");
    ended.publish(&client, "/topic", "std_msgs/String");
    robot.rescue.kill();
    drop(ended);
    signal(master, Signal::CONT);
    let living = FakeNode::start("/node");
    living.publish(&robot.bare(), "/other", "std_msgs/String");
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    assert_eq!(robot.state().publishers_of("/other"), ["/node"]);
    assert_eq!(robot.state().publishers_of("/topic"), [""; 0]);
    assert!(living.received("shutdown").is_empty());
}

#[test]
fn nodes_hear_what_a_dead_rosrescue_owed_them_although_there_is_no_master() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let listener = FakeNode::start("/listener");
    listener.subscribe(&client, "/topic", "std_msgs/String");
    client.set_param("/key", 1);
    listener.watch_param(&client, "/key");
    robot.take_master_away();
    let port = listener.port();
    // The port refuses the notifications.
    drop(listener);
    let talker = FakeNode::start("/talker");
    talker.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/key", 2);
    robot.rescue.kill();
    let listener = FakeNode::start_at("/listener", port);
    robot.rescue.start_again();
    eventually("the listener knows the talker and the value", || {
        let updates = listener.updates("/topic");
        let values = listener.received("paramUpdate");
        let value = values.last().map(|params| &params[2]);
        updates.last() == Some(&vec![talker.api.clone()]) && value == Some(&2.into())
    });
    assert!(!robot.is_open(), "there is a master");
    assert!(listener.received("shutdown").is_empty());
    robot.revive_master();
    robot.await_gate();
    assert_eq!(robot.state().publishers_of("/topic"), ["/talker"]);
}

#[test]
fn parameters_of_a_stopped_session_are_not_restored_the_next_day() {
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/use_sim_time", true);
    let run_id = robot.client().param("/run_id").expect("a run id");
    assert_eq!(robot.rescue.terminate().code(), Some(0));
    let yesterday = fs::read_to_string(robot.rescue.checkpoint()).expect("a closing snapshot");
    assert!(yesterday.contains("use_sim_time"), "{yesterday}");

    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    assert_eq!(robot.client().param("/use_sim_time"), None);
    assert_ne!(robot.client().param("/run_id"), Some(run_id));
    let kept = fs::read_dir(robot.rescue.checkpoint().parent().unwrap())
        .unwrap()
        .flatten()
        .filter(|entry| entry.path() != robot.rescue.checkpoint() && entry.path().is_file())
        .filter_map(|entry| fs::read_to_string(entry.path()).ok())
        .any(|text| text.contains("use_sim_time"));
    assert!(kept, "the old checkpoint was not kept under another name");
}

#[test]
fn a_stopped_session_is_restored_if_asked_to() {
    let scratch = Scratch::new();
    let (port, master_port) = (free_port(), free_port());
    let start = |restore: &str| {
        let master_port = master_port.to_string();
        let port_text = port.to_string();
        let arguments = [
            "core",
            "-p",
            &port_text,
            "--master-port",
            &master_port,
            "--restore",
            restore,
        ];
        Setup::bare(&scratch, arguments).at_port(port).start()
    };
    let mut rescue = start("auto");
    rescue.client().set_param("/kept", "yes");
    assert_eq!(rescue.terminate().code(), Some(0));
    let mut rescue = start("always");
    assert_eq!(rescue.client().param("/kept"), Some("yes".into()));
    rescue.kill();
    let mut rescue = start("never");
    // With `--restore never` even the living master of the killed rosrescue is not injected, but the state
    // that it holds is adopted.
    assert_eq!(rescue.client().param("/kept"), Some("yes".into()));
    assert_eq!(rescue.terminate().code(), Some(0));
    let rescue = start("never");
    assert_eq!(rescue.client().param("/kept"), None);
}

#[test]
fn a_system_that_ran_without_rosrescue_is_taken_over() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let bare = master.client();
    bare.set_param("/gain", 3);
    let talker = Node::start(&scratch, Library::Rospy, master.port, "talker", &[]);
    let listener = Node::start(&scratch, Library::Roscpp, master.port, "listener", &[]);
    let _server = Node::start(&scratch, Library::Roscpp, master.port, "server", &[]);
    listener.wait_messages("/talker", 5);
    let mut before = State::read(&bare);
    eventually("the state stops changing", || {
        thread::sleep(Duration::from_millis(300));
        let last = std::mem::replace(&mut before, State::read(&bare));
        last == before
    });

    let rescue = Setup::proxy(&scratch, master.port).start();
    before.assert_same(
        &State::read(&rescue.client()),
        "after rosrescue took over the system",
    );
    let dead = master.pid();
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let client = rescue.client();
    eventually("rosrescue reports the new master", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    eventually("the state is back", || {
        State::try_read(&master.client()).is_ok_and(|now| now == before)
    });
    listener.wait_messages("/talker", 5);
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}

/// A parameter that rosmaster cannot return makes all parameters unreadable. They are unknown until it is deleted, and
/// rosrescue reports this.
#[test]
fn a_system_with_an_unreturnable_parameter_is_taken_over_without_parameters() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let bare = master.client();
    bare.set_param("/gain", 3);
    bare.set_param("/arm/huge", Value::BigInt("9999999999".to_owned()));
    let node = FakeNode::start("/node");
    node.publish(&bare, "/topic", "std_msgs/String");

    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    eventually("the master is served", || status(&client)["open"] == true);
    rescue.wait_line("the log says that parameters cannot be read", |line| {
        line.contains("a parameter that it can never return")
    });
    client.set_param("/speed", 1.5);
    let dead = master.pid();
    master.kill();
    let _master = Rosmaster::start_at(&scratch, master.port);
    eventually("rosrescue reports the new master", || {
        client.master_pid().is_some_and(|pid| pid != dead)
    });
    eventually("the known state is restored", || {
        State::read(&client).publishers_of("/topic") == ["/node"]
            && client.param("/speed") == Some(1.5.into())
    });
    assert_eq!(client.param("/gain"), None);
}

/// `rosrescue core` whose rosmaster uses any free port. It soon gives up a silent program at that port.
fn core(scratch: &Scratch) -> Rescue {
    let port = free_port();
    let arguments = ["core", "--no-rosout", "-p", &port.to_string()];
    let setup = Setup::bare(scratch, arguments).args(["--probe-timeout", "500"]);
    setup.at_port(port).start()
}

/// Process id and port of the rosmaster behind rosrescue.
fn master_of(rescue: &Rescue) -> (u32, u16) {
    let client = rescue.client();
    let pid = eventually_some("the master reports its process id", || client.master_pid());
    let words = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap();
    let mut words = words.split('\0');
    assert!(
        words.any(|word| word == "-p"),
        "the command of rosmaster has no port"
    );
    (pid, words.next().unwrap().parse().unwrap())
}

/// A core that was killed together with its master after it had set `/kept` to `value`; also the master's
/// port.
fn killed_core(scratch: &Scratch, value: &str) -> (Rescue, u16) {
    let mut rescue = core(scratch);
    rescue.client().set_param("/kept", value);
    let (master, port) = master_of(&rescue);
    rescue.kill();
    signal(master, Signal::KILL);
    eventually("the master is dead", || !alive(master));
    eventually("the master's port is free", || {
        TcpListener::bind(("127.0.0.1", port)).is_ok()
    });
    (rescue, port)
}

/// Starts a server on the port where the master was. `what` selects how it treats each connection.
fn squat(port: u16, what: &'static str) {
    let listener = eventually_some("the port is free", || {
        TcpListener::bind(("127.0.0.1", port)).ok()
    });
    thread::spawn(move || {
        let mut kept = Vec::new();
        for mut stream in listener.incoming().flatten() {
            match what {
                "closes" => {}
                "is silent" => kept.push(stream),
                _ => {
                    let _ = stream.read(&mut [0; 4096]);
                    let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nno\n");
                }
            }
        }
    });
}

#[test]
fn a_core_starts_although_another_program_has_its_masters_port() {
    for what in ["closes", "is silent", "answers nonsense"] {
        let scratch = Scratch::new();
        let (mut rescue, port) = killed_core(&scratch, what);
        squat(port, what);
        rescue.start_again();
        rescue.wait_serving();
        assert_eq!(rescue.client().param("/kept"), Some(what.into()));
        assert_ne!(master_of(&rescue).1, port, "{what}");
    }
}

#[test]
fn another_rosmaster_at_the_old_port_is_left_alone() {
    let scratch = Scratch::new();
    let (mut rescue, port) = killed_core(&scratch, "ours");
    let stranger = Rosmaster::start_at(&scratch, port);
    stranger.client().set_param("/theirs", 1);
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/kept"), Some("ours".into()));
    assert_eq!(rescue.client().param("/theirs"), None);
    assert_eq!(stranger.client().param("/kept"), None);
    assert_eq!(rescue.terminate().code(), Some(0));
    assert!(
        alive(stranger.pid()),
        "another program's rosmaster was ended"
    );
}

#[test]
fn the_old_port_of_the_master_can_become_rosrescues_own_port() {
    let scratch = Scratch::new();
    // A port that the kernel does not give to outgoing connections.
    let port = free_port();
    let mut rescue = Setup::core(&scratch, port).arg("--no-rosout").start();
    rescue.client().set_param("/kept", "yes");
    let (master, _) = master_of(&rescue);
    rescue.kill();
    signal(master, Signal::KILL);
    // The last thread of the master closes the port, after the process already counts as dead.
    eventually("the master's port is free", || {
        !alive(master) && TcpListener::bind(("0.0.0.0", port)).is_ok()
    });
    let arguments = ["core", "--no-rosout", "-p", &port.to_string()];
    // By default each port has its own checkpoint.
    let checkpoint = rescue.checkpoint();
    let setup = Setup::bare(&scratch, arguments).at_port(port);
    let rescue = setup.at_checkpoint(checkpoint).start();
    assert_eq!(rescue.client().param("/kept"), Some("yes".into()));
}

#[test]
fn a_hung_master_that_was_left_behind_is_replaced() {
    let scratch = Scratch::new();
    let port = free_port();
    let arguments = ["core", "--no-rosout", "-p", &port.to_string()];
    let probing = ["--probe-timeout", "300"];
    let setup = Setup::bare(&scratch, arguments).args(probing);
    let mut rescue = setup.at_port(port).start();
    rescue.client().set_param("/kept", 1);
    let (master, _) = master_of(&rescue);
    rescue.kill();
    crate::support::stop(master);
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/kept"), Some(1.into()));
    assert_ne!(master_of(&rescue).0, master);
    eventually("the hung master is gone", || !alive(master));
}

/// rosrescue is killed right after it has started its rosmaster, before any call was made to it.
#[test]
fn an_empty_master_that_was_left_behind_is_used_or_ended() {
    for millis in [0, 120, 240] {
        let scratch = Scratch::new();
        let port = free_port();
        let arguments = ["core", "--no-rosout", "-p", &port.to_string()];
        let mut rescue = Setup::bare(&scratch, arguments).at_port(port).spawn();
        rescue.wait_line("the log says that rosmaster was started", |line| {
            line.contains("started rosmaster")
        });
        thread::sleep(Duration::from_millis(millis));
        rescue.kill();
        rescue.start_again();
        rescue.wait_serving();
        let (master, at) = master_of(&rescue);
        assert_eq!(Client::new(at).master_pid(), Some(master));
        let masters = || {
            let all = scratch.survivors().into_iter();
            all.filter(|(pid, words)| words.contains("rosmaster") && alive(*pid))
                .count()
        };
        eventually("exactly one rosmaster runs", || masters() == 1);
        assert_eq!(rescue.terminate().code(), Some(0));
        // The killed rosrescue may have been asking for the version of ROS.
        eventually("every process has ended", || scratch.survivors().is_empty());
    }
}

/// How often `rescue` has reported that it started a rosmaster.
fn started(rescue: &Rescue) -> usize {
    let lines = rescue.stderr().into_iter();
    let lines = lines.filter(|line| line.contains("started rosmaster"));
    lines.count()
}

/// Kills the master of `rescue`. When the next master was started and `after` has passed, kills `rescue` as
/// well. Returns the process id of the killed master.
#[track_caller]
fn kill_master_and_rescue(rescue: &mut Rescue, after: Duration) -> u32 {
    let (dead, before) = (master_of(rescue).0, started(rescue));
    signal(dead, Signal::KILL);
    eventually("the next master is started", || started(rescue) > before);
    thread::sleep(after);
    rescue.kill();
    dead
}

/// The running rosmaster, if there is exactly one.
fn only_master(scratch: &Scratch) -> Option<u32> {
    let all = scratch.survivors().into_iter();
    let mut all = all.filter(|(pid, words)| {
        words.contains("rosmaster") && words.contains(" --core ") && alive(*pid)
    });
    let (pid, _) = all.next()?;
    all.next().is_none().then_some(pid)
}

/// A core whose masters do not listen while the file `away` is there.
fn core_that_waits(scratch: &Scratch) -> Rescue {
    let port = free_port();
    let waiting = Path::new(NODES).join("waiting_rosmaster.py");
    let setup = Setup::bare(scratch, ["core", "--no-rosout", "-p", &port.to_string()]);
    let setup = setup.arg("--rosmaster").arg(waiting);
    setup.at_port(port).start()
}

/// rosrescue is killed when the master that it has just started does not listen yet.
#[test]
fn a_starting_master_that_was_left_behind_is_adopted_and_calls_are_answered_meanwhile() {
    let scratch = Scratch::new();
    let mut rescue = core_that_waits(&scratch);
    let client = rescue.client();
    client.set_param("/kept", 1);
    fs::write(scratch.path("away"), "").unwrap();
    kill_master_and_rescue(&mut rescue, Duration::ZERO);
    let starting = eventually_some("exactly one rosmaster runs", || only_master(&scratch));

    rescue.start_again();
    eventually("rosrescue listens", || client.connect().is_ok());
    assert_eq!(client.param("/kept"), Some(1.into()));
    client.set_param("/kept", 2);
    assert_eq!(status(&client)["open"], false, "there is no master yet");
    fs::remove_file(scratch.path("away")).unwrap();
    rescue.wait_serving();
    assert_eq!(
        client.master_pid(),
        Some(starting),
        "the starting master must be adopted"
    );
    assert_eq!(only_master(&scratch), Some(starting));
    assert_eq!(started(&rescue), 0);
    let (_, at) = master_of(&rescue);
    assert_eq!(Client::new(at).param("/kept"), Some(2.into()));

    // rosrescue notices the death of an adopted master like that of a child.
    signal(starting, Signal::KILL);
    eventually("another master serves", || {
        client.master_pid().is_some_and(|pid| pid != starting)
    });
    assert_eq!(client.param("/kept"), Some(2.into()));
}

/// The master and rosrescue die within 200 ms of each other, at moments that differ between runs. The next master is
/// used, however far it has got.
#[test]
fn no_second_master_is_started_when_master_and_rosrescue_die_together() {
    let scratch = Scratch::new();
    let mut rescue = core(&scratch);
    let first = u64::from(std::process::id() % 25);
    for millis in (first..200).step_by(25) {
        let dead = kill_master_and_rescue(&mut rescue, Duration::from_millis(millis));
        let next = eventually_some("the next master runs alone", || {
            only_master(&scratch).filter(|pid| *pid != dead)
        });
        rescue.start_again();
        rescue.wait_serving();
        assert_eq!(master_of(&rescue).0, next, "killed after {millis} ms");
        assert_eq!(started(&rescue), 0, "killed after {millis} ms");
    }
}

/// Another program has taken the port, so the master can never listen there.
#[test]
fn a_starting_master_that_has_lost_its_port_is_ended() {
    let scratch = Scratch::new();
    let mut rescue = core_that_waits(&scratch);
    rescue.client().set_param("/kept", 1);
    let (_, master_port) = master_of(&rescue);
    fs::write(scratch.path("away"), "").unwrap();
    kill_master_and_rescue(&mut rescue, Duration::ZERO);
    let starting = eventually_some("exactly one rosmaster runs", || only_master(&scratch));
    squat(master_port, "closes");
    fs::remove_file(scratch.path("away")).unwrap();
    rescue.start_again();
    rescue.wait_serving();
    assert_eq!(rescue.client().param("/kept"), Some(1.into()));
    eventually("the master is ended", || !alive(starting));
}
