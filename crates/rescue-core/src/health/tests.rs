use super::*;

fn call(method: &str, params: &[&str]) -> Request {
    Request::new(Method::named(method), params.iter().copied())
}

fn publish(master: &mut Master, node: &str, topic: &str, api: &str) {
    master.apply(&call("registerPublisher", &[node, topic, "x/Y", api]));
}

fn subscribe(master: &mut Master, node: &str, topic: &str, api: &str) {
    master.apply(&call("registerSubscriber", &[node, topic, "x/Y", api]));
}

fn list(topics: &[&str]) -> Value {
    let entry = |topic: &&str| Value::from(vec![Value::from(*topic), "x/Y".into()]);
    Value::Array(topics.iter().map(entry).collect())
}

fn claims(publications: &[&str], subscriptions: &[&str]) -> Claims {
    Claims::read(&list(publications), &list(subscriptions)).unwrap()
}

fn name(node: &str, known_pid: Option<i32>, registered: u64) -> RegisteredName {
    RegisteredName {
        node: node.to_owned(),
        known_pid,
        registered_since: false,
        registered,
    }
}

/// The verdicts on `/a` and `/b`, which are registered at one port. `/a` publishes `/ta`, and `/b` publishes `/tb`.
fn verdicts(known: [Option<i32>; 2], pid: i32, claims: Option<&Claims>) -> Vec<IdentityVerdict> {
    let mut master = Master::default();
    for (node, topic) in [("/a", "/ta"), ("/b", "/tb")] {
        publish(&mut master, node, topic, "http://n:1/");
        publish(&mut master, node, "/rosout", "http://n:1/");
    }
    let names = [name("/a", known[0], 1), name("/b", known[1], 2)];
    judge_node(&master, &names, Some(pid), claims)
}

#[test]
fn a_different_process_id_means_another_node() {
    use IdentityVerdict::{Another, Itself};
    assert_eq!(verdicts([Some(1), Some(2)], 2, None), [Another, Itself]);
    // One process may have two names.
    assert_eq!(verdicts([Some(2), Some(2)], 2, None), [Itself, Itself]);
    // But a process may have been asked before it registered, when only its predecessor's name was known at the port.
    let of_b = claims(&["/tb"], &[]);
    let both = verdicts([Some(2), Some(2)], 2, Some(&of_b));
    assert_eq!(both, [Another, Itself]);
    // The process id takes precedence over topics, because a node may have changed its topics since.
    let other = claims(&["/tb"], &[]);
    assert_eq!(verdicts([Some(1), None], 1, Some(&other)), [Itself, Itself]);
}

#[test]
fn matching_topics_count_for_more_than_a_changed_process_id() {
    let mut master = Master::default();
    publish(&mut master, "/a", "/ta", "http://n:1/");
    publish(&mut master, "/a", "/more", "http://n:1/");
    let judge_node = |names: &[RegisteredName], topics: &[&str]| {
        judge_node(&master, names, Some(2), Some(&claims(topics, &[])))
    };
    let a = name("/a", Some(1), 1);
    let all = ["/more", "/ta", "/other"];
    assert_eq!(
        judge_node(std::slice::from_ref(&a), &all),
        [IdentityVerdict::Itself]
    );
    let some = ["/ta", "/other"];
    assert_eq!(
        judge_node(std::slice::from_ref(&a), &some),
        [IdentityVerdict::Another]
    );
    // A later node at the port publishes the same topics.
    publish(&mut master.clone(), "/b", "/ta", "http://n:1/");
    let verdicts = judge_node(&[a, name("/b", Some(2), 2)], &all);
    assert_eq!(
        verdicts,
        [IdentityVerdict::Another, IdentityVerdict::Itself]
    );
}

#[test]
fn an_empty_report_is_no_evidence() {
    let mut master = Master::default();
    publish(&mut master, "/a", "/t", "http://n:1/");
    subscribe(&mut master, "/a", "/s", "http://n:1/");
    let extra = |publications: &[&str], subscriptions: &[&str]| {
        let said = claims(publications, subscriptions);
        Reconciliation::new(&master, "/a", &said).extra.len()
    };
    assert_eq!(extra(&[], &[]), 0);
    assert_eq!(extra(&["/t"], &[]), 0);
    assert_eq!(extra(&["/u"], &[]), 1);
    assert_eq!(extra(&["/u"], &["/t"]), 2);
}

#[test]
fn a_name_that_registered_again_may_be_another_process() {
    let mut master = Master::default();
    publish(&mut master, "/a", "/ta", "http://n:1/");
    let judge_node = |pid, topic: &str| {
        let mut name = name("/a", Some(1), 1);
        name.registered_since = true;
        let said = claims(&[topic], &[]);
        judge_node(&master, &[name], Some(pid), Some(&said))
    };
    assert_eq!(
        judge_node(1, "/new"),
        [IdentityVerdict::Itself],
        "the same process"
    );
    assert_eq!(judge_node(2, "/ta"), [IdentityVerdict::Itself], "restarted");
    assert_eq!(judge_node(2, "/new"), [IdentityVerdict::Another]);
}

#[test]
fn different_topics_mean_another_node() {
    use IdentityVerdict::{Another, Itself, Unknown};
    let of_b = claims(&["/rosout", "/tb"], &["/clock"]);
    assert_eq!(verdicts([None, None], 1, Some(&of_b)), [Another, Itself]);
    let neither = claims(&["/tc"], &[]);
    assert_eq!(
        verdicts([None, None], 1, Some(&neither)),
        [Another, Another]
    );
    // Common topics and an empty report are no evidence.
    let common = claims(&["/rosout"], &["/clock", "/tf"]);
    assert_eq!(verdicts([None, None], 1, Some(&common)), [Unknown, Unknown]);
    assert_eq!(verdicts([None, None], 1, None), [Unknown, Unknown]);
}

#[test]
fn of_two_nodes_that_share_topics_the_one_that_matches_is_there() {
    use IdentityVerdict::{Another, Itself};
    let mut master = Master::default();
    for (node, topic) in [("/a", "/ta"), ("/b", "/tb")] {
        publish(&mut master, node, topic, "http://n:1/");
        subscribe(&mut master, node, "/shared", "http://n:1/");
    }
    let judge_node = |publications: &[&str]| {
        let names = [name("/a", None, 1), name("/b", None, 2)];
        let said = claims(publications, &["/shared"]);
        judge_node(&master, &names, Some(1), Some(&said))
    };
    assert_eq!(judge_node(&["/tb"]), [Another, Itself]);
    assert_eq!(judge_node(&["/ta", "/tb"]), [Itself, Itself], "two names");
    assert_eq!(
        judge_node(&[]),
        [Itself, Itself],
        "who of them is not clear"
    );
}

#[test]
fn a_port_has_one_node_behind_it() {
    let mut master = Master::default();
    publish(&mut master, "/a", "/rosout", "http://n:1/");
    publish(&mut master, "/b", "/tb", "http://n:1/");
    let said = claims(&["/tb"], &[]);
    let judge_node = |a, b| {
        let names = [name("/a", None, a), name("/b", None, b)];
        judge_node(&master, &names, Some(1), Some(&said))
    };
    assert_eq!(
        judge_node(1, 2),
        [IdentityVerdict::Another, IdentityVerdict::Itself]
    );
    // A process took a second name, or the order of registrations is unknown: both nodes are kept.
    assert_eq!(
        judge_node(2, 1),
        [IdentityVerdict::Unknown, IdentityVerdict::Itself]
    );
    assert_eq!(
        judge_node(0, 0),
        [IdentityVerdict::Unknown, IdentityVerdict::Itself]
    );
}

#[test]
fn malformed_reports_are_ignored() {
    let fine = list(&["/t"]);
    for odd in [
        Value::Nil,
        Value::from("x"),
        Value::from(vec![Value::from("/t")]),
        list(&["t"]),
        list(&["/t/"]),
        list(&["/a b"]),
        list(&["/"]),
        Value::from(vec![Value::from(vec![Value::from("/t"), 1.into()])]),
    ] {
        assert_eq!(Claims::read(&odd, &fine), None, "{odd:?}");
        assert_eq!(Claims::read(&fine, &odd), None, "{odd:?}");
    }
}

#[test]
fn topics_that_one_side_lacks_are_the_difference() {
    let mut master = Master::default();
    for topic in ["/both", "/gone"] {
        publish(&mut master, "/a", topic, "http://n:1/");
        subscribe(&mut master, "/a", topic, "http://n:1/");
    }
    publish(&mut master, "/other", "/new", "http://o:1/");
    let said = claims(&["/both", "/new"], &["/both"]);
    let reconciliation = Reconciliation::new(&master, "/a", &said);
    let words =
        |of: &[Registration]| -> Vec<String> { of.iter().map(|one| one.describe("/a")).collect() };
    assert_eq!(words(&reconciliation.missing), ["/a publishes /new"]);
    assert_eq!(
        words(&reconciliation.extra),
        ["/a publishes /gone", "/a subscribes /gone"]
    );
    for one in &reconciliation.missing {
        master.apply(&one.register("/a", "http://n:1/"));
    }
    for one in &reconciliation.extra {
        master.apply(&one.unregister("/a", "http://n:1/"));
    }
    assert!(Reconciliation::new(&master, "/a", &said).is_empty());
    assert_eq!(master.publishers_of("/new"), ["http://o:1/", "http://n:1/"]);
}

#[test]
fn a_node_is_dead_if_its_port_refuses_twice_with_no_call_in_between() {
    let refused = |may_unregister, before: Option<u64>, calls| {
        judge_refusal(may_unregister, before.as_ref(), &calls)
    };
    assert_eq!(refused(true, None, 7), Refusal::AskAgain);
    assert_eq!(refused(true, Some(7), 8), Refusal::AskAgain);
    assert_eq!(refused(true, Some(8), 8), Refusal::Dead);
    assert_eq!(refused(false, Some(8), 8), Refusal::Keep);
}

/// A node died, and another process got its port before rosrescue asked for the process id of the node.
#[test]
fn a_process_with_other_topics_is_not_the_displaced_node_whatever_its_process_id() {
    let displaced = |pid, topics: &[&str]| Displaced {
        node: "/a".to_owned(),
        api: "http://n:1/".to_owned(),
        pid,
        topics: topics.iter().map(|&topic| topic.to_owned()).collect(),
        from: None,
    };
    let (own, other) = (claims(&["/ta"], &[]), claims(&["/tb"], &["/rosout"]));
    for (known, topics, pid, claims, is_it) in [
        (Some(1), &["/ta"][..], Some(1), Some(&own), true),
        (Some(1), &["/ta"], Some(1), Some(&other), false),
        (Some(1), &["/ta"], Some(2), Some(&own), false),
        (Some(1), &["/ta"], Some(1), None, true),
        // Such topics do not tell nodes apart.
        (Some(1), &["/rosout"], Some(1), Some(&other), true),
        (Some(1), &[], Some(1), Some(&other), true),
        (None, &["/ta"], Some(1), Some(&own), true),
        (None, &["/ta"], Some(1), Some(&other), false),
        (None, &["/ta"], Some(1), None, false),
    ] {
        let displaced = displaced(known, topics);
        let found = is_displaced_node(&displaced, pid, claims);
        assert_eq!(found, is_it, "{displaced:?} {pid:?} {claims:?}");
    }
}
