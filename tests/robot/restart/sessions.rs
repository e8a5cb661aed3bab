//! Whether a start continues the previous session: after a clean stop, a crash, a reboot.
//!
//! A reboot is simulated by a private mount that shows another boot id, and another computer by a network
//! namespace. Everything else is real. `worker.rs` also tests the consequences of a crash and of a clean
//! stop.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::thread;

use crate::support::{
    Client, FakeNode, Library, Mode, Netns, Node, Robot, Rosmaster, Scratch, Setup, State, alive,
    eventually, free_port, in_both_modes, params, signal,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// A file with the id of another boot, as the kernel shows it.
pub(super) fn another_boot(scratch: &Scratch) -> PathBuf {
    let file = scratch.path("boot_id");
    fs::write(&file, "01234567-89ab-4cde-8f01-23456789abcd\n").unwrap();
    file
}

/// Sends SIGKILL to rosrescue and to its master, like a power cut.
fn cut_power(robot: &mut Robot) {
    let master = robot.master_pid();
    robot.rescue.kill();
    robot.kill_master_at_once(master);
    eventually("the master is dead", || !alive(master));
}

/// The files next to the checkpoint that contain `text`.
fn kept(robot: &Robot, text: &str) -> Vec<String> {
    let checkpoint = robot.rescue.checkpoint();
    let is_old = |path: &Path| path != checkpoint && path.to_string_lossy().contains("chkpt");
    let folder = fs::read_dir(checkpoint.parent().unwrap()).unwrap();
    let others = folder.flatten().filter(|entry| is_old(&entry.path()));
    let holding = others.filter(|entry| {
        fs::read_to_string(entry.path()).is_ok_and(|content| content.contains(text))
    });
    let names = holding.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.collect()
}

in_both_modes!(after_a_reboot_without_living_nodes_a_new_session_begins);

fn after_a_reboot_without_living_nodes_a_new_session_begins(mode: Mode) {
    let mut robot = Robot::start(mode);
    robot.client().set_param("/use_sim_time", true);
    let _talker = robot.node(Library::Roscpp, "talker", &[]);
    robot.settled_state();
    cut_power(&mut robot);
    // The nodes die too, including rosout.
    for pid in robot.processes() {
        signal(pid, Signal::KILL);
    }
    eventually("every process has ended", || {
        !robot.processes().into_iter().any(alive)
    });
    let boot = another_boot(&robot.scratch);
    robot.revive_master();
    robot.rescue.start_after_reboot(&boot);
    robot.rescue.wait_serving();
    robot.await_gate();
    let client = robot.client();
    assert_eq!(client.param("/use_sim_time"), None, "{mode:?}");
    assert!(!robot.settled_state().knows("/talker"), "{mode:?}");
    let names = kept(&robot, "use_sim_time");
    // The previous generation is kept too, if it had the parameter. The log has all records.
    let (old, others): (Vec<_>, Vec<_>) = names.iter().partition(|name| name.contains(".session-"));
    assert!(
        !old.is_empty() && others.iter().all(|name| name.contains(".log-")),
        "the old file is not kept: {names:?}"
    );
    // The new session is protected: a crash now restores it.
    client.set_param("/today", 1);
    robot.crash_master();
    assert_eq!(robot.client().param("/today"), Some(1.into()));
    assert_eq!(robot.client().param("/use_sim_time"), None);
}

/// A node at `host` of another computer.
fn node_elsewhere(
    net: &Netns,
    (scratch, port): (&Scratch, u16),
    host: u8,
    (library, node, name): (Library, &str, &str),
) -> Node {
    let mut command = library.command(scratch, port, node);
    command
        .arg(format!("__name:={name}"))
        .env("ROS_IP", net.far(host))
        .env("ROS_MASTER_URI", format!("http://{}:{port}", net.near()));
    Node::run(&mut net.inside(&command))
}

in_both_modes!(after_a_reboot_with_nodes_alive_elsewhere_the_session_continues);

fn after_a_reboot_with_nodes_alive_elsewhere_the_session_continues(mode: Mode) {
    let net = Netns::new();
    let scratch = Scratch::new();
    let (port, master_port) = (free_port(), free_port());
    let mut master = (mode == Mode::Proxy).then(|| Rosmaster::start_at(&scratch, master_port));
    let setup = match mode {
        Mode::Core => Setup::bare(&scratch, ["core", "-p", &port.to_string()]).args([
            "--no-rosout",
            "--master-port",
            &master_port.to_string(),
        ]),
        Mode::Proxy => Setup::bare(&scratch, ["proxy", "--listen", &format!(":{port}")])
            .args(["--master", &format!("http://127.0.0.1:{master_port}")]),
    };
    let mut rescue = setup.env("ROS_IP", net.near()).at_port(port).start();
    rescue.client().set_param("/gain", 3);
    let at = (&scratch, port);
    let talker = node_elsewhere(&net, at, 2, (Library::Roscpp, "talker", "talker"));
    let library = match mode {
        Mode::Core => Library::Roscpp,
        Mode::Proxy => Library::Rospy,
    };
    let listener = node_elsewhere(&net, at, 3, (library, "listener", "listener"));
    listener.wait_messages("/talker", 5);
    let bare = Client::new(master_port);
    let before = State::read(&bare);
    assert!(before.knows("/talker") && before.knows("/listener"));
    let dead = bare.master_pid().expect("a master");
    rescue.kill();
    signal(dead, Signal::KILL);
    if let Some(master) = &mut master {
        master.kill();
        *master = Rosmaster::start_at(&scratch, master_port);
    }
    eventually("the master is dead", || !alive(dead));
    rescue.start_after_reboot(&another_boot(&scratch));
    rescue.wait_serving();
    eventually("the state is back", || {
        State::try_read(&bare).is_ok_and(|now| now == before)
    });
    let late = node_elsewhere(&net, at, 4, (Library::Roscpp, "listener", "late"));
    late.wait_messages("/talker", 5);
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}

/// multimaster_fkie's `master_sync` registers nodes of another robot, which may be on all the time.
#[test]
fn after_a_reboot_nodes_of_another_robot_do_not_count() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let port = free_port();
    let setup = Setup::bare(&scratch, ["core", "-p", &port.to_string(), "--no-rosout"]);
    let mut rescue = setup.env("ROS_IP", net.near()).at_port(port).start();
    let client = rescue.client();
    client.set_param("/gain", 3);
    let _talker = node_elsewhere(
        &net,
        (&scratch, port),
        2,
        (Library::Roscpp, "talker", "talker"),
    );
    eventually("the node is registered", || {
        State::try_read(&client).is_ok_and(|state| state.knows("/talker"))
    });
    let api = client.ok("lookupNode", params!["/test", "/talker"]);
    let again = params!["/talker", "/synchronized", "std_msgs/String", api];
    client.ok("registerPublisher", again);
    let dead = client.master_pid().expect("a master");
    rescue.kill();
    signal(dead, Signal::KILL);
    eventually("the master is dead", || !alive(dead));
    rescue.start_after_reboot(&another_boot(&scratch));
    rescue.wait_serving();
    assert_eq!(client.param("/gain"), None);
}

/// Nothing on this computer has survived the reboot, so an answer from the address of a node comes from
/// another program.
#[test]
fn after_a_reboot_another_program_at_a_nodes_port_does_not_count_as_the_node() {
    const FAULT: &str = "<?xml version=\"1.0\"?><methodResponse><fault><value><struct>\
        <member><name>faultCode</name><value><int>1</int></value></member>\
        <member><name>faultString</name><value><string>who?</string></value></member>\
        </struct></value></fault></methodResponse>";
    let net = Netns::new();
    let mut robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    client.set_param("/use_sim_time", true);
    let hosts = ["127.0.0.1", "localhost", &net.near()];
    for (number, host) in hosts.into_iter().enumerate() {
        let stranger = TcpListener::bind("0.0.0.0:0").unwrap();
        let api = format!("http://{host}:{}/", stranger.local_addr().unwrap().port());
        let topic = params![format!("/node{number}"), "/topic", "std_msgs/String", api];
        client.ok("registerPublisher", topic);
        thread::spawn(move || {
            for mut stream in stranger.incoming().flatten() {
                let _ = stream.read(&mut [0; 4096]);
                let length = FAULT.len();
                let head = format!("HTTP/1.0 200 OK\r\nContent-Length: {length}\r\n\r\n");
                let _ = stream.write_all(format!("{head}{FAULT}").as_bytes());
            }
        });
    }
    cut_power(&mut robot);
    let boot = another_boot(&robot.scratch);
    robot.rescue.start_after_reboot(&boot);
    robot.rescue.wait_serving();
    assert_eq!(client.param("/use_sim_time"), None);
    assert_eq!(robot.settled_state().nodes, []);
}

#[test]
fn after_a_clean_stop_living_nodes_keep_their_session() {
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/gain", 3);
    let talker = robot.node(Library::Roscpp, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 5);
    let before = robot.settled_state().without_node("/rosout");
    assert_eq!(robot.rescue.terminate().code(), Some(0));
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    let now = robot.settled_state().without_node("/rosout");
    before.assert_same(&now, "after a clean stop and a start with nodes alive");
    listener.assert_no_message_lost("/talker");
    talker.assert_no_link_lost();
}

#[test]
fn with_restore_never_a_session_continues_while_a_node_lives() {
    let mut robot = Robot::start_with(Mode::Proxy, &["--restore", "never"]);
    let client = robot.client();
    let node = FakeNode::start("/node");
    node.publish(&client, "/topic", "std_msgs/String");
    client.set_param("/kept", 1);
    cut_power(&mut robot);
    robot.revive_proxied_master();
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    assert_eq!(client.param("/kept"), Some(Value::Int(1)));
    assert_eq!(robot.state().publishers_of("/topic"), ["/node"]);
    drop(node);
    cut_power(&mut robot);
    // The nodes die too, including rosout.
    for pid in robot.processes() {
        signal(pid, Signal::KILL);
    }
    eventually("every process has ended", || {
        !robot.processes().into_iter().any(alive)
    });
    robot.revive_proxied_master();
    robot.rescue.start_again();
    robot.rescue.wait_serving();
    robot.await_gate();
    assert_eq!(client.param("/kept"), None);
}
