//! Tests which reads the model answers byte for byte as rosmaster does, and which it leaves to the master.

use super::*;
use ros1_master::xmlrpc::{MAX_DEPTH, Python};

fn master() -> Master {
    after([publish("/n", "/t", "a/B"), set("/a/b", 1)])
}

#[test]
fn an_exact_answer_equals_that_of_apply() {
    let mut master = master();
    let reads = [
        call("getParam", &["/c", "/a"]),
        call("getParam", &["/c", "/unset"]),
        call("searchParam", &["/c", "a"]),
        call("hasParam", &["/c", "/a/b"]),
        call("lookupNode", &["/c", "/n"]),
        call("lookupService", &["/c", "/none"]),
        call("getSystemState", &["/c"]),
        call("getTopicTypes", &["/c"]),
        call("getPid", &["/c"]),
    ];
    let together = Request::multicall([Request::multicall(reads.clone()), reads[0].clone()]);
    for read in reads.iter().chain([&together]) {
        let reply = master.apply(read).reply;
        assert_eq!(
            master.exact_answer(read).map(Reply::Value),
            Some(reply),
            "{read:?}"
        );
    }
}

#[test]
fn there_is_no_exact_answer_where_rosmasters_may_differ() {
    let mut master = master();
    let get = call("getParam", &["/c", "/a"]);
    let with = |other: Request| Request::multicall([get.clone(), other]);
    for other in [
        call("nonsense", &["/c"]),
        call("getParam", &["/c"]),
        call("getParam", &["/c", ""]),
        call("searchParam", &["c", "a"]),
        call("lookupNode", &["/c", "/somebody"]),
        call("setParam", &["/c", "/a", "1"]),
        call("shutdown", &["/c", "now"]),
    ] {
        assert_eq!(master.exact_answer(&other), None, "{other:?}");
        assert_eq!(master.exact_answer(&with(other)), None);
    }
    assert!(master.exact_answer(&with(get.clone())).is_some());
    assert_eq!(master.exact_answer(&malformed(with(get.clone()))), None);
}

#[test]
fn there_is_no_exact_answer_about_a_state_that_is_kept_differently() {
    let get = call("getParam", &["/c", "/a"]);
    let deep = "/x".repeat(513);
    let nested = (0..MAX_DEPTH / 3).fold(Value::Int(1), |inner, _| vec![inner].into());
    let star = Value::DateTime("*".to_owned());
    let typed = ["/n".into(), "/t".into(), star, api("/n").into()];
    for inexact in [
        set(&deep, 1),
        set(&format!("/a{}", "/x".repeat(500)), nested),
        Request::new(Method::RegisterPublisher, typed),
    ] {
        let mut master = master();
        assert!(master.exact_answer(&get).is_some());
        master.apply(&inexact);
        assert_eq!(master.exact_answer(&get), None);
    }
}

#[test]
fn there_is_no_exact_answer_that_shows_dictionary_order_for_a_master_without_one() {
    let tree = Value::Struct(Struct::from_iter([
        ("b".to_owned(), 1.into()),
        ("a".to_owned(), 2.into()),
    ]));
    let mut master = Master::default();
    master.apply(&Request::new(
        Method::SetParam,
        ["/n".into(), "/t".into(), tree],
    ));
    master.apply(&call("registerPublisher", &["/n", "/x", "a/B", &api("/n")]));
    master.set_python(Python::new(2, 7, 11));
    let state = call("getSystemState", &["/c"]);
    for exact in [&state, &call("getParam", &["/c", "/t/a"])] {
        assert!(master.exact_answer(exact).is_some(), "{exact:?}");
    }
    master.apply(&call("registerPublisher", &["/n", "/y", "a/B", &api("/n")]));
    for shown in [
        state,
        call("getTopicTypes", &["/c"]),
        call("getPublishedTopics", &["/c", ""]),
        call("getParamNames", &["/c"]),
        call("getParam", &["/c", "/t"]),
        call("getParam", &["/c", "/"]),
        Request::multicall([call("getParam", &["/c", "/t"])]),
    ] {
        assert_eq!(master.exact_answer(&shown), None, "{shown:?}");
    }
}
