use super::*;
use ros1_master::master::{Method, Request};

fn call(method: Method, params: &[&str]) -> Request {
    Request::new(method, params.iter().copied())
}

fn master(calls: &[Request]) -> Master {
    let mut master = Master::default();
    for call in calls {
        master.apply(call);
    }
    master
}

fn words(a: &Master, b: &Master) -> Vec<String> {
    let hide = crate::hide::DEFAULT.parse().unwrap();
    let differences = compare(a, b, &hide);
    differences
        .iter()
        .map(|difference| difference.text(["A", "B"]))
        .collect()
}

#[test]
fn every_difference_is_listed_once() {
    let publish =
        |node, topic, kind, api| call(Method::RegisterPublisher, &[node, topic, kind, api]);
    let serve = |node, api| call(Method::RegisterService, &[node, "/s", "rosrpc://h:1", api]);
    let watch = call(Method::SubscribeParam, &["/n", "http://n:1/", "/k"]);
    let a = master(&[
        publish("/n", "/t", "x/Y", "http://n:1/"),
        publish("/moved", "/m", "x/Y", "http://m:1/"),
        publish("/gone", "/only", "x/Y", "http://g:1/"),
        publish("/gone", "/too", "x/Y", "http://g:1/"),
        call(
            Method::RegisterSubscriber,
            &["/gone", "/t", "x/Y", "http://g:1/"],
        ),
        serve("/n", "http://n:1/"),
        watch,
    ]);
    let b = master(&[
        publish("/n", "/t", "x/Z", "http://n:1/"),
        publish("/moved", "/m", "x/Y", "http://m:2/"),
        serve("/moved", "http://m:2/"),
    ]);
    let found = words(&a, &b);
    let expected = [
        "node /gone at http://g:1/ only in A: publishes /only, /too; subscribes /t",
        "node /moved is at http://m:1/ in A and at http://m:2/ in B",
        "/n watches the parameter /k only in A",
        "service /s is provided by /n at rosrpc://h:1 in A and by /moved at rosrpc://h:1 in B",
        "topic /t has the type x/Y in A and x/Z in B",
    ];
    assert_eq!(found, expected);
    assert_eq!(words(&b, &a).len(), expected.len());
    assert_eq!(words(&a, &a), [""; 0]);
}

#[test]
fn parameters_are_compared_one_by_one_in_any_order() {
    let set = |key: &str, value: Value| {
        Request::new(Method::SetParam, [Value::from("/n"), key.into(), value])
    };
    let space = |members: &[(&str, i32)]| {
        let members = members
            .iter()
            .map(|(key, value)| ((*key).to_owned(), (*value).into()));
        Value::Struct(members.collect())
    };
    let a = master(&[
        set("/a", space(&[("x", 1), ("y", 2)])),
        set("/list", vec![space(&[("x", 1), ("y", 2)])].into()),
        set("/was", space(&[("x", 1)])),
        set("/password", 1.into()),
        set("/empty", space(&[])),
    ]);
    let b = master(&[
        set("/a", space(&[("y", 2), ("x", 1)])),
        set("/list", vec![space(&[("y", 2), ("x", 1)])].into()),
        set("/was", 1.0.into()),
        set("/password", 2.into()),
    ]);
    let expected = [
        "parameter /empty only in A: {}",
        "parameter /password: \"(hidden)\" -> \"(hidden)\"",
        "parameter /was: {\"x\": 1} -> 1.0",
    ];
    assert_eq!(words(&a, &b), expected);
}
