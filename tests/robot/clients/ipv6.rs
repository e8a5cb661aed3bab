//! A robot whose nodes speak IPv6 (`ROS_IPV6=on`): rospy and roscpp nodes that are registered by a host name. roscpp
//! cannot parse an address such as `http://[::1]:40000/`, with any master.

use std::{net::TcpStream, process::Command};

use rustix::process::Signal;

use crate::support::{
    Client, LIBRARIES, Library, Node, Rescue, Rosmaster, Scratch, Setup, State, alive, eventually,
    free_port, port_of, signal, status,
};

/// The command on a computer with Debian's `/etc/hosts`, where `localhost` is `::1` too. roscpp and rosmaster then speak
/// IPv6.
fn with_ipv6(own: &Command, scratch: &Scratch) -> Command {
    let hosts = scratch.path("hosts");
    std::fs::write(&hosts, "127.0.0.1 localhost\n::1 localhost\n").unwrap();
    let mut command = Command::new("unshare");
    command
        .args(["--mount", "sh", "-ec"])
        .arg("mount --bind \"$0\" /etc/hosts; exec \"$@\"")
        .arg(hosts)
        .arg(own.get_program())
        .args(own.get_args());
    for (name, value) in own.get_envs() {
        match value {
            Some(value) => command.env(name, value),
            None => command.env_remove(name),
        };
    }
    if let Some(folder) = own.get_current_dir() {
        command.current_dir(folder);
    }
    command
        .env("ROS_IPV6", "on")
        .env("ROS_HOSTNAME", "localhost")
        .env_remove("ROS_IP");
    command
}

/// Starts a node of this library that speaks IPv6.
#[track_caller]
fn node(scratch: &Scratch, library: Library, port: u16, node: &str, name: &str) -> Node {
    let mut command = library.command(scratch, port, node);
    command
        .env("ROS_MASTER_URI", format!("http://localhost:{port}"))
        .arg(format!("__name:={name}"));
    Node::run(&mut with_ipv6(&command, scratch))
}

/// Nodes of both libraries find each other with a master and after its death, and with the next master, if `revive` starts
/// it. A core speaks IPv4 with its own masters, so this last part is left out for a core.
fn nodes_find_each_other<T>(
    scratch: &Scratch,
    rescue: &Rescue,
    revive: Option<impl FnOnce() -> T>,
) {
    let port = rescue.port();
    let client = Client::at("[::1]", port);
    let talkers = LIBRARIES.map(|(library, suffix)| {
        let name = format!("talker_{suffix}");
        (
            node(scratch, library, port, "talker", &name),
            format!("/{name}"),
        )
    });
    let listen = |when: &str| {
        LIBRARIES.map(|(library, suffix)| {
            let name = format!("{when}_{suffix}");
            let listener = node(scratch, library, port, "listener", &name);
            for (_, talker) in &talkers {
                listener.wait_messages(talker, 5);
            }
            listener
        })
    };
    let mut listeners = Vec::from(listen("early"));
    for (_, talker) in &talkers {
        let port = port_of(&client, talker);
        assert!(TcpStream::connect(("::1", port)).is_ok(), "{talker}");
    }
    let dead = client.master_pid().unwrap();
    signal(dead, Signal::KILL);
    eventually("the master is dead", || !alive(dead));
    listeners.extend(listen("late"));
    let before = State::read(&client);
    let next = revive.map(|revive| revive());
    eventually("the next master has the state", || {
        let status = status(&client);
        status["open"] == true && status["master_pid"] != dead
    });
    before.assert_same(&State::read(&client), "with the next master");
    if next.is_some() {
        listeners.extend(listen("last"));
    }
    for listener in &listeners {
        for (_, talker) in &talkers {
            listener.assert_no_message_lost(talker);
        }
        listener.assert_no_link_lost();
    }
}

#[test]
fn core_serves_nodes_that_speak_ipv6() {
    let scratch = Scratch::new();
    let setup = Setup::core(&scratch, free_port()).arg("--no-rosout");
    let rescue = setup.wrapped(|own| with_ipv6(own, &scratch)).start();
    nodes_find_each_other(&scratch, &rescue, None::<fn()>);
}

#[test]
fn proxy_serves_nodes_and_a_master_that_speak_ipv6() {
    let scratch = Scratch::new();
    let port = free_port();
    let start = || Rosmaster::start_with(&scratch, port, |own| *own = with_ipv6(own, &scratch));
    let mut master = start();
    let (uri, listen) = (format!("http://localhost:{port}"), free_port());
    let rescue = Setup::bare(&scratch, ["proxy", "--master", &uri])
        .args(["--listen", &listen.to_string()])
        .at_port(listen)
        .wrapped(|own| with_ipv6(own, &scratch))
        .start();
    let revive = || {
        master.kill();
        start()
    };
    nodes_find_each_other(&scratch, &rescue, Some(revive));
}
