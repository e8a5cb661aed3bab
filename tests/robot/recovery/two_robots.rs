//! Two robots whose masters are synchronised, as by multimaster_fkie (`tests/nodes/master_sync.py`). A rescue of one
//! robot makes no connection that the filters of the synchronisation prevent.

use crate::support::{
    Library, Mode, NODES, Node, Process, Robot, State, eventually, names, ros_command, status,
};

/// Topics that the synchronisation does not share, most importantly the drive commands.
const IGNORED: [&str; 2] = ["/cmd_vel", "/rosout"];
const RESCUES: usize = 4;

/// The nodes of a robot: one sends drive commands, one drives and watches the other robot, one publishes.
fn nodes(robot: &Robot, own: &str, other: &str) -> [Node; 3] {
    let start = |library, program, name: &str, ends: &[String]| {
        let names = [format!("__ns:=/{own}"), format!("__name:={name}")];
        let arguments: Vec<_> = names.iter().chain(ends).map(String::as_str).collect();
        robot.node(library, program, &arguments)
    };
    let commands = ["pub:/cmd_vel".to_owned(), format!("pub:/{own}/joy")];
    let drives = [
        "sub:/cmd_vel".to_owned(),
        format!("pub:/{own}/odom"),
        format!("sub:/{other}/odom"),
        format!("srv:/{own}/reset"),
    ];
    [
        start(Library::Rospy, "multi", "teleop", &commands),
        start(Library::Rospy, "multi", "base", &drives),
        start(Library::Roscpp, "talker", "talker", &[]),
    ]
}

/// Registers the nodes of `remote` with the master of `own`, like multimaster_fkie.
fn sync(own: &Robot, remote: &Robot, namespace: &str) -> Process {
    let mut command = ros_command(&own.scratch, "/usr/bin/python3", own.port());
    command
        .arg(format!("{NODES}/master_sync.py"))
        .args([own.client().uri(), remote.client().uri()])
        .arg(namespace)
        .args(IGNORED);
    Process::start(format!("master_sync of {namespace}"), &mut command)
}

/// Waits until the health check after the rescue from the death of `dead` has finished, and checks that it
/// changed nothing.
#[track_caller]
fn assert_nothing_was_corrected(robot: &Robot, dead: u32) {
    let client = robot.client();
    eventually("the health check has finished", || {
        let report = status(&client)["last_recovery"].clone();
        report["master_pid"] != dead && report["health_check_ms"].is_number()
    });
    let report = status(&client)["last_recovery"].clone();
    for list in ["reconciled", "removed"] {
        assert_eq!(names(&report[list]), Vec::<String>::new(), "{list}");
    }
}

#[test]
fn a_rescue_does_not_connect_one_robot_to_another() {
    let mut robots = [(), ()].map(|()| Robot::start(Mode::Proxy));
    let [a, b] = &robots;
    let _nodes = [nodes(a, "a", "b"), nodes(b, "b", "a")];
    let _syncs = [sync(a, b, "/b/"), sync(b, a, "/a/")];
    for (robot, own, other) in [(a, "a", "b"), (b, "b", "a")] {
        eventually("the robots know each other", || {
            State::try_read(&robot.bare()).is_ok_and(|state| {
                let watched = [format!("/{own}/base"), format!("/{other}/base")];
                let publishers = state.publishers_of(&format!("/{other}/odom"));
                let mut subscribers = state.subscribers_of(&format!("/{own}/odom"));
                subscribers.sort();
                publishers == watched[1..]
                    && subscribers == watched[1..]
                    && state.publishers_of(&format!("/{other}/joy")) == [format!("/{other}/teleop")]
                    && state.publishers_of(&format!("/{other}/chatter"))
                        == [format!("/{other}/talker")]
            })
        });
    }
    let before = [0, 1].map(|index| robots[index].settled_state());
    for (state, own) in before.iter().zip(["a", "b"]) {
        assert_eq!(state.publishers_of("/cmd_vel"), [format!("/{own}/teleop")]);
        assert_eq!(state.subscribers_of("/cmd_vel"), [format!("/{own}/base")]);
    }
    for rescue in 0..RESCUES {
        let robot = &mut robots[rescue % 2];
        let dead = robot.master_pid();
        robot.crash_master();
        assert_nothing_was_corrected(robot, dead);
        for (robot, before) in robots.iter().zip(&before) {
            robot.await_state(before, "after a rescue");
        }
    }
    // The synchronisation still works.
    let [a, b] = &robots;
    let late = ["__ns:=/b", "__name:=late", "chatter:=/b/late"];
    let _late = b.node(Library::Roscpp, "talker", &late);
    eventually("the other robot knows the late node", || {
        a.state().publishers_of("/b/late") == ["/b/late"]
    });
    let listener = a.node(Library::Roscpp, "listener", &["__ns:=/b", "__name:=ear"]);
    listener.wait_messages("/b/talker", 5);
}
