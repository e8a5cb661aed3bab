//! The checkpoint as other tools read it: after real traffic PyYAML finds every parameter in the file with
//! the same type, text and place as in the master.

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use std::process::Command;

use ros1_master::xmlrpc::Value;

use crate::support::{
    FakeNode, Library, Mode, Robot, Rosmaster, Scratch, Setup, Tool, eventually, kinds, params,
    sorted, tree,
};

/// The output of the script that compares `checkpoint` with the master at `uri`.
fn compared(checkpoint: &Path, uri: &str) -> String {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/checkpoint.py");
    let output = Command::new("/usr/bin/python3")
        .arg(script)
        .arg(checkpoint)
        .arg(uri)
        .output()
        .expect("cannot run the system's Python");
    let said = [output.stdout, output.stderr].concat();
    String::from_utf8_lossy(&said).trim().to_owned()
}

#[test]
fn pyyaml_reads_the_same_parameters_as_the_master_has() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    let checkpoint = rescue.checkpoint();
    let bare = master.client();
    client.set_param("/all", kinds());
    client.set_param("/kinds", kinds());
    client.set_param("/kinds/texts", "one instead of many");
    client.set_param("/a/b/c", 1);
    client.set_param("/a/b", "over a subtree");
    client.set_param("/a/b/d", 2.0);
    client.set_param("/big", vec!["x".repeat(2_000); 5]);
    client.ok("deleteParam", params!["/test", "/kinds/one"]);
    // The test makes more calls than a journal keeps, so the file is replaced. It must be complete all the time.
    // While this is open, no other file gets its number.
    let first = fs::File::open(&checkpoint).unwrap();
    for i in 0..1200 {
        client.set_param(&format!("/many/p{}", i % 50), i);
        if i == 600 {
            assert_eq!(compared(&checkpoint, &bare.uri()), "same", "after call {i}");
        }
    }
    assert_eq!(compared(&checkpoint, &bare.uri()), "same");
    let [first, last] = [first.metadata(), fs::metadata(&checkpoint)].map(|of| of.unwrap().ino());
    assert_ne!(last, first, "the journal is never compacted");
    assert_eq!(
        fs::metadata(&checkpoint).unwrap().permissions().mode() & 0o777,
        0o600
    );

    // The last snapshot is written at a clean stop.
    assert_eq!(rescue.terminate().code(), Some(0));
    assert_eq!(compared(&checkpoint, &bare.uri()), "same");
}

#[test]
fn nodes_topics_and_services_are_readable_in_the_checkpoint() {
    let robot = Robot::start(Mode::Core);
    let _talker = robot.node(Library::Rospy, "talker", &[]);
    let node = FakeNode::start("/fake");
    node.offer(&robot.client(), "/fake/service");
    node.watch_param(&robot.client(), "/gains");
    let checkpoint = robot.rescue.checkpoint();
    eventually("the file has all nodes, topics and services", || {
        let text = fs::read_to_string(&checkpoint).unwrap_or_default();
        let facts = [
            "/talker",
            "/chatter",
            "std_msgs/String",
            "/fake/service",
            "/gains",
            "run_id",
            &node.api,
            &node.service_api(),
        ];
        facts.iter().all(|fact| text.contains(fact))
    });
    assert_eq!(compared(&checkpoint, &robot.bare().uri()), "same");
}

/// The parameters in the file are a tree that `rosparam load` accepts.
#[test]
fn rosparam_can_load_the_parameters_of_a_checkpoint() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    // The keys `a/b`, `~x` and the empty one are left out, because rosparam resolves keys as names.
    let robot = tree! {
        "texts" => vec!["no", "on", "1:30", "=", "1.0", "", " x ", "2024-01-31", "~", "a\nb\t\"c\"", "é\u{85}"],
        "numbers" => vec![i32::MIN, 0, i32::MAX],
        "doubles" => vec![1.0, 1.5, -0.0, 1e300, f64::INFINITY],
        "odd" => tree! { "1" => 1, "x: #y" => 2, "on" => true },
        "empty" => Value::Array(Vec::new()),
        "when" => Value::DateTime("20240131T12:00:00".to_owned()),
        "bytes" => Value::Base64(vec![0, 255, 10]),
    };
    rescue.client().set_param("/robot", robot.clone());
    assert_eq!(rescue.terminate().code(), Some(0));

    let parameters = scratch.path("parameters.yaml");
    let python = "import sys, yaml; yaml.dump(yaml.safe_load(open(sys.argv[1]))['parameters'], open(sys.argv[2], 'w'))";
    let mut command = Command::new("/usr/bin/python3");
    command
        .args(["-c", python])
        .args([&rescue.checkpoint(), &parameters]);
    assert!(
        command
            .status()
            .expect("cannot run the system's Python")
            .success()
    );
    let arguments = ["load", parameters.to_str().unwrap(), "/copy"];
    let loaded = Tool::run(&scratch, master.port, "rosparam", &arguments);
    assert!(loaded.status.success(), "{loaded:?}");
    // PyYAML writes keys in alphabetical order.
    let copy = master.client().param("/copy/robot").expect("the copy");
    assert_eq!(sorted(&copy), sorted(&robot));
}
