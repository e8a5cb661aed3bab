//! Tests of the parameter server's special cases.

use super::*;
use ros1_master::xmlrpc::Python;

#[test]
fn a_value_in_the_way_becomes_a_namespace_and_empty_namespaces_stay() {
    let mut master = after([set("/a", 1), set("/a/b/c", 2)]);
    master.apply(&call("deleteParam", &["/n", "/a/b/c"]));
    let names = answer(&mut master, &call("getParamNames", &["/n"])).2;
    assert_eq!(names, Value::Array(vec![]));
    let (code, _, value) = answer(&mut master, &call("getParam", &["/n", "/a"]));
    assert_eq!((code, value), (1, tree([("b", tree([]))])));
}

/// A caller without a leading slash has private keys without one. Reads do not find them, but deletions do.
#[test]
fn deleting_a_private_key_of_a_caller_without_a_slash_is_a_change() {
    let mut master = after([call("setParam", &["plain", "~p", "/a"])]);
    let delete = call("deleteParam", &["plain", "~p"]);
    assert!(master.would_change(&delete));
    assert_eq!(message(&mut master, &delete).0, 1);
    assert!(!master.would_change(&delete));
}

/// A read of `a/k` finds `/k`, but a write of it changes `/a/k`.
#[test]
fn setting_a_key_of_a_caller_without_a_slash_is_a_change_although_a_read_finds_the_value() {
    let mut master = after([set("/k", 1)]);
    let params = [Value::from("a/n"), "k".into(), 1.into()];
    let set = Request::new(Method::SetParam, params);
    assert!(master.would_change(&set));
    master.apply(&set);
    assert!(!master.would_change(&set));
}

#[test]
fn deleting_a_key_below_a_value_changes_nothing() {
    let texts = |texts: [&str; 2]| Value::from(texts.to_vec());
    for (value, is_absent) in [
        (1.into(), false),
        ("axb".into(), false),
        ("ab".into(), true),
        (texts(["x", "y"]), false),
        (texts(["xx", "y"]), true),
    ] {
        let mut master = after([set("/k", value)]);
        let before = master.clone();
        let (code, text) = message(&mut master, &call("deleteParam", &["/n", "/k/x"]));
        assert_eq!(code, -1);
        assert_eq!(text == "parameter [/k/x] is not set", is_absent, "{text}");
        assert_eq!(master, before);
    }
}

#[test]
fn reading_a_relative_key_forgets_its_first_part() {
    // The key is `a/k`, without a leading slash. Only a caller id without a leading slash resolves to such a key.
    let mut master = Master::default();
    master.apply(&Request::new(
        Method::SetParam,
        [Value::from("a/n"), "k".into(), 1.into()],
    ));
    assert_eq!(
        message(&mut master, &call("getParam", &["/n", "/a/k"])).0,
        1
    );
    assert_eq!(message(&mut master, &call("getParam", &["a/n", "k"])).0, -1);
    master.apply(&set("/k", 1));
    assert_eq!(message(&mut master, &call("getParam", &["a/n", "k"])).0, 1);
}

#[test]
fn search_param_requires_only_the_first_part_of_the_key() {
    let mut master = after([set("/pr2/robot/base", 1), set("/robot/arm", 1)]);
    let mut search =
        |caller: &str, key: &str| answer(&mut master, &call("searchParam", &[caller, key]));
    assert_eq!(
        search("/pr2/n", "robot/arm").2,
        Value::from("/pr2/robot/arm")
    );
    assert_eq!(search("/n", "robot/arm").2, Value::from("/robot/arm"));
    assert_eq!(search("/n", "nothing").0, -1);
    assert_eq!(search("/n", "~robot").0, 0);
    assert_eq!(search("n", "robot").0, 0);
    assert_eq!(search("/n", "/robot//arm/").2, Value::from("/robot//arm/"));
}

#[test]
fn param_updates_go_to_subscribers_above_below_and_at_the_key() {
    let mut master = after([
        watch("/root", "/"),
        watch("/exact", "/a"),
        watch("/set", "/a"),
        watch("/leaf", "/a/b"),
        watch("/gone", "/a/c"),
        watch("/other", "/ab"),
    ]);
    let value = tree([("b", 2.into())]);
    let told = notices(&mut master, &set("/a", value.clone()));
    let update = |node: &str, key: &str, value: &Value| Notice::ParamUpdate {
        to: api(node),
        key: key.to_owned(),
        value: value.clone(),
    };
    // `/set` made the change and is left out. The root and the exact keys come first.
    assert_eq!(
        told,
        [
            update("/root", "/a/", &value),
            update("/exact", "/a/", &value),
            update("/gone", "/a/c/", &tree([])),
            update("/leaf", "/a/b/", &2.into()),
        ]
    );
    // Setting a scalar above a subscribed key notifies no subscriber below it.
    assert_eq!(notices(&mut master, &set("/a", 1)).len(), 2);
    let told = notices(&mut master, &call("deleteParam", &["/set", "/a"]));
    assert_eq!(told.len(), 5);
}

#[test]
fn an_unreturnable_value_makes_the_namespaces_above_it_unreadable() {
    let mut master = after([
        set("/a", vec![Value::Nil]),
        set("/b", Value::BigInt("-5000000000".into())),
    ]);
    for key in ["/a", "/b", "/"] {
        let reply = master.apply(&call("getParam", &["/n", key])).reply;
        assert!(matches!(reply, Reply::Fault { .. }), "{key}: {reply:?}");
    }
}

#[test]
fn a_multicall_returns_a_namespace_as_it_is_after_the_last_entry() {
    let mut master = after([set("/a", tree([("x", 1.into())]))]);
    let get = call("getParam", &["/n", "/a"]);
    let calls = [
        get.clone(),
        set("/a/y", 2),
        get.clone(),
        set("/a", tree([("z", 3.into())])),
        get,
    ];
    let Reply::Value(Value::Array(results)) = master.apply(&Request::multicall(calls)).reply else {
        panic!("no results")
    };
    let value = |index: usize| match results[index].as_array() {
        Some([Value::Array(answer)]) => answer[2].clone(),
        _ => panic!("no answer"),
    };
    let first = tree([("x", 1.into()), ("y", 2.into())]);
    assert_eq!((value(0), value(2)), (first.clone(), first));
    assert_eq!(value(4), tree([("z", 3.into())]));
}

#[test]
fn no_key_or_value_makes_the_tree_too_deep_for_the_stack() {
    let deep = (0..511).fold(Value::Int(1), |value, _| Value::Array(vec![value]));
    let long = "/a".repeat(100_000);
    let mut master = after([
        set(&long, 1),
        set(&"/b".repeat(300), deep.clone()),
        set("/c", deep),
    ]);
    for (key, there) in [(&long[..1000], true), (&long[..2000], false)] {
        let has = answer(&mut master, &call("hasParam", &["/n", key])).2;
        assert_eq!(has, Value::Bool(there), "{}", key.len());
    }
    let copy = master.clone();
    assert_eq!(copy, master);
    assert!(matches!(
        master.apply(&call("getParam", &["/n", "/"])).reply,
        Reply::Fault { .. }
    ));
    assert_eq!(
        message(&mut master, &call("deleteParam", &["/n", "/a"])).0,
        1
    );
}

/// rosgraph's `ns_join` does not join a name that starts with a slash to the namespace above it.
#[test]
fn member_names_that_start_with_a_slash_may_have_any_characters() {
    for name in ["/€", "~€", "/", "/€/€"] {
        let members = tree([(name, tree([("€", 1.into())])), ("b", 2.into())]);
        let mut master = Master::default();
        master.apply(&call("subscribeParam", &["/n", "http://n:1/", "/a/b"]));
        let reply = master.apply(&set("/a", members)).reply;
        let (code, _, value) = answer(&mut master, &call("getParam", &["/n", "/a/b"]));
        assert_eq!((code, value), (1, 2.into()), "{name}: {reply:?}");
    }
}

/// Measured with rosmaster 1.11.16 on Python 2.7.11. The member `b` hides the one in which rosmaster then searches `c`.
#[test]
fn python_2_has_another_error_for_a_member_of_a_date_or_of_binary_data() {
    for (value, python_2) in [
        (Value::Base64(vec![1]), 0),
        (Value::DateTime("x".to_owned()), 0),
        (1.into(), -1),
        ("c".into(), -1),
    ] {
        let members = tree([("b/c", 1.into()), ("b", value)]);
        for (python, code) in [(Python::new(2, 7, 11), python_2), (Python::default(), -1)] {
            let mut master = Master::default();
            master.set_python(python);
            master.apply(&call("subscribeParam", &["/n", "http://n:1/", "/a/b/c"]));
            let refusal = message(&mut master, &set("/a", members.clone()));
            assert_eq!(refusal.0, code, "{refusal:?} on {python:?}");
        }
    }
}
