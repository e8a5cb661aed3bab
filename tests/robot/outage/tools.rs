//! The tools of ROS, started while there is no master.

use std::{
    fmt::Write as _,
    fs,
    time::{Duration, Instant},
};

use rustix::process::Signal;

use super::LIBRARIES;
use crate::support::{Mode, Process, Robot, State, eventually, find_program, ros_command};

/// By then a tool that was interrupted has ended.
const ENDED: Duration = Duration::from_secs(2);
/// Nodes of each library in the launch file.
const EACH: [&str; 3] = ["talker", "listener", "server"];

/// A dozen nodes: two groups of three nodes of each library.
fn launch_file() -> String {
    let mut file = "<launch>\n<param name=\"/launched\" value=\"yes\"/>\n".to_owned();
    for group in ["left", "right"] {
        writeln!(file, "<group ns=\"{group}\">").unwrap();
        writeln!(file, "<rosparam>gains: {{p: 1.0, i: 2}}</rosparam>").unwrap();
        for (_, suffix) in LIBRARIES {
            for node in EACH {
                let (package, kind) = match suffix {
                    "py" => ("rosrescue_nodes", format!("{node}.py")),
                    _ => ("rosrescue_cpp_nodes", node.to_owned()),
                };
                writeln!(
                    file,
                    "<node pkg=\"{package}\" type=\"{kind}\" name=\"{node}_{suffix}\" output=\"screen\">\n\
                     <remap from=\"who\" to=\"who_{suffix}\"/><param name=\"speed\" value=\"3\"/></node>"
                )
                .unwrap();
            }
        }
        writeln!(file, "</group>").unwrap();
    }
    file + "</launch>\n"
}

fn launched(state: &State) -> usize {
    let names = ["left", "right"].into_iter().flat_map(|group| {
        LIBRARIES
            .iter()
            .flat_map(move |(_, suffix)| EACH.map(|node| format!("/{group}/{node}_{suffix}")))
    });
    names.filter(|name| state.knows(name)).count()
}

#[test]
fn roslaunch_brings_a_dozen_nodes_up_and_down_without_a_master() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let file = robot.scratch.path("robot.launch");
    fs::write(&file, launch_file()).unwrap();
    let dead = robot.master_pid();
    robot.take_master_away();
    let client = robot.client();
    let begin = Instant::now();
    let mut command = ros_command(&robot.scratch, find_program("roslaunch"), robot.port());
    let mut launch = Process::start("roslaunch", command.arg(&file));
    eventually("all nodes are known", || {
        assert_eq!(launch.exited(), None, "{}", launch.log());
        State::try_read(&client).is_ok_and(|state| launched(&state) == 12)
    });
    let got = |launch: &Process, group: &str, talker: &str| {
        let line = format!("got /{group}/talker_{talker} ");
        let lines = launch.stdout();
        lines.iter().filter(|said| said.contains(&line)).count()
    };
    for group in ["left", "right"] {
        for (_, suffix) in LIBRARIES {
            eventually("the nodes talk to each other", || {
                got(&launch, group, suffix) >= 20
            });
        }
        let gains = client.param(&format!("/{group}/gains/i"));
        assert_eq!(gains, Some(2.into()));
        let speed = client.param(&format!("/{group}/server_py/speed"));
        assert_eq!(speed, Some(3.into()));
    }
    println!("a dozen nodes are up after {:?}", begin.elapsed());
    let mirror = State::read(&client);
    robot.revive_master();
    robot.await_recovery(dead);
    mirror.assert_same(&robot.state(), "in the new master");

    robot.take_master_away();
    launch.signal(Signal::INT);
    assert_eq!(launch.wait().code(), Some(0));
    assert_eq!(launched(&State::read(&client)), 0);
    let said = launch.output();
    for bad in ["RLException", "auto-starting", "REQUIRED", "Traceback"] {
        let found = said.iter().find(|line| line.contains(bad));
        assert_eq!(found, None, "{}", launch.log());
    }
}

#[test]
fn tools_that_are_started_without_a_master_end_at_ctrl_c_in_core_mode() {
    tools_that_are_started_without_a_master_end_at_ctrl_c(Mode::Core);
}

#[test]
fn tools_that_are_started_without_a_master_end_at_ctrl_c_in_proxy_mode() {
    tools_that_are_started_without_a_master_end_at_ctrl_c(Mode::Proxy);
}

fn tools_that_are_started_without_a_master_end_at_ctrl_c(mode: Mode) {
    let mut robot = Robot::start_for_outages(mode);
    let nobody = robot.settled_state().nodes;
    robot.take_master_away();
    let client = robot.client();
    let runs: [(&[&str], &str); 5] = [
        (&["echo", "/chatter"], "data:"),
        (&["hz", "/chatter"], "average rate"),
        (&["pub", "-r", "20", "/chatter", "std_msgs/String", "x"], ""),
        (&["pub", "/latched", "std_msgs/String", "x"], "latching"),
        // Of a type that nobody publishes: it waits.
        (&["echo", "/nobody"], ""),
    ];
    let mut tools = runs.map(|(arguments, _)| {
        let mut command = ros_command(&robot.scratch, find_program("rostopic"), robot.port());
        Process::start(format!("rostopic {arguments:?}"), command.args(arguments))
    });
    eventually("the two that publish are known", || {
        let state = State::read(&client);
        state.publishers_of("/chatter").len() == 1 && state.publishers_of("/latched").len() == 1
    });
    for (tool, (_, says)) in tools.iter_mut().zip(runs) {
        if !says.is_empty() {
            tool.wait_line(says, |line| line.contains(says));
        }
    }
    for tool in &mut tools {
        let begin = Instant::now();
        tool.signal(Signal::INT);
        tool.wait();
        let took = begin.elapsed();
        println!("{mode:?}: {took:?}");
        assert!(took < ENDED, "{took:?}\n{}", tool.log());
        let log = tool.output().join("\n");
        assert!(!log.contains("Unable to communicate"), "{log}");
    }
    eventually("nobody is left", || State::read(&client).nodes == nobody);
}
