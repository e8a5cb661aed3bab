//! Measures real clients: many nodes that start at once, and `roslaunch` of rospy and roscpp nodes.

use std::{
    fmt::Write,
    fs,
    time::{Duration, Instant},
};

use ros1_master::xmlrpc::Value;
use serde::Serialize;

use crate::{
    party::{self, Kind, Party},
    shared::{
        load::{self, Script},
        nodes::topics,
        support::{FakeNode, Process, Scratch, encode_call, find_program, params, ros_command},
    },
};

const STORM: usize = 100;
const ROSPY: usize = 30;
const ROSCPP: usize = 10;
const PARAMS: usize = 500;
/// Pause between two checks of which nodes have registered.
const LOOK: Duration = Duration::from_millis(50);
/// Maximum time of a launch.
const PATIENCE: Duration = Duration::from_secs(180);

/// The times of all turns, in milliseconds.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Times {
    pub(crate) party: Kind,
    pub(crate) storm_ms: Vec<f64>,
    pub(crate) launch_ms: Vec<f64>,
}

/// Measures both. Each turn uses newly started parties, so that all begin with the same state.
pub(crate) fn measure(storms: usize, launches: usize) -> Vec<Times> {
    let storm_ms = turns("storm", storms, storm);
    let launch_ms = turns("launch", launches, launch);
    let times = storm_ms.into_iter().zip(launch_ms).zip(Kind::OURS);
    let times = times.map(|((storm_ms, launch_ms), party)| Times {
        party,
        storm_ms,
        launch_ms,
    });
    times.collect()
}

fn turns(what: &str, count: usize, measure: fn(&Party) -> f64) -> [Vec<f64>; Kind::OURS.len()] {
    let mut times = Kind::OURS.map(|_| Vec::new());
    for turn in 0..count {
        let parties = party::start(&Kind::OURS);
        for place in 0..parties.len() {
            let place = (place + turn) % parties.len();
            times[place].push(measure(&parties[place]));
            eprintln!("{what}, {}: {:.0?} ms", parties[place].kind, times[place]);
        }
    }
    times
}

/// The calls that a node with two publishers, two subscribers and a few parameters makes when it starts: 15
/// calls on one connection.
fn start_of(node: &FakeNode, number: usize) -> Script {
    let (name, api) = (node.name.as_str(), node.api.as_str());
    let service_api = node.service_api();
    let private = |key: &str| format!("{name}/{key}");
    let publish = |topic: &str| {
        encode_call(
            "registerPublisher",
            params![name, topic, "std_msgs/String", api],
        )
    };
    let subscribe = |topic: &str| {
        let params = params![name, topic, "std_msgs/String", api];
        encode_call("registerSubscriber", params)
    };
    let offer = |service: &str| {
        let params = params![name, private(service), service_api.as_str(), api];
        encode_call("registerService", params)
    };
    let get = |key: &str| encode_call("getParam", params![name, key]);
    let set = |key: &str, value: i32| encode_call("setParam", params![name, private(key), value]);
    let [published, subscribed] = topics(number, STORM);
    Script::new([
        get("/use_sim_time"),
        publish("/rosout"),
        offer("get_loggers"),
        offer("set_logger_level"),
        encode_call("subscribeParam", params![name, api, "/use_sim_time"]),
        encode_call("hasParam", params![name, private("rate")]),
        set("rate", 10),
        get(&private("rate")),
        get("/storm/robot"),
        publish(&published[0]),
        publish(&published[1]),
        subscribe(&subscribed[0]),
        subscribe(&subscribed[1]),
        set("state", 1),
        encode_call("getPid", params![name]),
    ])
}

fn storm(party: &Party) -> f64 {
    let client = &party.client;
    client.set_param("/use_sim_time", false);
    client.set_param("/storm/robot", 1);
    let nodes: Vec<_> = (0..STORM)
        .map(|number| FakeNode::start(&format!("/node_{number:03}")))
        .collect();
    let scripts = nodes.iter().enumerate();
    let scripts = scripts.map(|(number, node)| start_of(node, number));
    let time = load::once(client.port(), scripts.collect())
        .unwrap_or_else(|error| panic!("{}: {error}", party.kind));
    assert_eq!(publishers(party, "/rosout"), STORM, "{}", party.kind);
    time.as_secs_f64() * 1e3
}

/// The time from the start of `roslaunch` until its last node and parameter is there, in milliseconds.
fn launch(party: &Party) -> f64 {
    // A scratch folder for this turn, so that everything started here ends with it.
    let scratch = Scratch::new();
    let file = scratch.path("compare.launch");
    fs::write(&file, launch_file()).expect("cannot write the launch file");
    let program = find_program("roslaunch");
    let mut command = ros_command(&scratch, program, party.client.port());
    command.arg("--wait").arg(&file);
    let begin = Instant::now();
    let mut roslaunch = Process::start("roslaunch", &mut command);
    while publishers(party, "/launched") < ROSPY + ROSCPP {
        let ended = roslaunch.exited();
        assert!(
            ended.is_none() && begin.elapsed() < PATIENCE,
            "{ended:?}\n{}",
            roslaunch.log()
        );
        std::thread::sleep(LOOK);
    }
    let last = format!("/launch/key_{}", PARAMS - 1);
    assert_eq!(party.client.param(&last), Some(Value::Int(499)));
    begin.elapsed().as_secs_f64() * 1e3
}

fn launch_file() -> String {
    let mut text = "<launch>\n".to_owned();
    for key in 0..PARAMS {
        let _ = writeln!(text, "<param name=\"/launch/key_{key}\" value=\"{key}\"/>");
    }
    let mut node = |package: &str, program: &str, number: usize| {
        let _ = writeln!(
            text,
            "<node name=\"{package}_{number}\" pkg=\"{package}\" type=\"{program}\" args=\"1 quiet\">\
             <remap from=\"chatter\" to=\"/launched\"/></node>"
        );
    };
    (0..ROSPY).for_each(|number| node("rosrescue_nodes", "talker.py", number));
    (0..ROSCPP).for_each(|number| node("rosrescue_cpp_nodes", "talker", number));
    text + "</launch>\n"
}

/// Number of nodes that publish this topic.
fn publishers(party: &Party, topic: &str) -> usize {
    let state = party.client.ok("getSystemState", params!["/compare"]);
    let tables = state.as_array().expect("three tables");
    let mut topics = tables[0].as_array().expect("a list").iter();
    let found = topics.find_map(|entry| match entry.as_array()? {
        [name, nodes] if name.as_str() == Some(topic) => nodes.as_array(),
        _ => None,
    });
    found.map_or(0, <[Value]>::len)
}
