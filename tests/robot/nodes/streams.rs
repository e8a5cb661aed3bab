//! Live streams between rospy and roscpp nodes, with several publishers on a topic at 100 Hz, while the
//! master is killed again and again, and rosrescue too. No message is lost and no connection is replaced.
//! Service clients that look the service up for every call see no failure while masters die, and cached
//! parameters stay up to date.
//!
//! `ROSRESCUE_KILLS` sets how often the master dies in each test (5 by default).

use ros1_master::xmlrpc::Value;

use crate::support::{LIBRARIES, Library, Mode, Node, Robot, State, Streams, alive, eventually};

/// Number of deaths of the master for each death of rosrescue.
const KILLS_EACH: usize = 5;
/// Rate of every talker, in Hz.
const HZ: &str = "100";
/// Listeners print every twenty-fifth message, and every gap.
const EVERY: &str = "25";

/// Waits until rosrescue has examined more than `recoveries` masters and calls pass.
fn await_open(robot: &Robot, recoveries: u64) {
    eventually("the gate is open again", || {
        robot.status().is_some_and(|status| {
            status["open"] == true && status["recoveries"].as_u64() > Some(recoveries)
        })
    });
}

/// Kills the master and waits until its successor has the whole state.
fn kill_master(robot: &mut Robot, before: &State, when: &str) {
    let recoveries = robot.status().unwrap()["recoveries"].as_u64().unwrap();
    robot.kill_master();
    robot.revive_master();
    await_open(robot, recoveries);
    before.assert_same(&registrations(robot), when);
}

/// The state without parameters, because the tests change them.
fn registrations(robot: &Robot) -> State {
    let mut state = robot.state();
    state.params = Value::Array(Vec::new());
    state.param_names = Vec::new();
    state
}

/// Sets a parameter and waits until the nodes that cache it know the new value.
fn set_speed(robot: &Robot, users: &[Node], speed: usize) {
    let speed = i32::try_from(speed).unwrap();
    robot.client().set_param("/speed", speed);
    for user in users {
        eventually("the cached parameter has the new value", || {
            user.said("value").last() == Some(&speed.to_string())
        });
    }
}

fn failures(clients: &[Node]) -> Vec<String> {
    clients
        .iter()
        .flat_map(|node| node.said("failed"))
        .collect()
}

/// Waits until each client has received some more answers.
fn answered(clients: &[Node]) {
    for client in clients {
        let before = client.said("reply").len();
        eventually("answers come", || client.said("reply").len() >= before + 3);
    }
}

/// Waits until each reader has read some more values.
fn read_on(readers: &[Node]) {
    for reader in readers {
        let before = reader.said("reads").len();
        eventually("values are read", || reader.said("reads").len() > before);
    }
}

/// Number of deaths of the master, a multiple of [`KILLS_EACH`].
fn kills() -> usize {
    let kills = std::env::var("ROSRESCUE_KILLS");
    kills.map_or(KILLS_EACH, |text| text.parse().unwrap())
}

#[test]
fn no_message_is_lost_when_a_master_behind_proxy_is_killed_again_and_again() {
    let kills = kills();
    let mut robot = Robot::start(Mode::Proxy);
    robot.client().set_param("/speed", 0);
    let streams = Streams::start(&robot, "chatter", HZ, EVERY);
    let _server = robot.node(Library::Rospy, "server", &[]);
    let pair = |node, arguments: &[&str]| {
        Node::all_ready(LIBRARIES.map(|(library, suffix)| {
            let name = format!("__name:={node}_{suffix}");
            robot.spawn_node(library, node, &[arguments, &[&name]].concat())
        }))
    };
    let users = pair("param_user", &["/speed"]);
    let mut clients = pair("client", &["20"]);
    let mut readers = pair("reader", &["/speed", "10"]);
    answered(&clients);
    robot.settled_state();
    let before = registrations(&robot);
    for kill in 1..=kills {
        kill_master(&mut robot, &before, &format!("after kill {kill}"));
        set_speed(&robot, &users, kill);
        read_on(&readers);
    }
    answered(&clients);
    assert_eq!(failures(&clients), Vec::<String>::new());
    assert_eq!(failures(&readers), Vec::<String>::new());
    for user in &users {
        let heard: Vec<_> = (0..=kills).map(|speed| speed.to_string()).collect();
        let said = user.said("value");
        // A late user may read the previous value again after the new one. Then it is told the new one again.
        let last = said.iter().enumerate();
        let last = last.filter(|(at, value)| !said[at + 1..].contains(value));
        assert!(last.map(|(_, value)| value).eq(&heard), "{said:?}");
        assert_eq!(user.said("failed"), Vec::<String>::new());
    }
    streams.assert_whole(&robot);

    // While rosrescue itself is away, service lookups and reads fail, which is not what this test is about.
    // The clients are killed, because a rospy node that is told to end during a call waits forever for its
    // own lock.
    for client in clients.iter_mut().chain(&mut readers) {
        client.kill();
    }
    for _ in 0..kills / KILLS_EACH {
        robot.rescue.kill();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
    }
    set_speed(&robot, &users, kills + 1);
    streams.assert_whole(&robot);
}

/// rosrescue pauses after the sixth death within a minute, so each rosrescue lives through only five.
#[test]
fn no_message_is_lost_when_core_and_its_master_are_killed_again_and_again() {
    let restarts = kills() / KILLS_EACH;
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/speed", 0);
    let streams = Streams::start(&robot, "chatter", HZ, EVERY);
    let _server = robot.node(Library::Roscpp, "server", &[]);
    let users = [robot.node(Library::Roscpp, "param_user", &["/speed"])];
    let clients = [robot.node(Library::Rospy, "client", &["20"])];
    answered(&clients);
    robot.settled_state();
    let before = registrations(&robot);
    for round in 1..=restarts {
        // Failures while rosrescue was away do not count.
        answered(&clients);
        let failed = failures(&clients).len();
        for kill in 1..=KILLS_EACH {
            kill_master(
                &mut robot,
                &before,
                &format!("after kill {kill} of round {round}"),
            );
        }
        set_speed(&robot, &users, round);
        answered(&clients);
        assert_eq!(
            failures(&clients)[failed..],
            Vec::<String>::new()[..],
            "round {round}"
        );
        let master = robot.master_pid();
        robot.rescue.kill();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
        assert!(alive(master), "the living master was not adopted");
    }
    set_speed(&robot, &users, restarts + 1);
    answered(&clients);
    assert_eq!(users[0].said("failed"), Vec::<String>::new());
    streams.assert_whole(&robot);
}
