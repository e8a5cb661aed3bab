//! The whole life of rospy and roscpp nodes while there is no master. The master stays away for at least
//! `ROSRESCUE_AWAY_SECONDS`.

use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::support::{
    FakeNode, LIBRARIES, Library, Mode, Node, Robot, State, Streams, eventually, holds,
    in_both_modes,
};

/// Rate of every talker, in Hz.
const HZ: &str = "20";
/// Listeners print every tenth message, and every gap.
const EVERY: &str = "10";
/// Number of values that the cached parameter takes.
const VALUES: i32 = 5;

fn assert_no_failure(nodes: &[Node]) {
    for node in nodes {
        assert_eq!(node.said("failed"), Vec::<String>::new(), "{}", node.log());
    }
}

in_both_modes!(nodes_start_work_and_end_normally_without_a_master);

fn nodes_start_work_and_end_normally_without_a_master(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let before = Streams::start(&robot, "before", HZ, EVERY);
    // This node records every call of a master or of rosrescue.
    let witness = FakeNode::start("/witness");
    witness.subscribe(&robot.client(), "/before", "std_msgs/String");
    robot.client().set_param("/speed", 0);
    let dead = robot.master_pid();
    robot.settled_state();
    robot.take_master_away();
    let away = Instant::now();

    // Nodes start, find each other and exchange messages.
    let during = Streams::start(&robot, "during", HZ, EVERY);
    // Services: the server of each client is of the other library.
    let [py, cpp] = [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];
    let pairs = [(py, cpp), (cpp, py)];
    let servers = Node::all_ready(pairs.map(|((library, suffix), _)| {
        let service = format!("who:=/who_{suffix}");
        let name = format!("__name:=server_{suffix}");
        robot.spawn_node(library, "server", &[&service, &name])
    }));
    let clients = Node::all_ready(pairs.map(|((_, server), (library, suffix))| {
        let service = format!("who:=/who_{server}");
        let name = format!("__name:=client_{suffix}");
        robot.spawn_node(library, "client", &["5", &service, &name])
    }));
    for (client, ((_, server), _)) in clients.iter().zip(pairs) {
        let server = format!("/server_{server}");
        eventually("services answer", || {
            let replies = client.said("reply");
            replies.len() >= 5 && replies.iter().all(|name| *name == server)
        });
    }
    // A parameter changes that nodes have cached.
    let users = Node::all_ready(LIBRARIES.map(|(library, suffix)| {
        let name = format!("__name:=user_{suffix}");
        robot.spawn_node(library, "param_user", &["/speed", &name])
    }));
    for value in 1..=VALUES {
        robot.client().set_param("/speed", value);
        for user in &users {
            eventually("the cached parameter has the new value", || {
                user.said("value").last() == Some(&value.to_string())
            });
        }
    }
    // Nodes of the same name displace each other, within a library and across.
    displace(&robot);
    let seconds = std::env::var("ROSRESCUE_AWAY_SECONDS").map_or(0, |text| text.parse().unwrap());
    let rest = Duration::from_secs(seconds).saturating_sub(away.elapsed());
    assert!(holds(rest, || !robot.is_open()));

    assert_no_failure(&servers);
    assert_no_failure(&clients);
    assert_no_failure(&users);
    let heard: Vec<_> = (0..=VALUES).map(|value| value.to_string()).collect();
    for user in &users {
        assert_eq!(user.said("value"), heard);
    }
    // Nodes that are asked to end do so, and unregister. The other client and its server see the next master.
    let [user_py, user_cpp] = users;
    let ([client_cpp, client_py], [server_py, server_cpp]) = (clients, servers);
    for mut node in [user_py, user_cpp, client_cpp, server_py] {
        end(&robot, &mut node);
    }
    let stay = [server_cpp, client_py];
    before.assert_whole(&robot);
    during.assert_whole(&robot);
    let mirror = State::read(&robot.client());

    // An empty master appears.
    robot.revive_master();
    robot.await_recovery(dead);
    mirror.assert_same(&robot.state(), "in the new master");
    before.assert_whole(&robot);
    during.assert_whole(&robot);
    // A health check, or wrong notifications by a new master, would happen within seconds.
    assert!(holds(Duration::from_secs(5), || witness
        .received("shutdown")
        .is_empty()));
    mirror.assert_same(&robot.state(), "some seconds later");
    before.assert_whole(&robot);
    during.assert_whole(&robot);
    assert_no_failure(&stay);
    for mut node in stay {
        assert_eq!(node.exited(), None, "{}", node.log());
    }
    for topic in ["/before", "/during"] {
        assert_eq!(mirror.publishers_of(topic).len(), 2, "{mirror}");
    }
}

/// Checks that the second of two nodes of the same name stays, and the first one ends.
fn displace(robot: &Robot) {
    let [py, cpp] = LIBRARIES;
    let pairs = [(py, py), (cpp, cpp), (py, cpp)];
    let names = pairs.map(|((_, first), (_, second))| format!("twin_{first}_{second}"));
    let start = |libraries: [Library; 3]| {
        let mut nodes = libraries.into_iter().zip(&names).map(|(library, name)| {
            let name = format!("__name:={name}");
            let arguments = [HZ, "quiet", "logged", &name, "chatter:=/twins"];
            robot.spawn_node(library, "talker", &arguments)
        });
        Node::all_ready([(); 3].map(|()| nodes.next().unwrap()))
    };
    let displaced = start(pairs.map(|((library, _), _)| library));
    let mut stay = start(pairs.map(|(_, (library, _))| library));
    for mut node in displaced {
        node.wait();
    }
    assert!(holds(Duration::from_millis(500), || {
        stay.iter_mut().all(|node| node.exited().is_none())
    }));
    let state = State::read(&robot.client());
    let publishers = state.publishers_of("/twins");
    assert!(
        names
            .iter()
            .all(|name| publishers.contains(&format!("/{name}"))),
        "{state}"
    );
    for node in &stay {
        node.signal(Signal::INT);
    }
    for node in &mut stay {
        node.wait();
    }
    let state = State::read(&robot.client());
    assert_eq!(state.publishers_of("/twins"), Vec::<String>::new());
}

/// Checks that a node which is asked to end does so, and is unregistered.
fn end(robot: &Robot, node: &mut Node) {
    let name = node.said("ready").remove(0);
    assert!(State::read(&robot.client()).knows(&name), "{name}");
    node.signal(Signal::INT);
    node.wait();
    let state = State::read(&robot.client());
    assert!(!state.knows(&name), "{state}");
}
