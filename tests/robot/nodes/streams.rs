//! Live streams of rospy and roscpp, several publishers on a topic at 200 Hz, over a hundred deaths of the
//! master and twenty of rosrescue: no message is lost and no connection is made anew. Service clients that
//! look the service up for every call see no failure while masters die, and cached parameters follow.

use crate::support::{Client, Library, Mode, Node, Robot, State, alive, eventually, params};
use rosrescue::xmlrpc::Value;

/// Deaths of the master.
const KILLS: usize = 100;
/// Deaths of rosrescue.
const RESTARTS: usize = 20;
/// Every talker's pace.
const HZ: &str = "200";
/// Every fiftieth message is said, and every gap.
const EVERY: &str = "50";

/// Two talkers on one topic and two listeners, one of each library.
struct Streams {
    talkers: [Node; 2],
    listeners: [Node; 2],
    /// What the nodes say of their links when all are there.
    links: Vec<Value>,
}

const TALKERS: [&str; 2] = ["/talker_py", "/talker_cpp"];
const LIBRARIES: [(Library, &str); 2] = [(Library::Rospy, "py"), (Library::Roscpp, "cpp")];

impl Streams {
    fn start(robot: &Robot) -> Self {
        let start = |node: &str, arguments: [&str; 2]| {
            LIBRARIES.map(|(library, suffix)| {
                let name = format!("__name:={node}_{suffix}");
                let arguments = [&arguments[..], &[name.as_str()]].concat();
                let arguments: Vec<_> = arguments.into_iter().filter(|a| !a.is_empty()).collect();
                robot.node(library, node, &arguments)
            })
        };
        let mut streams = Self {
            talkers: start("talker", [HZ, "quiet"]),
            listeners: start("listener", [EVERY, ""]),
            links: Vec::new(),
        };
        streams.flow();
        streams.links = streams.bus_info(robot);
        for links in &streams.links {
            assert_eq!(links.as_array().unwrap().len(), 2, "{links:?}");
        }
        streams
    }

    /// Waits until messages have come from everybody to everybody.
    fn flow(&self) {
        for listener in &self.listeners {
            for talker in TALKERS {
                listener.wait_messages(talker, 2);
            }
        }
    }

    /// What each node says of its links of the topic: they have numbers, and ports.
    fn bus_info(&self, robot: &Robot) -> Vec<Value> {
        let names =
            ["talker", "listener"].map(|node| LIBRARIES.map(|(_, s)| format!("/{node}_{s}")));
        let client = robot.client();
        let of = |name: &String| {
            let api = client.ok("lookupNode", params!["/test", name.as_str()]);
            let port = api
                .as_str()
                .unwrap()
                .trim_end_matches('/')
                .rsplit(':')
                .next();
            let node = Client::new(port.unwrap().parse().unwrap());
            let links = node.ok("getBusInfo", params!["/test"]);
            let links = links.as_array().unwrap().iter();
            let of_topic = |link: &&Value| link.as_array().unwrap()[4] == Value::from("/chatter");
            Value::Array(links.filter(of_topic).cloned().collect())
        };
        names.iter().flatten().map(of).collect()
    }

    /// Panics if a message was lost or a link was made anew.
    fn assert_whole(&self, robot: &Robot) {
        self.flow();
        for listener in &self.listeners {
            for talker in TALKERS {
                let count = listener.assert_no_gap(talker);
                println!("{count} messages of {talker}");
            }
        }
        for node in self.listeners.iter().chain(&self.talkers) {
            node.assert_no_link_lost();
            assert_eq!(node.links().last(), Some(&2), "{:?}", node.links());
        }
        assert_eq!(self.links, self.bus_info(robot));
    }
}

/// Waits until rosrescue has examined a master since it had examined `recoveries`, and calls pass.
fn await_open(robot: &Robot, recoveries: u64) {
    eventually("the gate is open again", || {
        robot.status().is_some_and(|status| {
            status["open"] == true && status["recoveries"].as_u64() > Some(recoveries)
        })
    });
}

/// Kills the master and waits until its successor holds the whole state.
fn kill_master(robot: &mut Robot, before: &State, when: &str) {
    let recoveries = robot.status().unwrap()["recoveries"].as_u64().unwrap();
    robot.kill_master();
    robot.revive_master();
    await_open(robot, recoveries);
    before.assert_same(&registrations(robot), when);
}

/// The state without its parameters, which the tests change.
fn registrations(robot: &Robot) -> State {
    let mut state = robot.state();
    state.params = Value::Array(Vec::new());
    state.param_names = Vec::new();
    state
}

/// Sets a parameter and waits until the nodes that keep it in their caches have heard of it.
fn set_speed(robot: &Robot, users: &[Node], speed: usize) {
    let speed = i32::try_from(speed).unwrap();
    robot.client().set_param("/speed", speed);
    for user in users {
        eventually("the cache follows", || {
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

/// Waits until each client has got a few more answers.
fn answered(clients: &[Node]) {
    for client in clients {
        let before = client.said("reply").len();
        eventually("answers come", || client.said("reply").len() >= before + 3);
    }
}

#[test]
fn nothing_is_lost_when_the_master_of_others_dies_a_hundred_times() {
    let mut robot = Robot::start(Mode::Proxy);
    robot.client().set_param("/speed", 0);
    let streams = Streams::start(&robot);
    let _server = robot.node(Library::Rospy, "server", &[]);
    let users = LIBRARIES.map(|(library, suffix)| {
        robot.node(
            library,
            "param_user",
            &["/speed", &format!("__name:=user_{suffix}")],
        )
    });
    let mut clients = LIBRARIES.map(|(library, suffix)| {
        robot.node(
            library,
            "client",
            &["20", &format!("__name:=client_{suffix}")],
        )
    });
    let mut readers = LIBRARIES.map(|(library, suffix)| {
        let name = format!("__name:=reader_{suffix}");
        robot.node(library, "reader", &["/speed", &name])
    });
    answered(&clients);
    robot.settled_state();
    let before = registrations(&robot);
    for kill in 1..=KILLS {
        kill_master(&mut robot, &before, &format!("after kill {kill}"));
        set_speed(&robot, &users, kill);
    }
    answered(&clients);
    assert_eq!(failures(&clients), Vec::<String>::new());
    assert_eq!(failures(&readers), Vec::<String>::new());
    for reader in &readers {
        let reads = reader
            .said("reads")
            .last()
            .map_or(0, |n| n.parse().unwrap());
        assert!(reads > 10 * KILLS, "{reads} reads");
    }
    for user in &users {
        let heard: Vec<_> = (0..=KILLS).map(|speed| speed.to_string()).collect();
        assert_eq!(user.said("value"), heard);
        assert_eq!(user.said("failed"), Vec::<String>::new());
    }
    streams.assert_whole(&robot);

    // Who looks for a service, or reads, while rosrescue is not there finds nobody: that is no part of this.
    // By SIGKILL: a rospy node that is told to end while it is in a call waits for its own lock for ever.
    for client in clients.iter_mut().chain(&mut readers) {
        client.kill();
    }
    for _ in 0..RESTARTS {
        robot.rescue.kill();
        robot.rescue.start_again();
        robot.rescue.wait_serving();
        robot.await_gate();
    }
    set_speed(&robot, &users, KILLS + 1);
    streams.assert_whole(&robot);
}

/// A sixth death within a minute is answered with a pause: each rosrescue lives through five.
#[test]
fn nothing_is_lost_when_the_own_master_dies_a_hundred_times_and_rosrescue_twenty_times() {
    let mut robot = Robot::start(Mode::Core);
    robot.client().set_param("/speed", 0);
    let streams = Streams::start(&robot);
    let _server = robot.node(Library::Roscpp, "server", &[]);
    let users = [robot.node(Library::Roscpp, "param_user", &["/speed"])];
    let clients = [robot.node(Library::Rospy, "client", &["20"])];
    answered(&clients);
    robot.settled_state();
    let before = registrations(&robot);
    for round in 1..=RESTARTS {
        // What it asked when rosrescue was away does not count.
        answered(&clients);
        let failed = failures(&clients).len();
        for kill in 1..=KILLS / RESTARTS {
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
        assert!(alive(master), "the living master is adopted");
    }
    assert_eq!(users[0].said("failed"), Vec::<String>::new());
    streams.assert_whole(&robot);
}
