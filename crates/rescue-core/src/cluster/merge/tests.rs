//! Tests which writes hold after two sides were cut off from each other.

use proptest::{collection::vec, prelude::*};

mod model;

use super::{Changes, Conflict, Merged, WritesToSend, changes::param_path, merge};
use ros1_master::{
    master::{Master, Method, Notice, Request, is_success},
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

/// The state after `there` was run. Adds what was changed to `changes`, without refused calls, because no journal has
/// those.
fn changed(base: &Master, there: &[Request], changes: &mut Changes) -> Master {
    let mut master = base.clone();
    for (seq, call) in (1..).zip(there) {
        if is_success(&master.apply_telling(call, &mut ())) {
            changes.note(seq, call);
        }
    }
    master
}

/// The result of merging `here`, if both sides began with `base` and the other side has run `there`.
fn after(base: &[Request], there: &[Request], here: &[Request]) -> Merged {
    let base = state(&Master::default(), base);
    let mut changes = Changes::default();
    let now = changed(&base, there, &mut changes);
    let mut pending = WritesToSend::default();
    here.iter().for_each(|call| pending.add(call));
    merge(&changes, &now, pending.calls())
}

fn conflict_of(base: &[Request], there: &[Request], here: Request) -> Option<Conflict> {
    let mut merged = after(base, there, &[here]);
    merged.lost.pop().map(|lost| lost.why)
}

#[test]
fn the_others_win_although_they_have_written_what_was_written_here_before() {
    let here = [set("/estop", "true"), set("/estop", "false")];
    let merged = after(&[], &[set("/estop", "true")], &here);
    assert_eq!(merged.send, []);
    assert_eq!(merged.lost.len(), 1);
    assert_eq!(merged.lost[0].call, here[1]);
    assert_eq!(merged.lost[0].present, Some("true".into()));
}

#[test]
fn the_others_win_although_they_have_set_it_back() {
    let there = [set("/a", "2"), set("/a", "1")];
    let merged = after(&[set("/a", "1")], &there, &[set("/a", "7")]);
    assert_eq!(merged.send, []);
    assert_eq!(merged.lost[0].present, Some("1".into()));
}

#[test]
fn a_write_to_what_others_have_written_too_is_neither_sent_nor_lost() {
    // Nodes are notified again, because they may have heard this computer's value after a newer one of the others.
    let equal = Merged {
        equal: vec!["/a".to_owned()],
        ..Merged::default()
    };
    let merged = after(&[], &[set("/a", "1")], &[set("/a", "2"), set("/a", "1")]);
    assert_eq!(merged, equal);
    let delete = call(Method::DeleteParam, &["/n", "/a"]);
    let there = [delete.clone()];
    let merged = after(&[set("/a", "1")], &there, &[set("/a", "2"), delete]);
    assert_eq!(merged, equal);
}

#[test]
fn what_was_set_and_deleted_again_is_lost_once() {
    let delete = call(Method::DeleteParam, &["/n", "/a"]);
    let here = [set("/a/b", "1"), delete.clone()];
    let merged = after(&[], &[set("/a/b", "2")], &here);
    let lost: Vec<_> = merged.lost.into_iter().map(|lost| lost.call).collect();
    assert_eq!(lost, [delete]);
}

#[test]
fn a_call_of_this_computer_that_had_reached_the_others_is_no_change_of_theirs() {
    let base = Master::default();
    let (own, here) = (set("/a", "1"), set("/a", "2"));
    let judge = |there: &[Request], expect: &dyn Fn(&mut Changes)| {
        let mut changes = Changes::default();
        expect(&mut changes);
        let now = changed(&base, there, &mut changes);
        merge(&changes, &now, [&here]).send.len()
    };
    let sent = |changes: &mut Changes| changes.expect([own.clone()]);
    let recorded = |changes: &mut Changes| changes.expect_record(1, own.clone());
    let once = [own.clone()];
    assert_eq!(judge(&once, &|_| {}), 0);
    assert_eq!(judge(&once, &sent), 1);
    assert_eq!(judge(&once, &recorded), 1);
    // A call that was sent may be sent again after a lost answer. A record has its number once.
    let twice = [own.clone(), own.clone()];
    assert_eq!(judge(&twice, &sent), 1);
    assert_eq!(judge(&twice, &recorded), 0);
    assert_eq!(judge(&[set("/b", "1"), own.clone()], &recorded), 0);
}

#[test]
fn a_later_write_of_the_same_node_replaces_what_its_computer_had_forwarded() {
    let by = |node, key, value| call(Method::SetParam, &[node, key, value]);
    let forwarded = by("/there", "/a/b", "1");
    let judge = |there: &[Request], here: &Request| {
        let mut changes = Changes::default();
        changes.note_forwarded(&forwarded);
        let now = changed(&Master::default(), there, &mut changes);
        let merged = merge(&changes, &now, [here]);
        (merged.send.len(), merged.lost.len())
    };
    for later in [by("/there", "/a/b", "2"), by("/there", "/a", "2")] {
        assert_eq!(judge(std::slice::from_ref(&later), &forwarded), (0, 0));
        // It stays replaced, whatever others write before or after.
        assert_eq!(judge(&[by("/m", "/a", "3"), later], &forwarded), (0, 0));
    }
    // A write below replaces a part. A write of another node replaces nothing.
    let part = [by("/there", "/a/b/c", "2")];
    assert_eq!(judge(&part, &forwarded), (0, 1));
    assert_eq!(judge(&[by("/m", "/a/b", "2")], &forwarded), (0, 1));
    // A node of this computer with the same name, such as `/roslaunch`, is another one.
    let own = by("/there", "/a/b", "5");
    assert_eq!(judge(&[by("/there", "/a/b", "2")], &own), (0, 1));
}

#[test]
fn where_only_states_are_known_what_differs_was_changed() {
    let base = state(
        &Master::default(),
        &[set("/a/b", "1"), publish("/n", "/t", "http://n:1/")],
    );
    let there = [
        set("/a/c", "1"),
        set("/own", "1"),
        publish("/m", "/t", "http://m:1/"),
    ];
    let now = state(&base, &there);
    let mut changes = Changes::default();
    changes.expect([set("/own", "1")]);
    changes.note_difference(&base, &now);
    let sent = |call: Request| !merge(&changes, &now, [&call]).send.is_empty();
    assert!(sent(set("/a/b", "2")) && sent(set("/own", "2")) && sent(set("/d", "2")));
    assert!(!sent(set("/a/c", "2")) && !sent(set("/a", "2")));
    assert!(!sent(publish("/m", "/u", "http://here:1/")));
    assert!(sent(publish("/n", "/u", "http://here:1/")));
    assert!(!sent(call(
        Method::UnregisterPublisher,
        &["/m", "/t", "http://m:1/"]
    )));
}

#[test]
fn of_each_subject_only_what_makes_its_last_state_is_kept() {
    let kept = |calls: &[Request]| {
        let mut pending = WritesToSend::default();
        calls.iter().for_each(|call| pending.add(call));
        pending.calls().cloned().collect::<Vec<_>>()
    };
    let delete = |key: &str| call(Method::DeleteParam, &["/n", key]);
    let unpublish = |api: &str| call(Method::UnregisterPublisher, &["/n", "/t", api]);
    assert_eq!(
        kept(&[set("/a/b", "1"), set("/c", "1"), set("/a/b", "2")]),
        [set("/c", "1"), set("/a/b", "2")]
    );
    // A master deletes only a parameter that exists.
    let deleted = [set("/a/b", "2"), delete("/a")];
    let calls = [&[set("/a/c", "1"), set("/ab", "1")], &deleted[..]].concat();
    assert_eq!(kept(&calls), [&[set("/ab", "1")], &deleted[..]].concat());
    assert_eq!(kept(&[&deleted[..], &deleted[..]].concat()), deleted);
    assert_eq!(kept(&[delete("/a"), set("/a", "1")]), [set("/a", "1")]);
    let below = [set("/a", "1"), set("/a/b", "1")];
    assert_eq!(kept(&below), below);
    let [first, second] = ["http://n:1/", "http://n:2/"].map(|api| publish("/n", "/t", api));
    assert_eq!(
        kept(&[first.clone(), unpublish("http://n:1/"), second.clone()]),
        std::slice::from_ref(&second)
    );
    // The node's first process unregisters after its second one has registered.
    assert_eq!(
        kept(&[first.clone(), second.clone(), unpublish("http://n:1/")]),
        [second]
    );
    let ended = [first, unpublish("http://n:1/")];
    assert_eq!(kept(&ended), ended);
    assert_eq!(kept(&[&ended[..], &ended[..]].concat()), ended);
}

#[test]
fn a_parameter_that_was_changed_wins_with_all_below_and_above_it() {
    let parameter = |key: &str| Some(Conflict::Parameter(key.to_owned()));
    let base = [set("/a/b", "1"), set("/c", "1")];
    assert_eq!(
        conflict_of(&base, &[set("/a/b", "2")], set("/a/b", "3")),
        parameter("/a/b")
    );
    assert_eq!(
        conflict_of(&base, &[set("/a/x", "2")], set("/a", "3")),
        parameter("/a")
    );
    assert_eq!(
        conflict_of(&base, &[set("/a", "2")], set("/a/b", "3")),
        parameter("/a/b")
    );
    assert_eq!(
        conflict_of(&base, &[set("/new", "2")], set("/new/b", "3")),
        parameter("/new/b")
    );
    let delete = call(Method::DeleteParam, &["/n", "/a/b"]);
    assert_eq!(
        conflict_of(&base, std::slice::from_ref(&delete), set("/a/b", "3")),
        parameter("/a/b")
    );
    assert_eq!(
        conflict_of(&base, &[set("/a/b", "2")], delete.clone()),
        parameter("/a/b")
    );
    // A change beside the parameter is no conflict.
    assert_eq!(
        conflict_of(&base, &[set("/a/x", "2"), set("/c", "2")], set("/a/b", "3")),
        None
    );
    assert_eq!(
        conflict_of(&base, &[set("/new/x", "2")], set("/new/b", "3")),
        None
    );
    assert_eq!(conflict_of(&base, &[], delete), None);
    // A name is relative to its caller.
    let private = call(Method::SetParam, &["/a", "~b", "3"]);
    assert_eq!(
        conflict_of(&base, &[set("/a/b", "2")], private),
        parameter("/a/b")
    );
}

#[test]
fn a_name_that_another_node_has_taken_is_not_taken_back() {
    let base = [publish("/n", "/t", "http://old:1/")];
    let there = [publish("/n", "/t", "http://there:1/")];
    let taken = conflict_of(&base, &there, publish("/n", "/u", "http://here:1/"));
    let api = "http://there:1/".to_owned();
    let name = "/n".to_owned();
    assert_eq!(taken, Some(Conflict::Node { name, api }));
    // The other side's health check has unregistered the node because it could not reach it.
    let gone = call(Method::UnregisterPublisher, &["/n", "/t", "http://old:1/"]);
    assert_eq!(
        conflict_of(&base, &[gone], publish("/n", "/t", "http://old:1/")),
        None
    );
    // The node was started again on this computer.
    assert_eq!(
        conflict_of(&base, &[], publish("/n", "/t", "http://here:1/")),
        None
    );
}

#[test]
fn a_service_of_another_node_stays() {
    let service =
        |node: &str, api: &str| call(Method::RegisterService, &[node, "/s", api, "http://n:1/"]);
    let there = [service("/there", "rosrpc://there:1")];
    let taken = conflict_of(&[], &there, service("/here", "rosrpc://here:1"));
    let (name, node) = ("/s".to_owned(), "/there".to_owned());
    assert_eq!(taken, Some(Conflict::Service { name, node }));
    let base = [service("/old", "rosrpc://old:1")];
    assert_eq!(
        conflict_of(&base, &[], service("/here", "rosrpc://here:1")),
        None
    );
}

#[test]
fn what_a_node_has_registered_again_stays() {
    let gone = call(Method::UnregisterPublisher, &["/n", "/t", "http://n:1/"]);
    let there = [publish("/n", "/t", "http://n:1/")];
    assert!(conflict_of(&[], &there, gone.clone()).is_some());
    assert_eq!(conflict_of(&there, &[], gone), None);
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
        let mut changes = Changes::default();
        let now = changed(&base, &there, &mut changes);
        let merged = merge(&changes, &now, &here);
        prop_assert!(merged.send.len() + merged.lost.len() <= here.len());
        let mut after = now.clone();
        for call in &merged.send {
            let mut notices: Vec<Notice> = Vec::new();
            after.apply_telling(call, &mut notices);
            for notice in notices {
                if let Notice::Shutdown { to, .. } = notice {
                    // No node that registered only on the other side is shut down.
                    prop_assert!(!to.starts_with("http://there"), "{} is shut down", to);
                }
            }
        }
        for key in ["/a/b/c", "/d"] {
            let value = |of: &Master| of.param(key);
            if changes.has_param(&param_path(key)) {
                prop_assert_eq!(value(&after), value(&now), "{}", key);
            }
        }
        for (node, api) in now.nodes().filter(|(_, api)| api.starts_with("http://there")) {
            prop_assert_eq!(after.api_of(node), Some(api));
        }
    }
}
