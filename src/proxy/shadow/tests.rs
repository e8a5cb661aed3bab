use super::*;
use crate::proxy::activity::NOTICE_MEMORY;
use crate::{store::StoreError, xmlrpc::Value};

fn shadow() -> Shadow {
    let stats = Box::leak(Box::default());
    let shadow = Shadow::new(Master::default(), Session::default(), None, stats);
    shadow.set_frozen(false);
    shadow
}

fn call(method: &str, params: &[&str]) -> Call {
    Call::new(
        method,
        params.iter().map(|text| Value::from(*text)).collect(),
    )
}

fn publish(topic: &str) -> Call {
    call(
        "registerPublisher",
        &["/n", topic, "std_msgs/String", "http://n:1/"],
    )
}

fn answered(call: &Call, mirror: &mut Master) -> Reply {
    mirror.apply(call).reply
}

#[test]
fn a_reply_of_a_master_that_was_succeeded_does_not_count() {
    let shadow = shadow();
    shadow.succeed();
    let publish = publish("/t");
    let reply = answered(&publish, &mut Master::default());
    let now = Instant::now();
    assert!(shadow.record(now, 1, &[(&publish, &reply)]).is_ok());
    shadow.succeed();
    let late = self::publish("/late");
    assert!(shadow.record(now, 1, &[(&late, &reply)]).is_err());
    assert_eq!(shadow.with_mirror(|mirror| mirror.counts().publishers), 1);
}

#[test]
fn a_master_that_answers_otherwise_than_the_mirror_casts_doubt() {
    let shadow = shadow();
    let publish = publish("/t");
    let now = Instant::now();
    let right = answered(&publish, &mut Master::default());
    let recorded = shadow.record(now, 0, &[(&publish, &right)]).unwrap();
    assert!(!recorded.doubtful);
    let strange: Value = vec![
        Value::from(1),
        "Registered".into(),
        vec!["http://s:1/"].into(),
    ]
    .into();
    let recorded = shadow
        .record(now, 0, &[(&publish, &Reply::Value(strange))])
        .unwrap();
    assert!(recorded.doubtful);
    assert_eq!(shadow.stats.divergences.value(), 1);
}

#[test]
fn an_unregistration_in_an_outage_is_owed_until_paid_or_succeeded() {
    let shadow = shadow();
    let now = Instant::now();
    for topic in ["/a", "/b"] {
        let publish = publish(topic);
        let reply = shadow.with_mirror(|mirror| answered(&publish, &mut mirror.clone()));
        shadow.record(now, 0, &[(&publish, &reply)]).unwrap();
    }
    let bye = |topic| call("unregisterPublisher", &["/n", topic, "http://n:1/"]);
    let reply = shadow.unregister(now, &bye("/a"));
    let Some((Reply::Value(reply), _)) = reply else {
        panic!("{reply:?}")
    };
    assert_eq!(
        reply.as_array().and_then(<[Value]>::last),
        Some(&Value::Int(1))
    );
    assert_eq!(shadow.owed(), [bye("/a")]);
    shadow.unregister(now, &bye("/b"));
    shadow.paid(1);
    assert_eq!(shadow.owed(), [bye("/b")]);
    assert_eq!(shadow.with_mirror(|mirror| mirror.counts().publishers), 0);
    shadow.succeed();
    assert_eq!(shadow.owed(), []);
}

#[test]
fn a_frozen_mirror_takes_no_unregistration() {
    let shadow = shadow();
    shadow.set_frozen(true);
    let bye = call("unregisterPublisher", &["/n", "/a", "http://n:1/"]);
    assert_eq!(shadow.unregister(Instant::now(), &bye), None);
    assert_eq!(shadow.owed(), []);
}

#[test]
fn what_the_master_refuses_and_the_mirror_would_do_casts_doubt() {
    let shadow = shadow();
    let now = Instant::now();
    let set = Call::new("setParam", vec!["/n".into(), "/a".into(), 1.into()]);
    let reply = answered(&set, &mut Master::default());
    shadow.record(now, 0, &[(&set, &reply)]).unwrap();
    let delete = call("deleteParam", &["/n", "/a"]);
    let refusal = answered(&delete, &mut Master::default());
    let recorded = shadow.record(now, 0, &[(&delete, &refusal)]).unwrap();
    assert!(recorded.doubtful && shadow.checkpoint_due());
    assert_eq!(shadow.stats.divergences.value(), 1);
    let recorded = shadow.record(now, 0, &[(&delete, &refusal)]).unwrap();
    assert!(!recorded.doubtful, "it is gone from both");
}

#[test]
fn a_write_behind_a_subscription_is_no_divergence() {
    let shadow = shadow();
    let set = |key: &str| Call::new("setParam", vec!["/n".into(), key.into(), 1.into()]);
    let subscribe = call("subscribeParam", &["/n", "http://n:1/", "/a"]);
    let call = Call::multicall([set("/a/x"), subscribe, set("/a/y")]);
    let reply = answered(&call, &mut Master::default());
    let recorded = shadow
        .record(Instant::now(), 0, &[(&call, &reply)])
        .unwrap();
    assert!(!recorded.doubtful);
}

/// Also what the mirror knows nothing of, for the master that comes back may know it.
#[test]
fn what_takes_nothing_away_is_owed_within_limits() {
    let shadow = shadow();
    let now = Instant::now();
    let bye = |number: usize| {
        call(
            "unregisterPublisher",
            &["/n", &format!("/t{number}"), "http://n:1/"],
        )
    };
    for _ in 0..3 {
        shadow.unregister(now, &bye(0));
    }
    assert_eq!(shadow.owed(), [bye(0)]);
    for number in 0..2 * OWED_IDLY {
        shadow.unregister(now, &bye(number));
    }
    assert_eq!(shadow.owed().len(), OWED_IDLY);
    let publish = publish("/late");
    let reply = shadow.with_mirror(|mirror| answered(&publish, &mut mirror.clone()));
    shadow.record(now, 0, &[(&publish, &reply)]).unwrap();
    let last = call("unregisterPublisher", &["/n", "/late", "http://n:1/"]);
    shadow.unregister(now, &last);
    assert_eq!(shadow.owed().last(), Some(&last));
}

#[test]
fn who_the_master_is_outlasts_a_resync() {
    let shadow = shadow();
    shadow.set_identity(42, "http://us:1/".to_owned());
    let get_pid = call("getPid", &["/n"]);
    let before = shadow.answer(&get_pid);
    let mut other = Master::default();
    other.apply(&publish("/t"));
    assert_ne!(shadow.adopt(other), Vec::<String>::new());
    assert_eq!(shadow.answer(&get_pid), before);
}

/// A short call asks for what would take all the memory of a computer.
#[test]
fn reads_are_answered_together_within_limits() {
    let shadow = shadow();
    let now = Instant::now();
    let text = Value::String("x".repeat(1 << 20));
    let set = Call::new("setParam", vec!["/n".into(), "/a".into(), text]);
    for call in [&set, &publish("/t")] {
        let reply = shadow.with_mirror(|mirror| answered(call, &mut mirror.clone()));
        shadow.record(now, 0, &[(call, &reply)]).unwrap();
    }
    let read = || call("getParam", &["/n", "/"]);
    let reads = |count| (0..count).map(|_| read());
    let bye = || call("unregisterPublisher", &["/n", "/t", "http://n:1/"]);
    let many = Call::multicall(reads(100_000));
    let nested = Call::multicall([read(), many.clone()]);
    let unregistering = Call::multicall([bye()].into_iter().chain(reads(100_000)));
    assert_eq!(shadow.answer(&many), None);
    assert_eq!(shadow.answer(&nested), None);
    assert_eq!(shadow.unregister(now, &unregistering), None);
    assert_eq!(shadow.with_mirror(|mirror| mirror.counts().publishers), 1);
    assert!(shadow.answer(&read()).is_some());
    assert!(shadow.answer(&Call::multicall(reads(60))).is_some());
    let unregistering = Call::multicall([bye()].into_iter().chain(reads(60)));
    assert!(shadow.unregister(now, &unregistering).is_some());
}

#[test]
fn a_look_counts_if_nothing_came_between() {
    let shadow = shadow();
    shadow.succeed();
    let held = || {
        let mut held = Master::default();
        held.apply(&publish("/t"));
        held
    };
    let (incarnation, version) = (shadow.incarnation(), shadow.version());
    shadow.unregister(
        Instant::now(),
        &call("unregisterPublisher", &["/n", "/t", "http://n:1/"]),
    );
    assert!(shadow.adopt_if(incarnation, version, held()).is_err());
    let version = shadow.version();
    shadow.succeed();
    assert!(shadow.adopt_if(incarnation, version, held()).is_err());
    assert!(shadow.with_mirror(Master::is_empty));
    assert!(shadow.adopt_if(incarnation + 1, version, held()).is_ok());
    assert!(!shadow.with_mirror(Master::is_empty));
}

/// What is in no journal is waited for only while there is a file to write it to.
#[tokio::test]
async fn what_was_adopted_is_waited_for_until_a_checkpoint_was_attempted() {
    let folder = tempfile::tempdir().unwrap();
    let open = |name: &str| Store::open(&folder.path().join(name)).unwrap().0;
    let mut master = Master::default();
    let mut adopted = |shadow: &Shadow| {
        master.apply(&publish(&format!("/t{}", shadow.version())));
        shadow.adopt(master.clone());
        shadow.unwritten()
    };
    let shadow = shadow();
    assert_eq!(adopted(&shadow), None, "there is no file");
    shadow.set_store(open("c"));
    assert_eq!(adopted(&shadow), None, "it is not begun yet");
    let checkpoint = |shadow: &Shadow| {
        let begun = shadow.with_store(|store, checkpoint| store.begin(&checkpoint()));
        begun.unwrap().unwrap();
    };
    checkpoint(&shadow);
    shadow.set_attempted(Ok(()));
    assert_eq!(shadow.unwritten(), None);

    let first = adopted(&shadow).expect("it is in no file");
    checkpoint(&shadow);
    let second = adopted(&shadow).expect("it came after the checkpoint was taken");
    shadow.set_attempted(Ok(()));
    shadow.attempted(first).await;
    assert_eq!(shadow.unwritten(), Some(second));
    // The next one fails.
    checkpoint(&shadow);
    let error = StoreError::Stale {
        snapshot: 0,
        journal: 1,
    };
    shadow.set_attempted(Err(&error));
    shadow.attempted(second).await;
    assert!(shadow.checkpoint_due() && shadow.unprotected().is_some());
    assert_eq!(shadow.unwritten(), None);
    checkpoint(&shadow);
    shadow.set_attempted(Ok(()));
    assert!(!shadow.checkpoint_due() && shadow.unprotected().is_none());
}

#[test]
fn topics_are_remembered_while_a_dead_master_may_owe_the_news() {
    let shadow = shadow();
    let start = Instant::now();
    let subscribe = call(
        "registerSubscriber",
        &["/s", "/t", "std_msgs/String", "http://s:1/"],
    );
    for call in [&subscribe, &publish("/t"), &publish("/unheard")] {
        let reply = shadow.with_mirror(|mirror| answered(call, &mut mirror.clone()));
        shadow.record(start, 0, &[(call, &reply)]).unwrap();
    }
    let noticed = |now| shadow.with_activity(|_, activity| activity.topics_noticed(now));
    assert_eq!(noticed(start + NOTICE_MEMORY / 2), ["/t"]);
    assert_eq!(noticed(start + NOTICE_MEMORY), Vec::<String>::new());
}
