//! The tools of ROS through rosrescue: what they print is what they print at a bare master, before and
//! after a crash of the master; roslaunch brings a whole robot up, also without a master.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use crate::support::{
    Client, Library, Mode, NODES, Node, Process, Robot, Rosmaster, Scratch, State, Tool,
    eventually, holds, params, ros_command, sorted, tree,
};
use rosrescue::xmlrpc::Value;
use rustix::process::Signal;

/// A small robot: what the tools look at.
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
            // One after the other: the order of the lists is the order of the registrations.
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

/// Every tool once, in order, with its status and what it printed.
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
        &["rosnode", "list", "-a"],
        &["rosnode", "info", "/talker"],
        &["rosnode", "info", "/server"],
        &["rosnode", "info", "/nobody"],
        &["rosnode", "ping", "-c", "2", "/listener"],
        &["rostopic", "list", "-v"],
        &["rostopic", "info", "/chatter"],
        &["rostopic", "type", "/chatter"],
        &[
            "rostopic",
            "echo",
            "-n",
            "1",
            "--filter",
            "'talker' in m.data",
            "/chatter",
        ],
        &["rosservice", "list"],
        &["rosservice", "info", "/who"],
        &["rosservice", "call", "/who"],
        &["rosparam", "load", &yaml, "/loaded"],
        &["rosparam", "set", "/one", "1.0"],
        &["rosparam", "get", "/loaded"],
        &["rosparam", "get", "/nothing"],
        &["rosparam", "delete", "/one"],
        &["rosparam", "list"],
        &["rosparam", "dump", &dump_text, "/"],
    ];
    let mut said = Vec::new();
    for run in runs {
        let tool = Tool::run(scratch, port, run[0], &run[1..]);
        let text = format!("{run:?}: {}\n{}\n{}", tool.status, tool.stdout, tool.stderr);
        said.push(normalised(&text, scratch));
    }
    said.push(normalised(&fs::read_to_string(dump).unwrap(), scratch));
    said
}

/// Without what differs from run to run: ports, process ids, times, the number of a message.
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

fn assert_same_session(bare: &[String], through: &[String], when: &str) {
    assert_eq!(bare.len(), through.len());
    for (bare, through) in bare.iter().zip(through) {
        assert!(
            bare == through,
            "{when}\n==== at a bare master\n{bare}\n==== through rosrescue\n{through}"
        );
    }
}

#[test]
fn tools_print_the_same_as_at_a_bare_master() {
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
    let _cast = Cast::start(&robot.scratch, robot.port());
    assert_same_session(
        &bare,
        &session(&robot.scratch, robot.port()),
        "before a crash",
    );
    robot.crash_master();
    // The session sets the same parameters anew: the same result is due.
    assert_same_session(
        &bare,
        &session(&robot.scratch, robot.port()),
        "after a crash",
    );
}

/// `rosnode cleanup` asks at the terminal, so it is answered there.
#[test]
fn rosnode_cleanup_removes_the_dead_node_for_good() {
    let mut robot = Robot::start(Mode::Proxy);
    let mut cast = Cast::start(&robot.scratch, robot.port());
    let before = robot.settled_state();
    let after = before.without_node("/dead");
    cast.dead.kill();
    before.assert_same(&robot.state(), "as long as nobody cleans up");
    let mut command = ros_command(&robot.scratch, "sh", robot.port());
    command.args(["-c", "echo y | rosnode cleanup"]);
    let mut cleanup = Process::start("rosnode cleanup", &mut command);
    assert_eq!(cleanup.wait().code(), Some(0));
    robot.await_state(&after, "when the dead node was cleaned up");
    robot.crash_master();
    after.assert_same(&robot.state(), "after the crash");
}

/// A launch file with a dozen parameters of all kinds and nodes of both libraries.
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

/// Waits until what `launch` brings up is up, as `master` says.
fn await_launched(master: &Client, launch: &mut Process, namespace: &str) {
    let nodes = ["talker", "cpp_listener", "py_listener", "server", "client"];
    eventually(&format!("the nodes of {namespace} are up"), || {
        assert!(launch.exited().is_none(), "roslaunch ended");
        State::try_read(master).is_ok_and(|state| {
            let mut nodes = nodes.iter();
            nodes.all(|node| state.knows(&format!("/{namespace}/{node}")))
        })
    });
    let namespace_says = |what: &str| {
        launch
            .stdout()
            .iter()
            .filter(|line| line.contains(what))
            .count()
    };
    eventually(
        &format!("the nodes of {namespace} talk to each other"),
        || {
            namespace_says(&format!("got /{namespace}/talker ")) >= 20
                && namespace_says(&format!("reply /{namespace}/server")) >= 3
        },
    );
    let params = master
        .param(&format!("/{namespace}"))
        .expect("the parameters");
    assert_eq!(sorted(&params), sorted(&launched_params()));
    assert_eq!(master.param("/use_sim_time"), Some(Value::Bool(false)));
}

fn roslaunch_before_and_after_a_crash(mode: Mode) {
    let mut robot = Robot::start(mode);
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

    // roslaunch takes its nodes down in good order: through rosrescue, to the new master.
    for launch in [&mut first, &mut second] {
        launch.signal(Signal::INT);
        assert_eq!(launch.wait().code(), Some(0));
    }
    let left = eventually_only(&robot, &empty);
    assert_eq!(left, Vec::<String>::new());
    let said = [first.output(), second.output()].concat();
    for bad in ["RLException", "auto-starting", "REQUIRED", "Traceback"] {
        assert!(
            said.iter().all(|line| !line.contains(bad)),
            "{bad}: {}",
            first.log()
        );
    }
    for line in said.iter().filter(|line| line.contains("failed ")) {
        // A client may be stopped after its server.
        assert!(!line.contains("lookup"), "{line}");
    }
}

/// The nodes that are registered beside those of `empty`, once that does not change any more.
fn eventually_only(robot: &Robot, empty: &State) -> Vec<String> {
    let others = |state: &State| -> Vec<String> {
        let nodes = state.nodes.iter().map(|(name, _)| name.clone());
        nodes.filter(|name| !empty.knows(name)).collect()
    };
    others(&robot.settled_state())
}

#[test]
fn roslaunch_before_and_after_a_crash_in_core() {
    roslaunch_before_and_after_a_crash(Mode::Core);
}

#[test]
fn roslaunch_before_and_after_a_crash_in_proxy() {
    roslaunch_before_and_after_a_crash(Mode::Proxy);
}

/// All of them start, find each other and work while there is no master, and the next one knows them.
#[test]
fn late_nodes_and_a_whole_roslaunch_come_up_without_a_master() {
    let mut robot = Robot::start(Mode::Proxy);
    let client = robot.client();
    let talker = robot.node(Library::Roscpp, "talker", &[]);
    let file = robot.scratch.path("robot.launch");
    fs::write(&file, LAUNCH).unwrap();
    let before = robot.settled_state();
    let dead = robot.master_pid();
    robot.kill_master();

    let late = [
        robot.node(Library::Rospy, "listener", &["__name:=late_py"]),
        robot.node(Library::Roscpp, "listener", &["__name:=late_cpp"]),
        robot.node(Library::Rospy, "talker", &["__name:=late_py_talker"]),
        robot.node(Library::Roscpp, "talker", &["__name:=late_cpp_talker"]),
    ];
    for listener in &late[..2] {
        for publisher in ["/talker", "/late_py_talker", "/late_cpp_talker"] {
            listener.wait_messages(publisher, 5);
        }
    }
    let mut launched = launch(&robot, file.to_str().unwrap(), "late");
    await_launched(&client, &mut launched, "late");
    let mut last = State::read(&client);
    eventually("all that is said at the start has been said", || {
        std::thread::sleep(Duration::from_millis(300));
        let before = std::mem::replace(&mut last, State::read(&client));
        before == last
    });
    assert!(!robot.is_open(), "there was a master");
    robot.revive_master();
    robot.await_recovery(dead);
    last.assert_same(&robot.state(), "in the next master");
    for (name, address) in &before.nodes {
        let same = last
            .nodes
            .iter()
            .any(|node| node == &(name.clone(), address.clone()));
        assert!(same, "{name} at {address}:\n{last}");
    }
    let said = launched.output();
    for bad in ["RLException", "auto-starting", "Traceback"] {
        assert!(said.iter().all(|line| !line.contains(bad)), "{bad}");
    }
    for node in &late {
        node.assert_no_link_lost();
    }
    talker.assert_no_link_lost();
    let pid = robot.client().ok("getPid", params!["/test"]);
    assert_eq!(pid, robot.bare().ok("getPid", params!["/test"]));
}
