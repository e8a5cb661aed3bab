use ros1_master::master::Method;

use super::*;

fn call(method: &str, params: &[&str]) -> Request {
    Request::new(Method::named(method), params.iter().copied())
}

fn publish(node: &str, topic: &str) -> Request {
    call("registerPublisher", &[node, topic, "x/Y", "http://n:1/"])
}

fn apply(activity: &mut Activity, now: Instant, call: &Request) {
    activity.applied(now, call, Noticed::default(), |_| true);
}

#[test]
fn a_process_id_is_sure_until_the_node_registers_again() {
    let now = Instant::now();
    let mut activity = Activity::default();
    apply(&mut activity, now, &publish("/a", "/t"));
    let registered = activity.last_calls("/a").registered;
    activity.remember_pid("/a", "http://n:1/", registered, 7);
    assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, false)));
    assert_eq!(activity.pid_of("/a", "http://n:2/"), None);
    let gone = call("unregisterPublisher", &["/a", "/t", "http://n:1/"]);
    apply(&mut activity, now, &gone);
    assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, false)));
    apply(
        &mut activity,
        now,
        &Request::multicall([publish("/a", "/u")]),
    );
    assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, true)));
    // An answer to a question from before the registration is too old.
    activity.remember_pid("/a", "http://n:1/", registered, 8);
    assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, true)));
}

#[test]
fn a_new_node_is_asked_once_after_its_last_registration() {
    let start = Instant::now();
    let second = Duration::from_secs(1);
    let mut activity = Activity::default();
    apply(&mut activity, start, &publish("/a", "/t"));
    apply(&mut activity, start + second, &publish("/a", "/u"));
    let none = Vec::<String>::new();
    assert_eq!(activity.take_unidentified(start), none);
    assert_eq!(activity.take_unidentified(start + second), ["/a"]);
    assert_eq!(activity.take_unidentified(start + second), none);
}

fn subscribed() -> (Master, Request) {
    let mut master = Master::default();
    let subscribe = call("registerSubscriber", &["/s", "/t", "*", "http://s:1/"]);
    master.apply(&subscribe);
    (master, publish("/a", "/t"))
}

#[test]
fn changes_are_collected_only_while_a_master_may_be_late() {
    let now = Instant::now();
    let mut activity = Activity::default();
    let (mut master, publish) = subscribed();
    let mut apply = |activity: &mut Activity, standing_in| {
        let mut noticed = Noticed::new(standing_in);
        master.apply_telling(&publish, &mut noticed);
        activity.applied(now, &publish, noticed, |_| true)
    };
    // A node that registers for the first time is new, too.
    assert!(apply(&mut activity, false));
    assert!(!apply(&mut activity, false));
    activity.set_notifying(true);
    assert!(apply(&mut activity, false));
    let changes = activity.take_unseen().changes;
    assert_eq!(
        changes,
        IndexSet::from([NotifyingChange::Topic("/t".to_owned())])
    );
    assert_eq!(activity.take_owed(now).topics, ["/t"]);
    assert_eq!(activity.take_owed(now).topics, Vec::<String>::new());
    // Without a master, rosrescue sends the notifications, with the master's words.
    let mut noticed = Noticed::new(true);
    master.apply_telling(&publish, &mut noticed);
    let calls = noticed.take_calls().unwrap();
    let [(to, subject, call)] = &calls[..] else {
        panic!("{calls:?}")
    };
    assert_eq!(to, "http://s:1/");
    assert_eq!(*subject, Subject::Topic("/t".to_owned()));
    assert_eq!(**call, master.publisher_update("/t"));
}

#[test]
fn who_is_displaced_is_known_with_what_it_did() {
    let now = Instant::now();
    let mut activity = Activity::default();
    let (mut master, publish) = subscribed();
    master.apply(&publish);
    apply(&mut activity, now, &publish);
    let registered = activity.last_calls("/a").registered;
    activity.remember_pid("/a", "http://n:1/", registered, 7);
    let again = call("registerPublisher", &["/a", "/u", "x/Y", "http://n:2/"]);
    let expected = Displaced {
        node: "/a".to_owned(),
        api: "http://n:1/".to_owned(),
        pid: Some(7),
        topics: vec!["/t".to_owned()],
        from: None,
    };
    for again in [again.clone(), Request::multicall([again])] {
        let mut noticed = Noticed::new(false);
        noticed.displaced = activity.displaced_by(&master, &again);
        assert_eq!(noticed.displaced, std::slice::from_ref(&expected));
        activity.applied(now, &again, noticed, |_| true);
    }
    assert_eq!(activity.take_owed(now).displaced.len(), 2);
    assert_eq!(activity.take_owed(now).displaced, []);
}

/// rospy subscribes to the same parameter at each log line.
#[test]
fn a_node_that_logs_all_the_time_is_asked_for_its_process_id_and_keeps_it() {
    let start = Instant::now();
    let mut activity = Activity::default();
    apply(&mut activity, start, &publish("/a", "/rosout"));
    let log = call("subscribeParam", &["/a", "http://n:1/", "/rosout_disable"]);
    let second = Duration::from_secs(1);
    for seconds in 1..5 {
        apply(&mut activity, start + seconds * second, &log);
    }
    assert_eq!(activity.take_unidentified(start + second), ["/a"]);
    let registered = activity.last_calls("/a").registered;
    activity.remember_pid("/a", "http://n:1/", registered, 7);
    apply(&mut activity, start + 5 * second, &log);
    assert_eq!(activity.pid_of("/a", "http://n:1/"), Some((7, false)));
}

#[test]
fn who_was_displaced_by_the_journal_is_told_unless_the_name_is_its_own_again() {
    let now = Instant::now();
    let mut activity = Activity::default();
    let mut master = Master::default();
    master.apply(&publish("/a", "/t"));
    let at = |node: &str, api: &str| Displaced {
        node: node.to_owned(),
        api: api.to_owned(),
        pid: None,
        topics: vec!["/t".to_owned()],
        from: None,
    };
    let taken = at("/a", "http://n:2/");
    let displaced = [
        taken.clone(),
        at("/a", "http://n:1/"),
        at("/gone", "http://n:3/"),
    ];
    activity.restore_displaced(displaced.to_vec());
    // Nodes are not told to shut down before the master was examined.
    assert_eq!(activity.take_owed(now).displaced, []);
    activity.notice_all(&master, now);
    assert_eq!(activity.take_owed(now).displaced, [taken]);
    activity.notice_all(&master, now);
    assert_eq!(activity.take_owed(now).displaced, []);
}

#[test]
fn what_was_unregistered_is_remembered_and_nothing_else() {
    let mut activity = Activity::default();
    let mut master = Master::default();
    master.apply(&publish("/n", "/t"));
    master.apply(&publish("/n", "/kept"));
    let api = master.api_of("/n").unwrap().to_owned();
    let gone = |topic: &str| call("unregisterPublisher", &["/n", topic, &api]);
    activity.note_lost(&master, &Request::multicall([gone("t"), gone("/never")]));
    assert!(activity.has_lost("/n", &api, true, "/t"));
    assert!(!activity.has_lost("/n", "http://other:1/", true, "/t"));
    assert!(!activity.has_lost("/n", &api, false, "/t"));
    assert!(!activity.has_lost("/n", &api, true, "/never"));
    assert!(!activity.has_lost("/n", &api, true, "/kept"));
    for _ in 0..NOTICES {
        activity.note_lost(&master, &gone("/kept"));
    }
    assert!(!activity.has_lost("/n", &api, true, "/t"), "bounded");
}

#[test]
fn a_key_is_kept_once_for_all_its_subscribers() {
    let now = Instant::now();
    let mut activity = Activity::default();
    activity.set_notifying(true);
    let subscribers: Vec<_> = (0..NOTICES)
        .map(|port| format!("http://s:{port}/"))
        .collect();
    let mut noticed = Noticed::new(false);
    noticed.param_update(&subscribers, "/key/", &Value::Int(1));
    activity.applied(now, &publish("/a", "/t"), noticed, |_| true);
    let noticed = activity.take_owed(now).params;
    assert_eq!(noticed.len(), NOTICES);
    let (_, first) = &noticed[0];
    assert!(noticed.iter().all(|(_, key)| Arc::ptr_eq(key, first)));
    let is_shared = |change: &NotifyingChange| matches!(change, NotifyingChange::Param(_, key) if Arc::ptr_eq(key, first));
    let changes = activity.take_unseen().changes;
    assert!(changes.len() == NOTICES && changes.iter().all(is_shared));
}

#[test]
fn of_too_many_changes_the_newest_are_remembered() {
    let start = Instant::now();
    let mut activity = Activity::default();
    let change = |activity: &mut Activity, key: &str, at| {
        let mut noticed = Noticed::new(false);
        noticed.param_update(&["http://s:1/".to_owned()], key, &Value::Int(1));
        activity.applied(at, &publish("/a", "/t"), noticed, |_| true);
    };
    for index in 0..NOTICES {
        change(&mut activity, &format!("/key{index}/"), start);
    }
    // A repeated change is new, although its key is an old one.
    let now = start + Duration::from_millis(1);
    change(&mut activity, "/key0/", now);
    change(&mut activity, "/last/", now);
    let owed = activity.take_owed(now).params;
    let is_owed = |key: &str| owed.iter().any(|(_, owed)| &**owed == key);
    assert!(
        is_owed("/key0/") && is_owed("/last/"),
        "{} owed",
        owed.len()
    );
}
