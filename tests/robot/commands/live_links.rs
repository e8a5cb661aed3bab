//! `rosrescue check --live` names a subscriber that is not connected to a publisher of its topic.

use ros1_master::xmlrpc::Value;

use crate::support::{
    Client, Library, Mode, Robot, Tool, eventually, eventually_some, free_port, params, port_of,
    stop,
};

#[test]
fn a_link_that_was_broken_is_found_and_named() {
    let robot = Robot::start(Mode::Core);
    let client = robot.client();
    let mut nodes = Vec::new();
    for (library, suffix) in [(Library::Rospy, "py"), (Library::Roscpp, "cpp")] {
        for node in ["talker", "listener"] {
            let name = format!("__name:={node}_{suffix}");
            nodes.push(robot.node(library, node, &[&name]));
        }
    }
    let check = |more: &[&str]| {
        let words = [&["check", "--live"], more].concat();
        Tool::rosrescue(&robot.scratch, robot.port(), &words)
    };
    // There are four connections of /chatter, and those of /rosout. Each check is a program of its own, so the test first
    // waits without it.
    for listener in [&nodes[1], &nodes[3]] {
        for talker in ["/talker_py", "/talker_cpp"] {
            listener.wait_messages(talker, 1);
        }
    }
    eventually("all links are made", || {
        let checked = check(&[]);
        checked.exit() == 0 && checked.stdout.ends_with("No problems found.")
    });
    let all = check(&["--json"]).json(0);
    let seen = all["findings"][0]["what"].as_str().unwrap().to_owned();
    let count: u32 = seen.split(' ').next().unwrap().parse().unwrap();
    assert!(count >= 8, "{all}");

    // roscpp drops connections by itself, and rospy does not.
    let api = |node: &str| client.ok("lookupNode", params!["/test", node]);
    let node = Client::new(port_of(&client, "/listener_cpp"));
    let tell = |publishers| {
        let publishers = Value::Array(publishers);
        node.ok(
            "publisherUpdate",
            params!["/master", "/chatter", publishers],
        )
    };
    tell(vec![api("/talker_py")]);
    let wanted = "/listener_cpp is not connected to /chatter of /talker_cpp";
    let checked = eventually_some("the missing link is named", || {
        let checked = check(&[]);
        (checked.exit() == 1 && checked.stdout.contains(wanted)).then_some(checked.stdout)
    });
    assert!(
        checked.starts_with("PROBLEM") && checked.ends_with("1 problem, 0 warnings"),
        "{checked}"
    );
    tell(vec![api("/talker_py"), api("/talker_cpp")]);
    eventually("the link is made again", || check(&[]).exit() == 0);

    // A node without an answer is not reported as a missing connection.
    stop(nodes[0].pid());
    let checked = check(&[]).ended(0);
    assert!(
        checked.contains("1 node without an answer: /talker_py"),
        "{checked}"
    );
    let port = free_port();
    let nobody = ["--port", &port.to_string()];
    assert_eq!(check(&nobody).exit(), 3);
    let uri = format!("http://localhost:{}", robot.port());
    assert_eq!(check(&[&nobody[..], &["--uri", &uri]].concat()).exit(), 0);
    // What the error advises is possible.
    let uri = format!("http://localhost:{port}");
    let nobody = check(&["--uri", &uri]);
    assert_eq!(nobody.exit(), 3);
    assert!(nobody.stderr.contains("--uri"), "{nobody:?}");
}
