//! The whole life of rospy and roscpp nodes while there is no master.

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use rosrescue::xmlrpc::Value;
use rustix::process::Signal;

use super::LIBRARIES;
use crate::support::{
    Client, FakeNode, Library, Mode, Node, Robot, State, Tool, eventually, holds, params,
};

/// Every talker's pace.
const HZ: &str = "50";
/// Every twenty-fifth message is said, and every gap.
const EVERY: &str = "25";
/// Values that the cached parameter takes.
const VALUES: i32 = 5;

/// Two talkers of one topic and two listeners, one of each library.
struct Stream {
    talkers: [Node; 2],
    listeners: [Node; 2],
    names: [String; 2],
}

impl Stream {
    /// Starts all four; their names end in `name`, which is the topic's name, too.
    #[track_caller]
    fn start(robot: &Robot, name: &str) -> Self {
        let topic = format!("chatter:=/{name}");
        let start = |node: &str, arguments: &[&str]| {
            LIBRARIES.map(|(library, suffix)| {
                let node_name = format!("__name:={node}_{suffix}_{name}");
                let arguments = [arguments, &[&node_name, &topic]].concat();
                robot.node(library, node, &arguments)
            })
        };
        let stream = Self {
            talkers: start("talker", &[HZ, "quiet"]),
            listeners: start("listener", &[EVERY]),
            names: LIBRARIES.map(|(_, suffix)| format!("/talker_{suffix}_{name}")),
        };
        stream.flow();
        stream
    }

    /// Waits until messages have come from everybody to everybody.
    #[track_caller]
    fn flow(&self) {
        for listener in &self.listeners {
            for talker in &self.names {
                listener.wait_messages(talker, 2);
            }
        }
    }

    /// Panics if a message was lost or a link was made anew, or nothing comes any more.
    #[track_caller]
    fn assert_whole(&self) {
        self.flow();
        for listener in &self.listeners {
            for talker in &self.names {
                listener.assert_no_gap(talker);
            }
        }
        for node in self.listeners.iter().chain(&self.talkers) {
            node.assert_no_link_lost();
            assert_eq!(node.links().last(), Some(&2), "{:?}", node.links());
        }
    }
}

/// What every node says of its links of topics: they have numbers, and ports.
fn links(robot: &Robot, state: &State) -> Vec<(String, Vec<Value>)> {
    let mut links = Vec::new();
    for (name, api) in &state.nodes {
        let port = api.trim_end_matches('/').rsplit(':').next().unwrap();
        let client = Client::new(port.parse().unwrap());
        // rosrescue's own rosout hears of every node.
        if name == "/rosout" || client.port() == robot.port() {
            continue;
        }
        if let Some(Value::Array(of)) = client.ask("getBusInfo", params!["/test"]) {
            links.push((name.clone(), of));
        }
    }
    links
}

fn assert_no_failure(nodes: &[Node]) {
    for node in nodes {
        assert_eq!(node.said("failed"), Vec::<String>::new(), "{}", node.log());
    }
}

#[test]
fn nodes_live_for_a_minute_without_a_master_in_proxy_mode() {
    nodes_live_without_a_master(Mode::Proxy, Duration::from_secs(60));
}

#[test]
fn nodes_live_without_a_master_in_core_mode() {
    nodes_live_without_a_master(Mode::Core, Duration::ZERO);
}

/// `away`: for how long there is no master, at least.
fn nodes_live_without_a_master(mode: Mode, away: Duration) {
    let mut robot = Robot::start_for_outages(mode);
    let before = Stream::start(&robot, "before");
    // It notices every call of a master or of rosrescue.
    let witness = FakeNode::start("/witness");
    witness.subscribe(&robot.client(), "/before", "std_msgs/String");
    robot.client().set_param("/speed", 0);
    let dead = robot.master_pid();
    robot.settled_state();
    robot.take_master_away();
    let start = Instant::now();

    // They start, find each other and exchange messages.
    let during = Stream::start(&robot, "during");
    // Services: each client's server is of the other library.
    let [py, cpp] = [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];
    let pairs = [(py, cpp), (cpp, py)];
    let servers = pairs.map(|((library, suffix), _)| {
        let service = format!("who:=/who_{suffix}");
        let name = format!("__name:=server_{suffix}");
        robot.node(library, "server", &[&service, &name])
    });
    let clients = pairs.map(|((_, server), (library, suffix))| {
        let service = format!("who:=/who_{server}");
        let name = format!("__name:=client_{suffix}");
        robot.node(library, "client", &["20", &service, &name])
    });
    for (client, ((_, server), _)) in clients.iter().zip(pairs) {
        let server = format!("/server_{server}");
        eventually("services answer", || {
            let replies = client.said("reply");
            replies.len() >= 5 && replies.iter().all(|name| *name == server)
        });
    }
    // Parameters, in the nodes' caches too, set by a tool.
    let users = LIBRARIES.map(|(library, suffix)| {
        let name = format!("__name:=user_{suffix}");
        robot.node(library, "param_user", &["/speed", &name])
    });
    for value in 1..=VALUES {
        let value = value.to_string();
        let set = ["set", "/speed", &value];
        let tool = Tool::run(&robot.scratch, robot.port(), "rosparam", &set);
        assert!(tool.status.success(), "{}", tool.stderr);
        for user in &users {
            eventually("the cache follows", || {
                user.said("value").last() == Some(&value)
            });
        }
    }
    // Namesakes displace each other, within a library and across.
    displace(&robot);
    // Others end by themselves, and take their registrations with them.
    end(&robot);
    println!("{mode:?}: all steps took {:?}", start.elapsed());
    sleep(away.saturating_sub(start.elapsed()));

    assert_no_failure(&servers);
    assert_no_failure(&clients);
    assert_no_failure(&users);
    let heard: Vec<_> = (0..=VALUES).map(|value| value.to_string()).collect();
    for user in &users {
        assert_eq!(user.said("value"), heard);
    }
    before.assert_whole();
    during.assert_whole();
    let mirror = State::read(&robot.client());
    let linked = links(&robot, &mirror);
    assert!(linked.len() > 10, "{linked:?}");

    // An empty master comes.
    robot.revive_master();
    robot.await_recovery(dead);
    mirror.assert_same(&robot.state(), "in the new master");
    before.assert_whole();
    during.assert_whole();
    // A health check and everything that a new master may say too much come within seconds.
    assert!(holds(Duration::from_secs(5), || witness
        .heard("shutdown")
        .is_empty()));
    mirror.assert_same(&robot.state(), "some seconds later");
    assert_eq!(linked, links(&robot, &mirror), "links");
    before.assert_whole();
    during.assert_whole();
    assert_no_failure(&servers);
    assert_no_failure(&clients);
    assert_no_failure(&users);
    for mut node in servers.into_iter().chain(clients).chain(users) {
        assert_eq!(node.exited(), None, "{}", node.log());
    }
    for topic in ["/before", "/during"] {
        assert_eq!(mirror.publishers_of(topic).len(), 2, "{mirror}");
    }
}

/// The second of two namesakes stays, the first one ends.
fn displace(robot: &Robot) {
    for ((first, _), (second, name)) in [
        (LIBRARIES[0], LIBRARIES[0]),
        (LIBRARIES[1], LIBRARIES[1]),
        (LIBRARIES[0], LIBRARIES[1]),
    ] {
        let name = format!("twin_{first:?}_{name}").to_lowercase();
        let remaps = [&*format!("__name:={name}"), "chatter:=/twins"];
        let arguments = [HZ, "quiet", "logged", remaps[0], remaps[1]];
        let mut displaced = robot.node(first, "talker", &arguments);
        let mut stays = robot.node(second, "talker", &arguments);
        displaced.wait();
        assert!(
            holds(Duration::from_millis(500), || stays.exited().is_none()),
            "{}",
            stays.log()
        );
        let state = State::read(&robot.client());
        assert!(state.publishers_of("/twins").contains(&format!("/{name}")));
        stays.signal(Signal::INT);
        stays.wait();
    }
    let state = State::read(&robot.client());
    assert_eq!(state.publishers_of("/twins"), Vec::<String>::new());
}

/// Nodes that are asked to end do so, and are no longer known.
fn end(robot: &Robot) {
    // A rospy node that is told to end while it is in a call to the master waits for its own lock for ever, and it
    // calls all the time for a parameter that is not set.
    robot.client().set_param("/leaving", 1);
    for (library, suffix) in LIBRARIES {
        for node in ["listener", "server", "param_user"] {
            let name = format!("leaving_{node}_{suffix}");
            let remap = format!("__name:={name}");
            // None of them is to have a name in common with one that stays.
            let arguments = ["/leaving", &remap, "chatter:=/leaving", "who:=/leaving"];
            let arguments = match node {
                "param_user" => &arguments[..],
                _ => &arguments[1..],
            };
            let mut leaving = robot.node(library, node, arguments);
            leaving.signal(Signal::INT);
            leaving.wait();
            let state = State::read(&robot.client());
            assert!(!state.knows(&format!("/{name}")), "{state}");
        }
    }
}
