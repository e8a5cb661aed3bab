//! Values that a master accepts and that break its answers, or that XML changes on the way. rosrescue serves such a
//! master, and knows the rest of its state.

use ros1_master::xmlrpc::{Call, Reply, Value};

use crate::support::{
    FakeNode, Mode, Robot, Rosmaster, Scratch, Setup, eventually, http_request, params, tree,
};

/// CPython writes a carriage return unescaped, which XML readers read as a line feed.
#[test]
fn carriage_returns_survive_the_death_of_master_and_rosrescue() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    master.client().set_param("/before", "a\r\nb\rc");
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    client.set_param("/through", "d\r\ne\rf");
    let api = "http://127.0.0.1:1/";
    client.ok("subscribeParam", params!["/n", api, "/through"]);
    let metrics = client.exchange(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let metrics = metrics.unwrap().text();
    assert!(
        metrics.contains("\nrosrescue_divergences_total 0\n"),
        "{metrics}"
    );
    rescue.kill();
    rescue.start_again();
    rescue.wait_serving();
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    eventually("the parameters are back", || {
        master.client().param("/before") == Some("a\r\nb\rc".into())
            && master.client().param("/through") == Some("d\r\ne\rf".into())
    });
}

/// A date that makes every answer with it invalid XML, because CPython does not escape its text.
fn broken_date() -> Value {
    Value::DateTime("a<b & ]]>".to_owned())
}

/// A value of the largest depth that rosmaster can return together with the whole tree, which is how the state is read,
/// survives the death of the master. Values that would break a new master are left out and named: a deeper one, and a
/// date.
#[test]
fn a_value_nested_as_deep_as_rosmaster_can_return_survives_its_death() {
    let in_array = |value| Value::Array(vec![value]);
    let in_struct = |value| tree! { "k" => value };
    let wraps: [fn(Value) -> Value; 2] = [in_array, in_struct];
    let nested = |depth: usize, wrap: fn(Value) -> Value| {
        (0..depth).fold(Value::from("leaf"), |value, _| wrap(value))
    };
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let bare = master.client();
    let deepest = wraps.map(|wrap| {
        let borne = |depth: &usize| {
            bare.set_param("/deep", nested(*depth, wrap));
            let tree = Call::multicall([Call::new("getParam", params!["/test", "/"])]);
            let reply = bare.call("system.multicall", tree.params).unwrap();
            matches!(reply, Reply::Value(_))
        };
        let depth = (470..520).take_while(borne).last();
        bare.ok("deleteParam", params!["/test", "/deep"]);
        depth.expect("rosmaster must be able to return 470 levels")
    });
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    for (wrap, (name, depth)) in wraps.iter().zip(["array", "struct"].iter().zip(deepest)) {
        client.set_param(&format!("/{name}"), nested(depth, *wrap));
        client.set_param(&format!("/deeper_{name}"), nested(depth + 1, *wrap));
    }
    client.set_param("/bad", broken_date());
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let after = master.client();
    eventually("the state is back", || after.param("/struct").is_some());
    // The master can return all of its parameters.
    assert!(matches!(after.param("/"), Some(Value::Struct(_))));
    assert_eq!(after.param("/bad"), None);
    for (wrap, (name, depth)) in wraps.iter().zip(["array", "struct"].iter().zip(deepest)) {
        let found = after.param(&format!("/{name}"));
        assert!(found == Some(nested(depth, *wrap)), "{name} of {depth}");
    }
    for name in ["/deeper_array", "/deeper_struct", "/bad"] {
        rescue.wait_line("the log names the parameter that was left out", |line| {
            line.contains(&format!("the parameter `{name}"))
        });
    }
}

/// While the master holds a value that it cannot return, its parameters cannot be read. rosrescue keeps those that it
/// knows, and reports this. The master also accepts a date as a type if its text is `*`, and returns it as a date.
#[test]
fn parameters_that_the_master_cannot_return_are_kept_as_known() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let star = Value::DateTime("*".to_owned());
    let api = "http://127.0.0.1:1/";
    let params = vec!["/p".into(), "/t".into(), star, api.into()];
    master.client().ok("registerPublisher", params);
    let setup = Setup::proxy(&scratch, master.port).args(["--resync-interval", "0.1"]);
    let mut rescue = setup.start();
    let client = rescue.client();
    // The node is dead and soon unregistered, but its type stays.
    let types = client.ok("getTopicTypes", params!["/n"]);
    assert_eq!(types.as_array().unwrap().len(), 1);
    client.set_param("/ns/huge", Value::BigInt("1099511627776".to_owned()));
    client.set_param("/ns/known", 1);
    rescue.wait_line("the log says that parameters cannot be read", |line| {
        line.contains("a parameter that it can never return")
    });
    let past = FakeNode::start("/past");
    past.publish(&master.client(), "/topic", "std_msgs/String");
    rescue.wait_line(
        "the log names the node that was read from the master",
        |line| line.contains("`/past`"),
    );
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let after = master.client();
    eventually("the state is back", || after.param("/ns/known").is_some());
    assert_eq!(
        after.param("/"),
        Some(tree! { "ns" => tree! { "known" => 1 } })
    );
    rescue.wait_line("the log names the parameter that was left out", |line| {
        line.contains("the parameter `/ns/huge`")
    });
}

/// rosmaster accepts unreadable parameters, rosrescue cannot decode them, and no client can read them.
#[test]
fn deleting_an_unreadable_parameter_causes_no_divergence() {
    let robot = Robot::start(Mode::Proxy);
    let (client, bare) = (robot.client(), robot.bare());
    let nil = "<array><data><value><nil/></value></data></array>";
    let numbered = "<struct><member><value><int>1</int></value><value>x</value></member></struct>";
    for (prolog, value) in [
        ("", "<bigdecimal>1.5e1</bigdecimal>"),
        ("<!DOCTYPE methodCall>", nil),
        ("<!DOCTYPE methodCall>", "<i8>99999999999</i8>"),
        // A dictionary with a number as a key.
        ("", numbered),
    ] {
        let document = format!(
            "{prolog}<methodCall><methodName>setParam</methodName><params><param><value>/n</value></param>\
             <param><value>/v</value></param><param><value>{value}</value></param></params></methodCall>"
        );
        client.exchange(&http_request(document.as_bytes())).unwrap();
        let reply = bare.call("getParam", params!["/n", "/v"]).unwrap();
        assert!(matches!(reply, Reply::Fault { .. }), "{value}: {reply:?}");
        client.set_param("/known", 1);
        client.ok("deleteParam", params!["/n", "/v"]);
        assert_eq!(robot.counter("divergences"), 0, "{value}");
        eventually("the parameters can be read again", || {
            client.param("/") == bare.param("/") && client.param("/known") == Some(1.into())
        });
        client.ok("deleteParam", params!["/n", "/known"]);
    }
}
