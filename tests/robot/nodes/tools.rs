//! The tools of ROS used through rosrescue: after a crash of the master they print the same as with a bare
//! master, and roslaunch can bring up a whole robot.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use crate::support::{
    Client, Library, Mode, NODES, Node, Process, Robot, Rosmaster, Scratch, State, Tool,
    eventually, holds, ros_command, sorted, tree, within,
};
use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

/// A small robot, which the tools examine.
struct Cast {
    _talker: Node,
    _listener: Node,
    _server: Node,
    dead: Node,
}

impl Cast {
    fn start(scratch: &Scratch, port: u16) -> Self {
        let node = |library, name, arguments: &[&str]| {
            let node = Node::start(scratch, library, port, name, arguments);
            // One after another, because the order of lists is the order of registrations.
            node
        };
        let cast = Self {
            _talker: node(Library::Rospy, "talker", &[]),
            _listener: node(Library::Roscpp, "listener", &[]),
            _server: node(Library::Roscpp, "server", &[]),
            dead: node(
                Library::Rospy,
                "listener",
                &["__name:=dead", "chatter:=elsewhere"],
            ),
        };
        cast._listener.wait_messages("/talker", 3);
        cast
    }
}

/// Runs each tool once, in order. Returns the status and output of each.
fn session(scratch: &Scratch, port: u16) -> Vec<String> {
    let yaml = scratch.path("load.yaml");
    fs::write(
        &yaml,
        "gains: {p: 1.0, i: 2, d: [0.5, true, 'no']}\ntext: |\n  two\n  lines\n",
    )
    .unwrap();
    let yaml = yaml.to_str().unwrap().to_owned();
    let dump = scratch.path("dump.yaml");
    let dump_text = dump.to_str().unwrap().to_owned();
    let runs: &[&[&str]] = &[
        &["rosnode", "list"],
        &["rosnode", "info", "/talker"],
        &["rosnode", "info", "/server"],
        &["rosnode", "ping", "-c", "2", "/listener"],
        &["rostopic", "list", "-v"],
        &["rostopic", "info", "/chatter"],
        &[
            "rostopic",
            "echo",
            "-n",
            "1",
            "--filter",
            "'talker' in m.data",
            "/chatter",
        ],
        &["rosservice", "info", "/who"],
        &["rosservice", "call", "/who"],
        &["rosparam", "load", &yaml, "/loaded"],
        &["rosparam", "get", "/loaded"],
        &["rosparam", "get", "/nothing"],
        &["rosparam", "list"],
        &["rosparam", "dump", &dump_text, "/"],
    ];
    let mut said = Vec::new();
    for (run, tool) in runs.iter().zip(Tool::run_all(scratch, port, runs)) {
        let text = format!("{run:?}: {}\n{}\n{}", tool.status, tool.stdout, tool.stderr);
        said.push(normalised(&text, scratch));
    }
    said.push(normalised(&fs::read_to_string(dump).unwrap(), scratch));
    said
}

/// The text without parts that differ from run to run: ports, process ids, times, message numbers.
fn normalised(text: &str, scratch: &Scratch) -> String {
    let text = text.replace(scratch.path("").to_str().unwrap(), "SCRATCH/");
    let mut out = String::new();
    for line in text.lines() {
        let line = match line {
            _ if line.contains("direction: ") => {
                let start = line.split('(').next().unwrap();
                format!("{start}(...)")
            }
            _ if line.starts_with("data: \"/talker ") => "data: \"/talker N\"".to_owned(),
            _ if line.starts_with("Pid: ") => "Pid: N".to_owned(),
            _ if line.contains("time=") => format!("{}time=N", line.split("time=").next().unwrap()),
            _ if line.starts_with("ping average: ") => "ping average: N".to_owned(),
            _ => line.to_owned(),
        };
        out += &without_ports(&line);
        out.push('\n');
    }
    out
}

fn without_ports(line: &str) -> String {
    let mut parts = line.split("127.0.0.1:");
    let mut out = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        out += "127.0.0.1:PORT";
        out += part.trim_start_matches(|c: char| c.is_ascii_digit());
    }
    out
}

#[test]
fn tools_print_and_do_the_same_as_with_a_bare_master() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let _bare_cast = Cast::start(&scratch, master.port);
    let bare = session(&scratch, master.port);
    assert!(bare[0].contains("/talker"), "{}", bare[0]);
    assert!(
        bare.iter().any(|text| text.contains("name: \"/server\"")),
        "{bare:?}"
    );

    let mut robot = Robot::start(Mode::Proxy);
    let cast = Cast::start(&robot.scratch, robot.port());
    robot.crash_master();
    let through = session(&robot.scratch, robot.port());
    assert_eq!(bare.len(), through.len());
    for (bare, through) in bare.iter().zip(&through) {
        assert!(
            bare == through,
            "==== at a bare master\n{bare}\n==== through rosrescue\n{through}"
        );
    }
    rosnode_cleanup_removes_a_dead_node_permanently(robot, cast);
}

/// `rosnode cleanup` asks before it removes nodes, so it gets an answer on its standard input.
fn rosnode_cleanup_removes_a_dead_node_permanently(mut robot: Robot, mut cast: Cast) {
    let before = robot.settled_state();
    let after = before.without_node("/dead");
    cast.dead.kill();
    before.assert_same(&robot.state(), "before the cleanup");
    let mut command = ros_command(&robot.scratch, "sh", robot.port());
    command.args(["-c", "echo y | rosnode cleanup"]);
    let mut cleanup = Process::start("rosnode cleanup", &mut command);
    assert_eq!(cleanup.wait().code(), Some(0));
    robot.await_state(&after, "after the cleanup");
    robot.crash_master();
    after.assert_same(&robot.state(), "after the crash");
}

/// A launch file with a dozen parameters of all kinds, and nodes of both client libraries.
const LAUNCH: &str = r#"
<launch>
  <arg name="ns" default="first"/>
  <param name="use_sim_time" value="false" type="bool"/>
  <group ns="$(arg ns)">
    <param name="an_int" value="42"/>
    <param name="a_double" value="0.5"/>
    <param name="a_whole_double" value="1" type="double"/>
    <param name="a_text" value="no"/>
    <param name="a_text_that_looks_like_a_number" value="007" type="str"/>
    <param name="a_truth" value="true"/>
    <param name="robot_description" textfile="$(find rosrescue_nodes)/package.xml"/>
    <param name="from_a_command" command="printf 'said &lt;so&gt;'"/>
    <param name="from_yaml" type="yaml" value="{a: [1, 2.5, x], b: {c: true}}"/>
    <rosparam>
      gains: {p: 1.0, i: 0, d: -2.5}
      names: [left, right]
      empty: ''
    </rosparam>
    <node pkg="rosrescue_nodes" type="talker.py" name="talker" args="20" output="screen">
      <param name="private" value="mine"/>
    </node>
    <node pkg="rosrescue_cpp_nodes" type="listener" name="cpp_listener" output="screen"/>
    <node pkg="rosrescue_nodes" type="listener.py" name="py_listener" output="screen"/>
    <node pkg="rosrescue_cpp_nodes" type="server" name="server" output="screen"/>
    <node pkg="rosrescue_nodes" type="client.py" name="client" output="screen">
      <remap from="who" to="/$(arg ns)/who"/>
    </node>
  </group>
</launch>
"#;

fn launched_params() -> Value {
    let description = fs::read_to_string(PathBuf::from(NODES).join("package.xml")).unwrap();
    tree! {
        "a_double" => 0.5, "a_text" => "no", "a_text_that_looks_like_a_number" => "007",
        "a_truth" => true, "a_whole_double" => 1.0, "an_int" => 42, "empty" => "",
        "from_a_command" => "said <so>",
        "from_yaml" => tree! {
            "a" => Value::Array(vec![1.into(), 2.5.into(), "x".into()]),
            "b" => tree! { "c" => true },
        },
        "gains" => tree! { "d" => -2.5, "i" => 0, "p" => 1.0 },
        "names" => vec!["left", "right"],
        "robot_description" => description,
        "talker" => tree! { "private" => "mine" },
    }
}

fn launch(robot: &Robot, file: &str, namespace: &str) -> Process {
    let mut command = ros_command(&robot.scratch, "roslaunch", robot.port());
    command.arg(file).arg(format!("ns:={namespace}"));
    Process::start(format!("roslaunch {namespace}"), &mut command)
}

/// Waits until `master` shows that everything which `launch` brings up is running.
fn await_launched(master: &Client, launch: &mut Process, namespace: &str) {
    let nodes = ["talker", "cpp_listener", "py_listener", "server", "client"];
    let says = |launch: &Process, what: &str| {
        launch
            .stdout()
            .iter()
            .filter(|line| line.contains(what))
            .count()
    };
    eventually(
        &format!("the nodes of {namespace} talk to each other"),
        || {
            assert!(launch.exited().is_none(), "roslaunch ended");
            // A node is ready after its last registration.
            let is_ready = |node: &&str| says(launch, &format!("ready /{namespace}/{node}")) > 0;
            nodes.iter().all(is_ready)
                && says(launch, &format!("got /{namespace}/talker ")) >= 20
                && says(launch, &format!("reply /{namespace}/server")) >= 3
        },
    );
    // Reading the whole state takes many calls, so it comes when little is left to wait for.
    eventually(&format!("the nodes of {namespace} are registered"), || {
        State::try_read(master).is_ok_and(|state| {
            let mut nodes = nodes.iter();
            nodes.all(|node| state.knows(&format!("/{namespace}/{node}")))
        })
    });
    let params = master
        .param(&format!("/{namespace}"))
        .expect("the parameters");
    assert_eq!(sorted(&params), sorted(&launched_params()));
    assert_eq!(master.param("/use_sim_time"), Some(Value::Bool(false)));
}

#[test]
fn roslaunch_works_before_and_after_a_crash_of_the_master() {
    let mut robot = Robot::start(Mode::Proxy);
    let file = robot.scratch.path("robot.launch");
    fs::write(&file, LAUNCH).unwrap();
    let file = file.to_str().unwrap();
    let empty = robot.settled_state();

    let mut first = launch(&robot, file, "first");
    await_launched(&robot.bare(), &mut first, "first");
    let before = robot.settled_state();
    robot.crash_master();
    before.assert_same(&robot.state(), "after the crash");

    let mut second = launch(&robot, file, "second");
    await_launched(&robot.bare(), &mut second, "second");
    assert!(
        holds(Duration::from_secs(1), || first.exited().is_none()),
        "the first launch ended"
    );

    // roslaunch ends its nodes cleanly: through rosrescue, at the new master.
    for launch in [&mut first, &mut second] {
        launch.signal(Signal::INT);
        assert_eq!(launch.wait().code(), Some(0));
    }
    let left = eventually_only(&robot, &empty);
    assert_eq!(left, Vec::<String>::new());
    assert_no_complaint(&first);
    assert_no_complaint(&second);
}

/// Panics if roslaunch or one of its nodes prints an error.
#[track_caller]
fn assert_no_complaint(launched: &Process) {
    for line in launched.output() {
        for bad in ["RLException", "auto-starting", "REQUIRED", "Traceback"] {
            assert!(!line.contains(bad), "{bad}: {}", launched.log());
        }
        // A client may be stopped after its server.
        let failed = line.contains("failed ") && line.contains("lookup");
        assert!(!failed, "{line}");
    }
}

/// The nodes that are registered in addition to those of `empty`, once their number no longer changes.
fn eventually_only(robot: &Robot, empty: &State) -> Vec<String> {
    let others = |state: &State| -> Vec<String> {
        let nodes = state.nodes.iter().map(|(name, _)| name.clone());
        nodes.filter(|name| !empty.knows(name)).collect()
    };
    others(&robot.settled_state())
}

/// The nodes start and end while there is no master; in between the next master knows them.
#[test]
fn roslaunch_starts_and_stops_nodes_without_a_master() {
    let mut robot = Robot::start_for_outages(Mode::Core);
    let file = robot.scratch.path("robot.launch");
    fs::write(&file, LAUNCH).unwrap();
    let dead = robot.master_pid();
    robot.take_master_away();
    let client = robot.client();
    let mut launched = launch(&robot, file.to_str().unwrap(), "late");
    await_launched(&client, &mut launched, "late");
    let mirror = State::read(&client);
    robot.revive_master();
    robot.await_recovery(dead);
    mirror.assert_same(&robot.state(), "in the new master");

    robot.take_master_away();
    launched.signal(Signal::INT);
    assert_eq!(launched.wait().code(), Some(0));
    let left = State::read(&client).nodes;
    assert!(
        !left.iter().any(|(name, _)| name.starts_with("/late/")),
        "{left:?}"
    );
    assert_no_complaint(&launched);
}

/// Maximum time for an interrupted tool to end. It must not wait for a master.
const ENDED: Duration = Duration::from_secs(10);

#[test]
fn tools_started_without_a_master_end_at_ctrl_c() {
    let mut robot = Robot::start_for_outages(Mode::Proxy);
    let without_tools = robot.settled_state().nodes;
    robot.take_master_away();
    let client = robot.client();
    let runs: [(&[&str], &str); 5] = [
        (&["echo", "/chatter"], "data:"),
        (&["hz", "/chatter"], "average rate"),
        (&["pub", "-r", "20", "/chatter", "std_msgs/String", "x"], ""),
        (&["pub", "/latched", "std_msgs/String", "x"], "latching"),
        // Nothing publishes a topic of this type, so the tool waits.
        (&["echo", "/nobody"], ""),
    ];
    let mut tools = runs.map(|(arguments, _)| {
        let mut command = ros_command(&robot.scratch, "rostopic", robot.port());
        Process::start(format!("rostopic {arguments:?}"), command.args(arguments))
    });
    eventually("the two publishing tools are registered", || {
        let state = State::read(&client);
        state.publishers_of("/chatter").len() == 1 && state.publishers_of("/latched").len() == 1
    });
    for (tool, (_, says)) in tools.iter_mut().zip(runs) {
        if !says.is_empty() {
            tool.wait_line(says, |line| line.contains(says));
        }
    }
    for tool in &mut tools {
        tool.signal(Signal::INT);
        within(ENDED, "the end of a tool", || tool.wait());
        let log = tool.output().join("\n");
        assert!(!log.contains("Unable to communicate"), "{log}");
    }
    eventually("no tool is registered any more", || {
        State::read(&client).nodes == without_tools
    });
}
