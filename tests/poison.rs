//! Values that a master takes and that spoil its answers, or that XML changes on their way: rosrescue
//! serves such a master, and knows what else it holds.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a test"
)]

mod support;

use rosrescue::xmlrpc::{Call, Reply, Value};
use support::{Rosmaster, Scratch, Setup, eventually, params, tree};

/// CPython writes a carriage return as it is, and whoever reads that as XML gets a line feed.
#[test]
fn carriage_returns_outlive_master_and_rosrescue() {
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

/// CPython does not escape a date's text, so that whatever holds this one is answered with no XML.
fn poison() -> Value {
    Value::DateTime("a<b & ]]>".to_owned())
}

/// Somebody's master that holds a date with markup, and a rosrescue that has never seen it.
#[test]
fn a_master_with_a_date_that_breaks_its_answers_is_taken_over() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let before = master.client();
    before.set_param("/good", 1);
    before.set_param("/ns/good", 2);
    before.set_param("/ns/bad", poison());
    before.set_param("/ns/fine", Value::DateTime("a&amp;b >".to_owned()));
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    rescue.client().set_param("/later", 3);
    // Once more, with the same master.
    rescue.kill();
    rescue.start_again();
    rescue.wait_serving();
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let after = master.client();
    eventually("the state is back", || after.param("/later").is_some());
    let names = params!["/good", "/ns/good", "/ns/fine", "/later"];
    assert_eq!(
        after.ok("getParamNames", params!["/n"]),
        Value::Array(names)
    );
    let date = Value::DateTime("a&amp;b >".to_owned());
    assert_eq!(
        after.param("/ns"),
        Some(tree! { "good" => 2, "fine" => date })
    );
}

/// As deep as rosmaster returns a value with the whole tree in a multicall, which is how it is brought
/// back and compared, it outlives the master; what is deeper is left out, by name.
#[test]
fn a_value_nested_as_deep_as_the_master_bears_outlives_it() {
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
        depth.expect("rosmaster bears 470 levels")
    });
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    for (wrap, (name, depth)) in wraps.iter().zip(["array", "struct"].iter().zip(deepest)) {
        client.set_param(&format!("/{name}"), nested(depth, *wrap));
        client.set_param(&format!("/deeper_{name}"), nested(depth + 1, *wrap));
    }
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let after = master.client();
    eventually("the state is back", || after.param("/struct").is_some());
    for (wrap, (name, depth)) in wraps.iter().zip(["array", "struct"].iter().zip(deepest)) {
        let found = after.param(&format!("/{name}"));
        assert!(found == Some(nested(depth, *wrap)), "{name} of {depth}");
    }
    for name in ["array", "struct"] {
        rescue.wait_line("what was left out", |line| {
            line.contains(&format!("the parameter `/deeper_{name}"))
        });
    }
}

/// What came through rosrescue itself is kept, and left out where it would spoil a new master.
#[test]
fn a_date_that_breaks_answers_is_left_out_of_an_injection() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let mut rescue = Setup::proxy(&scratch, master.port).start();
    let client = rescue.client();
    client.set_param("/bad", poison());
    client.set_param("/good", 1);
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let after = master.client();
    eventually("the state is back", || after.param("/good").is_some());
    assert_eq!(after.param("/"), Some(tree! { "good" => 1 }));
    rescue.wait_line("what was left out", |line| {
        line.contains("the parameter `/bad`")
    });
}

/// What somebody changes past rosrescue is seen, even while the master holds what it cannot return.
#[test]
fn a_resync_sees_what_can_be_read_beside_what_cannot() {
    let scratch = Scratch::new();
    let mut master = Rosmaster::start(&scratch);
    let setup = Setup::proxy(&scratch, master.port).args(["--resync-interval", "0.1"]);
    let mut rescue = setup.start();
    let client = rescue.client();
    let huge = || Value::BigInt("1099511627776".to_owned());
    client.set_param("/ns/huge", huge());
    client.set_param("/ns/old", 1);
    client.set_param("/ns/deleted", 2);
    let past = master.client();
    past.set_param("/ns/old", "another");
    past.set_param("/new", 3);
    past.ok("deleteParam", params!["/n", "/ns/deleted"]);
    rescue.wait_line("the new parameter", |line| line.contains("`/new`"));
    master.kill();
    let master = Rosmaster::start_at(&scratch, master.port);
    let after = master.client();
    eventually("the state is back", || after.param("/new").is_some());
    let expected = tree! { "ns" => tree! { "old" => "another" }, "new" => 3 };
    assert_eq!(after.param("/"), Some(expected));
    // It has not been forgotten: this is said each time.
    rescue.wait_line("what was left out", |line| {
        line.contains("the parameter `/ns/huge`")
    });
}

/// rosmaster takes a date for a type if it reads `*`, and gives it back as a date.
#[test]
fn a_type_that_is_a_date_does_not_hide_the_master() {
    let scratch = Scratch::new();
    let master = Rosmaster::start(&scratch);
    let star = Value::DateTime("*".to_owned());
    let api = "http://127.0.0.1:1/";
    let params = vec!["/p".into(), "/t".into(), star, api.into()];
    master.client().ok("registerPublisher", params);
    let rescue = Setup::proxy(&scratch, master.port).start();
    // The node is dead and soon gone, its type stays.
    let types = rescue.client().ok("getTopicTypes", params!["/n"]);
    assert_eq!(types.as_array().unwrap().len(), 1);
}
