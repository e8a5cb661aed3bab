//! The whole life of rospy and roscpp nodes while there is no master. The master stays away for at least
//! `ROSRESCUE_AWAY_SECONDS`.

use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::support::{
    FakeNode, LIBRARIES, Library, Mode, Node, Robot, State, Streams, Tool, eventually, holds,
    in_both_modes,
};

/// Rate of every talker, in Hz.
const HZ: &str = "50";
/// Listeners print every twenty-fifth message, and every gap.
const EVERY: &str = "25";
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
    // A tool sets a parameter, which nodes have cached.
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
            eventually("the cached parameter has the new value", || {
                user.said("value").last() == Some(&value)
            });
        }
    }
    // Nodes of the same name displace each other, within a library and across.
    displace(&robot);
    // Other nodes end by themselves and unregister.
    end(&robot);
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

/// Checks that the second of two nodes of the same name stays, and the first one ends.
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

/// Checks that nodes which are asked to end do so, and are unregistered.
fn end(robot: &Robot) {
    // A rospy node that is told to end during a call to the master waits forever for its own lock, and it
    // makes such calls all the time for a parameter that is not set.
    robot.client().set_param("/leaving", 1);
    for (library, suffix) in LIBRARIES {
        for node in ["listener", "server", "param_user"] {
            let name = format!("leaving_{node}_{suffix}");
            let remap = format!("__name:={name}");
            // The nodes that end must have no topic or service in common with a node that stays.
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
