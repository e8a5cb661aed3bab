//! One test for each surprising behaviour of rosmaster.

use super::*;

#[test]
fn checks_refuse_in_rosmasters_words_and_order() {
    let mut master = Master::default();
    for (call, text) in [
        (call("getPid", &[]), "missing required caller_id parameter"),
        (call("getPid", &["/n", "x"]), "Error: bad call arity"),
        (
            Request::new(Method::GetPid, [Value::from(1)]),
            "caller_id must be a string",
        ),
        (
            call("getParam", &["/n", ""]),
            "ERROR: parameter [key] must be specified and non-empty",
        ),
        (
            Request::new(Method::GetParam, [Value::from("/n"), 1.into()]),
            "ERROR: parameter [key] must be a string",
        ),
        (
            publish("/n", "", "a/B"),
            "ERROR: parameter [topic] must be a non-empty string",
        ),
        (
            publish("/n", "a b", "a/B"),
            "ERROR: parameter [topic] contains illegal chars",
        ),
        (
            publish("/n", "/", "a/B"),
            "ERROR: parameter [topic] cannot be the global namespace",
        ),
        (
            publish("/n", "t", ""),
            "ERROR: parameter [topic_type] must be a non-empty string",
        ),
        (
            publish("/n", "t", "a/b/C"),
            "ERROR: parameter [topic_type] is not a valid package resource name",
        ),
        (
            call("registerPublisher", &["/n", "t", "a/B", ""]),
            "ERROR: parameter [caller_api] is not an XMLRPC URI",
        ),
        (
            call("registerPublisher", &["/n", "t", "a/B", "https://h"]),
            "ERROR: parameter [caller_api] is not an RPC URI",
        ),
        (
            call("registerPublisher", &["/n", "/", "x", "x"]),
            "ERROR: parameter [topic] cannot be the global namespace",
        ),
        (
            set("/a", Value::Nil),
            "ERROR: parameter [value] must be specified",
        ),
    ] {
        assert_eq!(
            message(&mut master, &call),
            (-1, text.to_owned()),
            "{call:?}"
        );
    }
    assert!(master.is_empty());
}

#[test]
fn a_refusal_returns_the_error_value_of_its_method() {
    let mut master = Master::default();
    let mut value = |method: &str| answer(&mut master, &call(method, &[])).2;
    assert_eq!(value("getPid"), Value::Int(-1));
    assert_eq!(value("getUri"), Value::from(""));
    assert_eq!(value("hasParam"), Value::Bool(false));
    assert_eq!(value("registerPublisher"), Value::Array(vec![]));
    assert_eq!(
        value("getSystemState"),
        vec![Value::Array(vec![]); 3].into()
    );
}

#[test]
fn a_node_at_another_address_displaces_the_old_one_without_telling_subscribers() {
    let mut master = after([
        publish("/n", "/t", "a/B"),
        subscribe("/n", "/u", "a/B"),
        provide("/n", "/s"),
        watch("/n", "/p"),
        subscribe("/listener", "/t", "a/B"),
    ]);
    let again = call("subscribeParam", &["/n", "http://new", "/q"]);
    let shutdown = Notice::Shutdown {
        to: api("/n"),
        reason: "[/n] Reason: new node registered with same name".to_owned(),
    };
    assert_eq!(notices(&mut master, &again), [shutdown]);
    let counts = master.counts();
    assert_eq!((counts.publishers, counts.subscribers), (0, 1));
    assert_eq!((counts.services, counts.param_subscribers), (0, 1));
    assert_eq!(master.type_of("/t"), Some("a/B"));
}

#[test]
fn a_node_whose_service_was_taken_over_stays_known_forever() {
    let mut master = after([provide("/a", "/s"), provide("/b", "/s")]);
    assert_eq!(
        message(
            &mut master,
            &call("unregisterService", &["/a", "/s", "rosrpc://h/a"])
        )
        .1,
        "[rosrpc://h/a] is no longer the current service api handle for [/s]"
    );
    master.apply(&call("unregisterService", &["/b", "/s", "rosrpc://h/b"]));
    assert_eq!(master.api_of("/b"), None);
    assert_eq!(master.api_of("/a"), Some("http://h/a"));
    let nodes = master.snapshot().nodes;
    assert_eq!(nodes.get("/a").unwrap().taken_over_services, ["/s"]);
}

#[test]
fn a_service_keeps_its_place_in_the_list_when_another_node_takes_it_over() {
    let master = after([
        provide("/a", "/s"),
        provide("/a", "/r"),
        provide("/b", "/s"),
    ]);
    assert!(master.registry().services.keys().eq(["/s", "/r"]));
}

#[test]
fn unregister_service_has_another_message_if_there_never_was_a_service() {
    let mut master = after([publish("/n", "/t", "a/B")]);
    let unregister = call("unregisterService", &["/n", "/s", "rosrpc://h"]);
    assert_eq!(
        message(&mut master, &unregister).1,
        "[/n] is not a provider of [/s]"
    );
    master.apply(&provide("/m", "/s"));
    assert_eq!(
        message(&mut master, &unregister).1,
        "[rosrpc://h] is no longer the current service api handle for [/s]"
    );
}

#[test]
fn topic_types_outlive_topics_and_only_publishers_change_them() {
    let mut master = after([subscribe("/s", "/t", "*")]);
    assert_eq!(master.type_of("/t"), None);
    master.apply(&publish("/p", "/t", "*"));
    assert_eq!(master.type_of("/t"), Some("*"));
    master.apply(&subscribe("/s", "/t", "a/B"));
    assert_eq!(master.type_of("/t"), Some("*"));
    master.apply(&publish("/p", "/t", "a/B"));
    master.apply(&publish("/p", "/t", "*"));
    assert_eq!(master.type_of("/t"), Some("a/B"));
    for call in master
        .unregister_calls("/p")
        .iter()
        .chain(&master.unregister_calls("/s"))
    {
        master.apply(call);
    }
    assert_eq!(master.counts().nodes, 0);
    assert_eq!(master.type_of("/t"), Some("a/B"));
}

#[test]
fn subscribers_are_notified_of_every_registration_but_only_of_effective_unregistrations() {
    let mut master = after([subscribe("/s", "/t", "a/B")]);
    let told = |publishers: &[&str]| {
        [Notice::PublisherUpdate {
            to: api("/s"),
            topic: "/t".to_owned(),
            publishers: publishers.iter().map(|node| api(node)).collect(),
        }]
    };
    assert_eq!(
        notices(&mut master, &publish("/p", "/t", "a/B")),
        told(&["/p"])
    );
    assert_eq!(
        notices(&mut master, &publish("/p", "/t", "a/B")),
        told(&["/p"])
    );
    let other = call("unregisterPublisher", &["/p", "/t", "http://other"]);
    assert_eq!(notices(&mut master, &other), []);
    let real = call("unregisterPublisher", &["/p", "/t", &api("/p")]);
    assert_eq!(notices(&mut master, &real), told(&[]));
}

#[test]
fn a_malformed_entry_fails_the_whole_multicall_after_earlier_entries_have_run() {
    let mut master = Master::default();
    let list = vec![
        set("/a", 1).into_entry(),
        tree([("params", Value::Array(vec![]))]),
        set("/b", 1).into_entry(),
    ];
    let call = Call::new("system.multicall", vec![Value::Array(list)]);
    let reply = master.apply(&call.into()).reply;
    assert!(matches!(reply, Reply::Fault { .. }), "{reply:?}");
    assert_eq!(master.counts().params, 1);
}

#[test]
fn unknown_methods_are_answered_with_a_fault() {
    let mut master = Master::default();
    for method in ["nope", "uri", "param_update_task"] {
        let reply = master.apply(&call(method, &["/n"])).reply;
        assert!(matches!(reply, Reply::Fault { .. }), "{reply:?}");
    }
}

#[test]
fn a_snapshot_restores_the_whole_state_and_impossible_states_are_refused() {
    use ros1_master::master::InvalidSnapshot;
    let master = after([
        provide("/a", "/s"),
        provide("/b", "/s"),
        publish("/b", "/t", "a/B"),
        subscribe("/a", "/u", "*"),
        watch("/c", "/p"),
        set("/p", 1),
    ]);
    let snapshot = master.snapshot();
    assert_eq!(
        Master::from_snapshot(snapshot.clone()).as_ref(),
        Ok(&master)
    );
    let mut broken = snapshot.clone();
    broken.nodes.remove("/b");
    assert!(matches!(
        Master::from_snapshot(broken),
        Err(InvalidSnapshot::UnknownNode { caller_id, .. }) if caller_id == "/b"
    ));
    let mut broken = snapshot.clone();
    broken.topic_types = Default::default();
    let no_type = InvalidSnapshot::NoType {
        topic: "/t".to_owned(),
    };
    assert_eq!(Master::from_snapshot(broken), Err(no_type));
    let mut broken = snapshot;
    broken.param_subscribers = Default::default();
    let empty = InvalidSnapshot::EmptyNode {
        caller_id: "/c".to_owned(),
    };
    assert_eq!(Master::from_snapshot(broken), Err(empty));
}

#[test]
fn a_node_without_any_registration_is_forgotten() {
    let calls = [
        publish("/ns/n", "t", "a/B"),
        subscribe("/ns/n", "~u", "a/B"),
        provide("/ns/n", "//"),
        watch("/ns/n", "~"),
        watch("/ns/n", "/"),
    ];
    let mut master = after(calls);
    let unregister = master.unregister_calls("/ns/n");
    assert_eq!(unregister.len(), 5);
    for call in &unregister {
        assert_eq!(message(&mut master, call).0, 1);
    }
    assert_eq!(master.counts().nodes, 0);
    assert_eq!(master.unregister_calls("/nobody"), []);
}

/// An old rosmaster, such as 1.14.3, answers 0 in place of an empty list or name, and also notifies the node that sets
/// a parameter.
#[test]
fn an_old_rosmaster_refuses_and_notifies_differently() {
    let value = |old, call: &Request| {
        let mut master = Master::default();
        master.set_old(Some(old));
        match master.apply(call).reply {
            Reply::Value(Value::Array(mut answer)) => answer.pop(),
            other => panic!("{other:?}"),
        }
    };
    let empty = Value::Array(Vec::new());
    for (call, new) in [
        (publish("/n", "t", ""), empty.clone()),
        (
            call("registerSubscriber", &["/n", "t", "", "http://n"]),
            empty,
        ),
        (Master::ask_if_old(), "".into()),
    ] {
        assert_eq!(value(true, &call), Some(0.into()), "{call:?}");
        assert_eq!(value(false, &call), Some(new), "{call:?}");
    }
    for old in [None, Some(false), Some(true)] {
        let mut master = Master::default();
        master.set_old(old);
        assert_eq!(
            Master::shows_old(&master.apply(&Master::ask_if_old()).reply),
            Some(old == Some(true))
        );
        for node in ["/n", "/m"] {
            master.apply(&call("subscribeParam", &[node, &api(node), "/gain"]));
        }
        let notices = master
            .apply(&call("setParam", &["/n", "/gain", "2"]))
            .notices;
        let told: Vec<_> = notices.iter().map(Notice::to).collect();
        let own = api("/n");
        let first = (old == Some(true)).then_some(own.as_str());
        assert_eq!(
            told,
            first.into_iter().chain([&*api("/m")]).collect::<Vec<_>>()
        );
    }
    let fault = Reply::Fault {
        code: 1,
        text: String::new(),
    };
    assert_eq!(Master::shows_old(&fault), None);
}
