//! A master whose dictionaries have no order, as on Python 2. A different order is no divergence, and answers in which
//! the order is visible come from the master. While it is away, the mirror refuses the calls that Python 2 refuses.

use std::time::Duration;

use ros1_master::xmlrpc::{Reply, Value};

use crate::support::{
    Client, FakeNode, Mode, NODES, Netns, Robot, Scratch, Setup, encode_call, eventually,
    free_port, holds, http_request, params, status, tree,
};

#[test]
fn the_order_of_dictionaries_is_no_divergence() {
    // A late probe on a busy computer must not count as a difference.
    let patient = ["--probe-timeout", "30000"];
    let options = [&patient, &["--resync-interval", "0.2"][..]].concat();
    let mut robot = Robot::start_under_with(Mode::Proxy, "unordered_rosmaster.py", &[], &options);
    let client = robot.client();
    let nodes = ["/zoe", "/ada", "/mel"].map(FakeNode::start);
    for (number, node) in nodes.iter().enumerate() {
        let topic = format!("{}/topic", node.name);
        node.publish(&client, &topic, "a/B");
        nodes[0].subscribe(&client, &topic, "a/B");
        node.offer(&client, &format!("{}/service", node.name));
        let plugins = vec![tree! { "type" => "x/Y", "name" => "y" }];
        let inner = tree! {
            "z" => 1, "a" => 2, "m" => tree! { "y" => 1, "b" => 2, "k" => 3 }, "plugins" => plugins
        };
        client.set_param(&format!("/tree{number}"), inner);
    }
    nodes[1].watch_param(&client, "/tree1");
    assert_exact(&robot);
    for _ in 0..2 {
        robot.crash_master();
    }
    assert_eq!(robot.bare().param("/tree2/m/k"), Some(Value::Int(3)));
    assert_exact(&robot);
    // The state is read several times, and each time a difference could be reported.
    assert!(holds(Duration::from_secs(2), || robot.is_open()));
    assert_exact(&robot);
    assert_eq!(robot.counter("divergences"), 0);
    for line in robot.rescue.output() {
        let is_difference = line.contains("differ") || line.contains("something else");
        assert!(!is_difference, "{line}");
    }
}

/// The texts were measured with rosmaster 1.13.5 on Python 2.7.15. `tests/field/odd.py` compares many more.
#[test]
fn while_a_master_on_python_2_is_away_the_mirror_refuses_what_it_would_refuse() {
    let options = ["--hold", "1"];
    let mut robot = Robot::start_under_with(Mode::Proxy, "unordered_rosmaster.py", &[], &options);
    let client = robot.client();
    client.set_param("/value", 1);
    robot.take_master_away();
    let answer = |value: &str| {
        let call = encode_call("setParam", params!["/n", "/value", "VALUE"]);
        let text = String::from_utf8(call).unwrap().replace("VALUE", value);
        let answer = client.exchange(&http_request(text.as_bytes())).unwrap();
        match answer.reply() {
            Reply::Fault { text, .. } => text,
            Reply::Value(value) => value.as_array().unwrap()[1].as_str().unwrap().to_owned(),
        }
    };
    for (value, refusal) in [
        (
            "<i1>2</i1>",
            "<class 'xmlrpclib.ResponseError'>:ResponseError(\"unknown tag u'i1'\",)",
        ),
        (
            "<ex:int>2</ex:int>",
            "<class 'xmlrpclib.ResponseError'>:ResponseError(\"unknown tag u'ex:int'\",)",
        ),
        ("</value><value>2", "Error: bad call arity"),
        (
            "<int>1_0</int>",
            "<type 'exceptions.ValueError'>:invalid literal for int() with base 10: '1_0'",
        ),
        (
            "<boolean>2</boolean>",
            "<type 'exceptions.TypeError'>:bad boolean value",
        ),
        (
            "&nbsp;",
            "<class 'xml.parsers.expat.ExpatError'>:undefined entity: line 1, column 156",
        ),
    ] {
        assert_eq!(answer(value), refusal, "{value}");
        assert_eq!(client.param("/value"), Some(Value::Int(1)), "{value}");
    }
    assert_eq!(answer("<i8>5</i8>"), "parameter /value set");
    robot.revive_master();
    robot.await_gate();
    assert_eq!(robot.bare().param("/value"), Some(Value::Int(5)));
}

/// Python 2 does not know prefixes of names, so it reads this call as `shutdown`, and Python 3 as `getPid`.
#[test]
fn no_other_computer_can_hide_a_shutdown_from_rosrescue_before_python_2() {
    let net = Netns::new();
    let scratch = Scratch::new();
    let program = format!("{NODES}/unordered_rosmaster.py");
    let setup = Setup::core(&scratch, free_port()).args(["--rosmaster", &program]);
    let rescue = setup.env("ROS_IP", net.near()).start();
    let here = rescue.client();
    eventually("calls pass to the master", || status(&here)["open"] == true);
    let elsewhere = Client::at(&net.near(), rescue.port());
    let call = encode_call("shutdown", params!["/evil", "because"]);
    let hidden = String::from_utf8(call).unwrap().replace(
        "</methodName>",
        "</methodName><x:methodName>getPid</x:methodName>",
    );
    let answer = elsewhere
        .exchange(&http_request(hidden.as_bytes()))
        .unwrap();
    assert!(answer.text().contains("own computer"), "{}", answer.text());
}

/// Checks that reads are answered with the master's own bytes.
fn assert_exact(robot: &Robot) {
    for (method, params) in [
        ("getSystemState", params!["/n"]),
        ("getTopicTypes", params!["/n"]),
        ("getPublishedTopics", params!["/n", ""]),
        ("getParamNames", params!["/n"]),
        ("getParam", params!["/n", "/"]),
        ("getParam", params!["/n", "/tree1/m"]),
        ("getParam", params!["/n", "/tree1/m/k"]),
        ("lookupNode", params!["/n", "/ada"]),
    ] {
        let request = http_request(&encode_call(method, params));
        let answer = |client: Client| client.exchange(&request).unwrap().text();
        // On a busy computer the mirror may answer once for a late master.
        eventually(&format!("{method} has the master's bytes"), || {
            answer(robot.client()) == answer(robot.bare())
        });
    }
}
