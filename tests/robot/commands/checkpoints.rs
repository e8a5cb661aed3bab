//! `inspect`, `verify` and `diff`.

use std::fs;
use std::path::Path;

use rescue_core::checkpoint::format::{self, Checkpoint, Record, RecordContent, Session};
use ros1_master::master::{Method, Request, Snapshot};

use crate::support::{
    FakeNode, Library, Mode, Robot, Scratch, Tool, eventually, free_port, params, tree,
};

#[test]
fn a_checkpoint_is_inspected_beside_the_running_rosrescue() {
    let robot = Robot::start(Mode::Core);
    let _talker = robot.node(Library::Rospy, "talker", &[]);
    let listener = robot.node(Library::Roscpp, "listener", &[]);
    listener.wait_messages("/talker", 1);
    robot.client().set_param("/robot/wheels", 4);
    robot.client().set_param("/wifi/password", "geheim");
    let watch = params!["/watcher", "http://127.0.0.1:9/", "/robot/wheels"];
    robot.client().ok("subscribeParam", watch);
    let run = |arguments: &[&str]| Tool::rosrescue(&robot.scratch, robot.port(), arguments);
    let text = run(&["inspect"]).ended(0);
    for line in [
        "    publishes  /rosout, /chatter",
        "    watches    /robot/wheels",
        "  /chatter  std_msgs/String  1 publishing, 1 subscribing",
        "  /robot/wheels: 4",
        "  /wifi/password: \"(hidden)\"",
    ] {
        assert!(text.lines().any(|found| found == line), "{line}\n{text}");
    }
    assert!(!text.contains("geheim"));
    let json = run(&["inspect", "present", "--json"]).json(0);
    assert_eq!(json["parameters"]["robot"]["wheels"], 4);
    assert_eq!(json["parameters"]["wifi"]["password"], "(hidden)");
    let nodes = json["nodes"].as_array().unwrap();
    let listener = nodes
        .iter()
        .find(|node| node["name"] == "/listener")
        .unwrap();
    assert_eq!(listener["subscribes"][0], "/chatter");
    assert_eq!(listener["services"].as_array().unwrap().len(), 2);
    // A regular expression given by the user, and an empty one.
    let text = run(&["inspect", "--hide-values", "WHEELS"]).ended(0);
    assert!(text.contains("/robot/wheels: \"(hidden)\"") && text.contains("geheim"));
    assert!(
        run(&["inspect", "--hide-values", ""])
            .ended(0)
            .contains("geheim")
    );

    assert!(run(&["verify", "present"]).ended(0).contains("is whole"));
    // The mirror equals the master.
    let same = run(&["diff", "present", "--live"]).ended(0);
    assert!(same.contains("do not differ"), "{same}");
}

#[test]
fn diff_describes_differences_in_words() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    let client = robot.client();
    client.set_param("/a", tree! { "b" => 1, "gone" => "x" });
    client.set_param("/token", "one");
    let (camera, old) = (FakeNode::start("/camera"), FakeNode::start("/old"));
    camera.publish(&client, "/image", "sensor_msgs/Image");
    camera.publish(&client, "/info", "sensor_msgs/CameraInfo");
    old.subscribe(&client, "/image", "sensor_msgs/Image");
    old.offer(&client, "/old/reset");
    let path = robot.rescue.checkpoint();
    let before = robot.scratch.path("before.yaml");
    fs::copy(&path, &before).unwrap();
    let before = before.to_str().unwrap();

    camera.unpublish(&client, "/image");
    old.unsubscribe(&client, "/image");
    old.withdraw(&client, "/old/reset");
    client.set_param("/a/b", 2.0);
    client.ok("deleteParam", params!["/test", "/a/gone"]);
    client.set_param("/token", "two");
    let run = |arguments: &[&str]| Tool::rosrescue(&robot.scratch, robot.port(), arguments);
    for (arguments, [a, b]) in [
        (&["diff", before, "present"][..], ["A", "B"]),
        (
            &["diff", before, "--live"],
            ["the file", "the running master"],
        ),
    ] {
        let text = run(arguments).ended(1);
        let api = &old.api;
        let expected = [
            format!("{a} is {before}"),
            format!("{b} is "),
            format!("node /old at {api} only in {a}: subscribes /image; provides /old/reset"),
            format!("/camera publishes /image only in {a}"),
            "parameter /a/b: 1 -> 2.0".to_owned(),
            format!("parameter /a/gone only in {a}: \"x\""),
            "parameter /token: \"(hidden)\" -> \"(hidden)\"".to_owned(),
        ];
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), expected.len(), "{text}");
        for (line, expected) in lines.iter().zip(&expected) {
            assert!(line.starts_with(expected), "{expected}\n{text}");
        }
    }
    let json = run(&["diff", before, "present", "--json"]).json(1);
    let camera = &json["differences"][1];
    assert_eq!(
        (camera["what"].as_str(), camera["node"].as_str()),
        (Some("publisher"), Some("/camera"))
    );
    run(&["diff", before, before]).ended(0);
    let nobody = format!("http://127.0.0.1:{}", free_port());
    let nobody = run(&["diff", before, "--live", "--uri", &nobody]);
    assert!(
        nobody.stderr.contains("no rosrescue at http://127.0.0.1:"),
        "{nobody:?}"
    );
    nobody.ended(3);
}

/// A checkpoint with one parameter in its snapshot and two in its journal. Returns where the journal's lines start.
fn file(at: &Path) -> [usize; 3] {
    let checkpoint = Checkpoint {
        seq: 1,
        session: Session {
            id: "a".to_owned(),
            ..Session::default()
        },
        snapshot: Snapshot {
            params: tree! { "one" => 1 }.as_struct().unwrap().clone(),
            ..Snapshot::default()
        },
        pending: Vec::new(),
        displaced: Vec::new(),
        follows: false,
    };
    let encoded = format::encode_checkpoint(&checkpoint, 1).unwrap();
    let mut bytes = encoded.bytes;
    let mut starts = [bytes.len(); 3];
    for (seq, name) in [(2, "/two"), (3, "/three")] {
        let call = Request::new(Method::SetParam, params!["/n", name, 2]);
        let record = Record {
            seq,
            entry: RecordContent::call(call),
        };
        bytes.extend(format::encode_record(&record, encoded.stamp).unwrap());
        starts[seq as usize - 1] = bytes.len();
    }
    fs::write(at, bytes).unwrap();
    starts
}

#[test]
fn bad_input_gets_one_clear_sentence_and_status_2() {
    let scratch = Scratch::new();
    let whole = scratch.path("whole.yaml");
    let [_, second, end] = file(&whole);
    let bytes = fs::read(&whole).unwrap();
    let make = |name: &str, bytes: &[u8]| {
        let path = scratch.path(name);
        fs::write(&path, bytes).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let mut damaged = bytes.clone();
    damaged[second - 30] ^= 4;
    let damaged = make("damaged.yaml", &damaged);
    let newer = String::from_utf8(bytes.clone()).unwrap();
    let (first, rest) = newer.split_once('\n').unwrap();
    let first = first.replace("checkpoint v2", "checkpoint v3");
    let (first, _) = first.rsplit_once("header=").unwrap();
    let first = format!("{first}header=");
    let newer = format!("{first}{:08x}\n{rest}", crc32c::crc32c(first.as_bytes()));
    let newer = make("newer.yaml", newer.as_bytes());
    let other = make("other.yaml", b"gains: {p: 1}\n");
    let empty = make("empty.yaml", b"");
    let folder = scratch.log_dir();
    let run = |arguments: &[&str]| Tool::rosrescue(&scratch, 9, arguments);
    let whole = whole.to_str().unwrap();
    for (path, said) in [
        ("/nowhere/at/all", "there is no file `/nowhere/at/all`"),
        (folder.to_str().unwrap(), "is a folder"),
        (&other, "is not a rosrescue checkpoint"),
        (&empty, "is damaged"),
        (
            &newer,
            "has checkpoint format 3 of another version of rosrescue",
        ),
        (&damaged, "is damaged"),
    ] {
        for command in [
            &["inspect", path][..],
            &["verify", path],
            &["diff", path, whole],
            &["diff", whole, path],
            &["restore", path, "--plan"],
            &["params", path],
        ] {
            let ended = run(command);
            if said == "is damaged" && command[0] == "verify" {
                continue;
            }
            assert_eq!(ended.stderr.lines().count(), 1, "{ended:?}");
            assert!(ended.stderr.contains(said), "{ended:?}");
            assert_eq!(ended.ended(2), "", "{command:?}");
        }
    }
    // There is no file at the default path.
    assert!(run(&["inspect"]).stderr.contains("there is no file"));
    run(&["history"]).ended(1);
    run(&["history", "--checkpoint", whole]).ended(0);

    let text = run(&["verify", &damaged]).ended(1);
    assert!(
        text.contains("damaged at byte") && text.contains("records 2 to 2 are lost"),
        "{text}"
    );
    let json = run(&["verify", &damaged, "--json"]).json(1);
    assert_eq!(
        (&json["whole"], &json["exact"], &json["records"]),
        (&false.into(), &false.into(), &1.into())
    );
    let used = run(&["params", &damaged, "--damaged"]).ended(0);
    assert_eq!(used, "\"one\": 1\n\"three\": 2");

    // An incomplete append is normal.
    let torn = make("torn.yaml", &bytes[..end - 3]);
    let text = run(&["verify", &torn]).ended(0);
    assert!(
        text.contains("is whole") && text.contains("cut short") && text.contains("normal"),
        "{text}"
    );
    assert_eq!(run(&["params", &torn]).ended(0), "\"one\": 1\n\"two\": 2");
}

/// Names come from the network and may contain control characters.
#[test]
fn control_characters_in_names_are_not_printed() {
    let robot = Robot::start_with(Mode::Core, &["--no-rosout"]);
    robot.client().set_param("/red\u{9b}31m", 1);
    let path = robot.rescue.checkpoint();
    eventually("the parameter is in the file", || {
        fs::read_to_string(&path).unwrap().contains("31m")
    });
    let text = Tool::rosrescue(&robot.scratch, robot.port(), &["inspect"]).ended(0);
    assert!(text.contains("31m") && !text.contains('\u{9b}'));
    // In JSON the name is unchanged.
    let api = "http://127.0.0.1:9/";
    let call = params!["/node\u{9b}\u{202e}", "/topic", "std_msgs/String", api];
    robot.client().ok("registerPublisher", call);
    let name = "/node\\u009b\\u202e";
    for command in [
        &["inspect", "--json"][..],
        &["top", "--count", "1", "--json"],
    ] {
        let json = Tool::rosrescue(&robot.scratch, robot.port(), command).ended(0);
        assert!(
            json.contains(name) && !json.contains(['\u{9b}', '\u{202e}']),
            "{json}"
        );
    }
}
