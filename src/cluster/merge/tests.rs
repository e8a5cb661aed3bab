//! What wins after two sides were apart.

use proptest::{collection::vec, prelude::*};

use super::{Conflict, Merged, merge};
use crate::{
    master::{Master, Method, Notice, Request},
    xmlrpc::Value,
};

fn call(method: Method, params: &[&str]) -> Request {
    Request::new(method, params.iter().copied())
}

fn set(key: &str, value: &str) -> Request {
    call(Method::SetParam, &["/n", key, value])
}

fn publish(node: &str, topic: &str, api: &str) -> Request {
    call(Method::RegisterPublisher, &[node, topic, "a/B", api])
}

fn state(of: &Master, calls: &[Request]) -> Master {
    let mut master = of.clone();
    for call in calls {
        master.apply_telling(call, &mut ());
    }
    master
}

/// What becomes of `here`, when both sides began with `base` and the other one has run `there`.
fn after(base: &[Request], there: &[Request], here: &[Request]) -> Merged {
    let base = state(&Master::default(), base);
    merge(&base, &state(&base, there), here)
}

fn lost(base: &[Request], there: &[Request], here: Request) -> Option<Conflict> {
    let mut merged = after(base, there, &[here]);
    merged.lost.pop().map(|lost| lost.why)
}

#[test]
fn a_write_that_had_reached_the_others_before_is_no_change_of_theirs() {
    let here = [set("/a", "1"), set("/a", "2"), set("/b", "1")];
    let there = [set("/a", "1"), set("/b", "9")];
    let merged = after(&[], &there, &here);
    assert_eq!(merged.send, here[..2]);
    assert_eq!(merged.lost[0].why, Conflict::Parameter("/b".to_owned()));
}

#[test]
fn a_parameter_that_was_changed_wins_with_all_below_and_above_it() {
    let parameter = |key: &str| Some(Conflict::Parameter(key.to_owned()));
    let base = [set("/a/b", "1"), set("/c", "1")];
    assert_eq!(
        lost(&base, &[set("/a/b", "2")], set("/a/b", "3")),
        parameter("/a/b")
    );
    assert_eq!(
        lost(&base, &[set("/a/x", "2")], set("/a", "3")),
        parameter("/a")
    );
    assert_eq!(
        lost(&base, &[set("/a", "2")], set("/a/b", "3")),
        parameter("/a/b")
    );
    assert_eq!(
        lost(&base, &[set("/new", "2")], set("/new/b", "3")),
        parameter("/new/b")
    );
    let delete = call(Method::DeleteParam, &["/n", "/a/b"]);
    assert_eq!(
        lost(&base, std::slice::from_ref(&delete), set("/a/b", "3")),
        parameter("/a/b")
    );
    assert_eq!(
        lost(&base, &[set("/a/b", "2")], delete.clone()),
        parameter("/a/b")
    );
    // Beside it.
    assert_eq!(
        lost(&base, &[set("/a/x", "2"), set("/c", "2")], set("/a/b", "3")),
        None
    );
    assert_eq!(lost(&base, &[set("/new/x", "2")], set("/new/b", "3")), None);
    assert_eq!(lost(&base, &[], delete), None);
    // A name is relative to its caller.
    let private = call(Method::SetParam, &["/a", "~b", "3"]);
    assert_eq!(lost(&base, &[set("/a/b", "2")], private), parameter("/a/b"));
}

#[test]
fn a_name_that_another_node_has_taken_is_not_taken_back() {
    let base = [publish("/n", "/t", "http://old:1/")];
    let there = [publish("/n", "/t", "http://there:1/")];
    let taken = lost(&base, &there, publish("/n", "/u", "http://here:1/"));
    let api = "http://there:1/".to_owned();
    let name = "/n".to_owned();
    assert_eq!(taken, Some(Conflict::Node { name, api }));
    // The health check over there has removed what could not be reached.
    let gone = call(Method::UnregisterPublisher, &["/n", "/t", "http://old:1/"]);
    assert_eq!(
        lost(&base, &[gone], publish("/n", "/t", "http://old:1/")),
        None
    );
    // The node was started anew, here.
    assert_eq!(
        lost(&base, &[], publish("/n", "/t", "http://here:1/")),
        None
    );
}

#[test]
fn a_service_of_another_node_stays() {
    let service =
        |node: &str, api: &str| call(Method::RegisterService, &[node, "/s", api, "http://n:1/"]);
    let there = [service("/there", "rosrpc://there:1")];
    let taken = lost(&[], &there, service("/here", "rosrpc://here:1"));
    let (name, node) = ("/s".to_owned(), "/there".to_owned());
    assert_eq!(taken, Some(Conflict::Service { name, node }));
    let base = [service("/old", "rosrpc://old:1")];
    assert_eq!(lost(&base, &[], service("/here", "rosrpc://here:1")), None);
}

#[test]
fn what_a_node_has_registered_anew_stays() {
    let gone = call(Method::UnregisterPublisher, &["/n", "/t", "http://n:1/"]);
    let there = [publish("/n", "/t", "http://n:1/")];
    assert!(lost(&[], &there, gone.clone()).is_some());
    assert_eq!(lost(&there, &[], gone), None);
}

#[test]
fn the_entries_of_a_multicall_are_judged_one_by_one() {
    let both = Request::multicall([set("/a", "here"), set("/b", "here")]);
    let merged = after(&[], &[set("/a", "there")], &[both]);
    assert_eq!(merged.send, [set("/b", "here")]);
    assert_eq!(merged.lost[0].call, set("/a", "here"));
    assert_eq!(
        merged.lost[0].why.to_string(),
        "the parameter `/a` was changed meanwhile"
    );
}

fn any_call(side: &'static str) -> impl Strategy<Value = Request> {
    let key = prop_oneof![
        Just("/a"),
        Just("/a/b"),
        Just("/a/b/c"),
        Just("/d"),
        Just("/")
    ];
    let value = prop_oneof![
        (0..9).prop_map(Value::Int),
        (0..9).prop_map(|number| Value::Struct(
            [("b".to_owned(), Value::Int(number))].into_iter().collect()
        )),
    ];
    let node = (0..3).prop_map(|node| format!("/n{node}"));
    let topic = (0..3).prop_map(|topic| format!("/t{topic}"));
    // Some nodes run where both sides see them.
    let api = (0..2, 0..3).prop_map(move |(own, port)| match own {
        0 => format!("http://{side}:{port}/"),
        _ => format!("http://both:{port}/"),
    });
    prop_oneof![
        (key.clone(), value).prop_map(|(key, value)| Request::new(
            Method::SetParam,
            ["/n".into(), key.into(), value]
        )),
        key.prop_map(|key| call(Method::DeleteParam, &["/n", key])),
        (node.clone(), topic.clone(), api.clone())
            .prop_map(|(node, topic, api)| publish(&node, &topic, &api)),
        (node.clone(), topic.clone(), api.clone()).prop_map(|(node, topic, api)| call(
            Method::UnregisterPublisher,
            &[&node, &topic, &api]
        )),
        (node, topic, api).prop_map(|(node, service, api)| call(
            Method::RegisterService,
            &[&node, &service, &api.replace("http", "rosrpc"), &api]
        )),
    ]
}

proptest! {
    #[test]
    fn each_write_is_sent_or_reported_and_what_others_changed_stays(
        base in vec(any_call("before"), 0..8),
        there in vec(any_call("there"), 0..8),
        here in vec(any_call("here"), 0..8),
    ) {
        let base = state(&Master::default(), &base);
        let now = state(&base, &there);
        let merged = merge(&base, &now, &here);
        prop_assert_eq!(merged.send.len() + merged.lost.len(), here.len());
        let mut after = now.clone();
        for call in &merged.send {
            let mut notices: Vec<Notice> = Vec::new();
            after.apply_telling(call, &mut notices);
            for notice in notices {
                if let Notice::Shutdown { to, .. } = notice {
                    // Who registered over there, and had not before, lives.
                    prop_assert!(!to.starts_with("http://there"), "{} is shut down", to);
                }
            }
        }
        let changed = |key: &str| {
            let path: Vec<_> = key.split('/').filter(|part| !part.is_empty()).collect();
            super::is_changed(base.params(), now.params(), &path)
        };
        for key in ["/a/b/c", "/d"] {
            let value = |of: &Master| of.params.get(key);
            // What equals a write of this side is none of theirs.
            let is_ours = here.iter().any(|call| {
                let (Some(of), Some(value)) = (call.text(1), call.params().get(2)) else {
                    return false;
                };
                let path: Vec<_> = of.split('/').filter(|part| !part.is_empty()).collect();
                let related = format!("{key}/").starts_with(&format!("{}/", of.trim_end_matches('/')))
                    || of.starts_with(key);
                *call.method() == Method::SetParam
                    && related
                    && super::value_at(now.params(), &path) == Some(value)
            });
            if changed(key) && !is_ours {
                prop_assert_eq!(value(&after), value(&now), "{}", key);
            }
        }
        for (node, api) in now.nodes().filter(|(_, api)| api.starts_with("http://there")) {
            prop_assert_eq!(after.api_of(node), Some(api));
        }
    }
}
