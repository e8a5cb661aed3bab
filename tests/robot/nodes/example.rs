//! The nodes of the example robot (`examples/robot`) do not notice three deaths of the master and one of rosrescue's
//! worker.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Instant, SystemTime};

use ros1_master::xmlrpc::Value;
use rustix::process::Signal;

use crate::support::{
    Client, Library, NODES, Node, Process, Rescue, Scratch, Setup, State, eventually,
    eventually_some, free_port, params, ros_command, signal, status,
};

const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/robot");
/// Number of deaths of the master before and after the death of the worker.
const DEATHS: [usize; 2] = [2, 1];
/// Sets a parameter as rqt_reconfigure does.
const RECONFIGURE: &str = "
import sys, rospy, dynamic_reconfigure.client
rospy.init_node('operator', anonymous=True)
node, key, value = sys.argv[1:4]
print(dynamic_reconfigure.client.Client(node, timeout=30).update_configuration({key: value})[key])
";

struct Example {
    scratch: Scratch,
    rescue: Rescue,
    master_port: u16,
    witness: Node,
    _launch: Process,
}

impl Example {
    fn start() -> Self {
        let scratch = Scratch::new();
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("example-robot");
        let mut build = Command::new(format!("{EXAMPLE}/build.sh"));
        let built = build
            .arg(folder.join("robot_example_cpp"))
            .status()
            .unwrap();
        assert!(
            built.success(),
            "cannot build the robot: `tests/run.sh` installs what it needs"
        );
        let master_port = free_port();
        let rosmaster = Path::new(NODES).join("waiting_rosmaster.py");
        let rescue = Setup::core(&scratch, master_port)
            .guarded()
            .args(["--rosmaster", rosmaster.to_str().unwrap()])
            .start();
        let mut launch = ros_command(&scratch, format!("{EXAMPLE}/launch.sh"), rescue.port());
        launch.arg(&folder).arg("drive_seconds:=3");
        launch.arg(format!("bag:={}", scratch.path("robot.bag").display()));
        let launch = Process::start("roslaunch", &mut launch);
        let mut witness = Library::Rospy.command(&scratch, rescue.port(), "witness");
        let example = Self {
            witness: Node::run(&mut witness),
            scratch,
            rescue,
            master_port,
            _launch: launch,
        };
        eventually("the robot has finished a drive", || {
            example.param("/mission/arrived").is_some()
        });
        example.at_work();
        example
    }

    fn param(&self, key: &str) -> Option<Value> {
        self.rescue.client().param(key)
    }

    fn master(&self) -> Client {
        Client::new(self.master_port)
    }

    fn is_open(&self) -> bool {
        status(&self.rescue.client())["open"] == true
    }

    fn kill_master(&self) -> u32 {
        fs::write(self.scratch.path("away"), "").unwrap();
        let dead = self.master().master_pid().expect("a living master");
        signal(dead, Signal::KILL);
        eventually("the mirror stands in", || !self.is_open());
        dead
    }

    fn revive_master(&self, dead: u32) {
        fs::remove_file(self.scratch.path("away")).unwrap();
        eventually("another master is there", || {
            self.master().master_pid().is_some_and(|pid| pid != dead) && self.is_open()
        });
    }

    fn kill_worker(&self) {
        let worker = |dead| {
            eventually_some("another worker is there", || {
                let mut pids = self.scratch.survivors().into_iter().map(|(pid, _)| pid);
                pids.find(|&pid| {
                    let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
                    let text = String::from_utf8_lossy(&environment).into_owned();
                    pid != dead && text.contains("ROSRESCUE_GUARDIAN=")
                })
            })
        };
        let dead = worker(0);
        signal(dead, Signal::KILL);
        worker(dead);
        eventually("calls pass again", || self.is_open());
    }

    /// Waits until messages arrive on every watched topic, and transforms and diagnostics are fresh.
    #[track_caller]
    fn at_work(&self) {
        let heard = || -> BTreeMap<String, u64> {
            let said = self.witness.said("heard");
            said.last()
                .map_or_else(BTreeMap::new, |said| serde_json::from_str(said).unwrap())
        };
        let (before, diagnosed) = (heard(), self.witness.said("diagnostics").len());
        eventually("messages arrive on every topic", || {
            let now = heard();
            now.len() == 8
                && now
                    .iter()
                    .all(|(topic, count)| count > before.get(topic).unwrap_or(&0))
        });
        eventually("the tree of transforms is complete and fresh", || {
            let age = self.witness.said("transforms").pop();
            age.is_some_and(|age| age.parse::<f64>().unwrap() < 3.0)
        });
        eventually("every part of the robot has diagnostics", || {
            let said = self.witness.said("diagnostics").split_off(diagnosed);
            said.last()
                .is_some_and(|said| said == "/Base /Cameras /Computer /Power")
        });
    }

    /// The registered nodes and the parameters, without the parameters that the mission keeps changing.
    fn state(&self) -> State {
        let mut state = State::read(&self.master());
        if let Value::Struct(params) = &mut state.params
            && let Some(Value::Struct(mission)) = params.get_mut("mission")
        {
            mission.swap_remove("arrived");
        }
        state
    }

    /// The state once every node has registered and nothing changes any more.
    fn settled(&self) -> State {
        let file = fs::read_to_string(format!("{EXAMPLE}/robot.launch")).unwrap();
        // rosout and the witness are not in that file.
        let nodes = file.matches("<node ").count() + 2;
        let mut state = self.state();
        eventually("the robot is complete", || {
            self.at_work();
            let before = std::mem::replace(&mut state, self.state());
            state == before && state.nodes.len() >= nodes
        });
        state
    }

    /// The process ids of the nodes, by name.
    fn processes(&self) -> BTreeMap<String, u32> {
        let nodes = self.state().nodes.into_iter().map(|(name, api)| {
            let port = api.trim_end_matches('/').rsplit(':').next().unwrap();
            let node = Client::new(port.parse().unwrap());
            (name, node.master_pid().expect("a living node"))
        });
        nodes.collect()
    }

    /// The connections of the relay: number, direction and topic of each. One that is made again has a new number.
    fn connections_of_relay(&self) -> BTreeSet<String> {
        let mut nodes = self.state().nodes.into_iter();
        let (_, api) = nodes.find(|(name, _)| name == "/lidar/relay").unwrap();
        let port = api.trim_end_matches('/').rsplit(':').next().unwrap();
        let relay = Client::new(port.parse().unwrap());
        let Value::Array(connections) = relay.ok("getBusInfo", params!["/test"]) else {
            panic!("no connections");
        };
        let connections = connections.into_iter().map(|connection| match connection {
            Value::Array(parts) => format!("{:?} {:?} {:?}", parts[0], parts[2], parts[4]),
            other => panic!("{other:?}"),
        });
        connections.collect()
    }

    #[track_caller]
    fn reconfigure(&self, node: &str, key: &str, value: &str) {
        let mut command = ros_command(&self.scratch, "/usr/bin/python3", self.rescue.port());
        let output = command
            .args(["-c", RECONFIGURE, node, key, value])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(said.trim().starts_with(value), "{said}{output:?}");
    }

    fn drives(&self) -> Vec<String> {
        self.witness.said("drive")
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "a bag has the times of the wall clock"
)]
fn wall() -> f64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.unwrap().as_secs_f64()
}

/// Whether a line of the witness is about messages that the robot has lost. The relay, which keeps ten messages, drops some
/// itself if it gets no processor for half a second.
fn is_loss(line: &str) -> bool {
    !line.starts_with("/scan ")
}

#[test]
fn the_nodes_of_a_realistic_robot_do_not_notice_deaths_of_master_and_worker() {
    let robot = Example::start();
    let mut before = robot.settled();
    let processes = robot.processes();
    let relayed = robot.connections_of_relay();
    // While the robot starts, a link may be made twice because of two notifications in a row.
    let at_the_start = robot.witness.said("gap");
    let (first_death, start) = (wall(), Instant::now());
    for (round, deaths) in DEATHS.into_iter().enumerate() {
        for death in 0..deaths {
            if death == 0 {
                // The master dies while the robot drives to a goal.
                eventually("the robot drives", || {
                    robot
                        .drives()
                        .last()
                        .is_some_and(|drive| drive.starts_with("driving"))
                });
            }
            let dead = robot.kill_master();
            match (round, death) {
                (0, 0) => robot.reconfigure("/camera/rear/driver", "brightness", "200"),
                (1, 0) => robot.reconfigure("/camera/front/preview", "update_rate", "3"),
                _ => {}
            }
            robot.revive_master(dead);
        }
        if round + 1 < DEATHS.len() {
            robot.kill_worker();
        }
    }
    println!("the deaths took {:?}", start.elapsed());
    let drives = robot.drives().len();
    eventually("the robot has finished another drive", || {
        robot
            .drives()
            .iter()
            .skip(drives)
            .any(|drive| drive.starts_with("at "))
    });
    let last_recovery = wall();
    robot.at_work();

    assert_eq!(robot.processes(), processes);
    assert_eq!(robot.connections_of_relay(), relayed);
    let gaps = robot.witness.said("gap").into_iter();
    let gaps = gaps.skip(at_the_start.len()).filter(|gap| is_loss(gap));
    assert_eq!(gaps.collect::<Vec<_>>(), Vec::<String>::new());
    let lost = |drive: &String| !drive.starts_with("driving to ") && !drive.starts_with("at ");
    assert!(!robot.drives().iter().any(lost), "{:?}", robot.drives());
    // Parameters that were set during outages are kept, and nothing else has changed.
    for (node, key, value) in [
        ("camera/rear/driver", "brightness", Value::Int(200)),
        ("camera/front/preview", "update_rate", Value::Double(3.0)),
    ] {
        let namespace = node
            .split('/')
            .try_fold(&mut before.params, |at, name| match at {
                Value::Struct(members) => members.get_mut(name),
                _ => None,
            });
        let Some(Value::Struct(namespace)) = namespace else {
            panic!("no parameters of {node}");
        };
        namespace.insert(key.to_owned(), value);
    }
    before.assert_same(&robot.state(), "at the end");

    let recorder = processes["/recorder"];
    signal(recorder, Signal::INT);
    let bag = robot.scratch.path("robot.bag");
    eventually("the bag is closed", || bag.exists());
    let mut read = Library::Rospy.command(&robot.scratch, robot.rescue.port(), "witness");
    let mut read = Process::start("the reader of the bag", read.arg("bag").arg(&bag));
    assert!(read.wait_output().success(), "{}", read.log());
    let said = read.stdout();
    let mut gaps = said.iter().filter_map(|line| line.strip_prefix("gap "));
    assert!(!gaps.any(is_loss), "{said:?}");
    for topic in [
        "/scan",
        "/base/odom",
        "/tf",
        "/diagnostics_agg",
        "/mission/state",
    ] {
        let line = said
            .iter()
            .find_map(|line| line.strip_prefix(&format!("bagged {topic} ")));
        let times: Vec<f64> = line
            .unwrap()
            .split(' ')
            .map(|text| text.parse().unwrap())
            .collect();
        assert!(
            times[0] < first_death && times[1] > last_recovery - 5.0,
            "{topic} {times:?}"
        );
    }
    robot.rescue.assert_no_panic();
}
