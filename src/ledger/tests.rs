use std::{sync::Arc, time::Duration};

use checkpoint_store::StoreError;
use rescue_core::{
    checkpoint::format::{self, PendingWrite},
    order::{Concern, NextNotification},
};
use ros1_master::xmlrpc::Value;

use super::activity::NOTICE_MEMORY;
use super::answers::UNCHANGED_PENDING_MAX;
use super::owed::Telling;
use super::*;

fn ledger() -> Arc<Ledger> {
    let stats = Box::leak(Box::default());
    Arc::new(Ledger::new(
        Master::default(),
        Session::default(),
        Vec::new(),
        None,
        SyncPolicy::Interval,
        stats,
    ))
}

fn pending(ledger: &Ledger) -> Vec<Request> {
    ledger.lock().pending.calls().to_vec()
}

fn call(method: &str, params: &[&str]) -> Request {
    Request::new(Method::named(method), params.iter().copied())
}

fn publish(topic: &str) -> Request {
    call(
        "registerPublisher",
        &["/n", topic, "std_msgs/String", "http://n:1/"],
    )
}

fn answered(call: &Request, mirror: &mut Master) -> Reply {
    mirror.apply(call).reply
}

#[test]
fn a_reply_of_a_master_that_was_succeeded_does_not_count() {
    let ledger = ledger();
    ledger.succeed();
    let publish = publish("/t");
    let reply = answered(&publish, &mut Master::default());
    let now = Instant::now();
    assert!(ledger.record_here(now, 1, &[(&publish, &reply)]).is_ok());
    ledger.succeed();
    let late = self::publish("/late");
    assert!(ledger.record_here(now, 1, &[(&late, &reply)]).is_err());
    assert_eq!(ledger.with_mirror(|mirror| mirror.counts().publishers), 1);
}

/// With `--sync always`, an injection waits until its announcement is synced.
#[tokio::test]
async fn the_announcement_of_an_injection_is_synced_at_once() {
    let ledger = ledger();
    ledger.succeed();
    let limit = Duration::from_secs(20);
    assert!(
        tokio::time::timeout(limit, ledger.work.notified())
            .await
            .is_ok()
    );
}

#[test]
fn a_different_answer_of_the_master_puts_the_mirror_in_doubt() {
    let ledger = ledger();
    let publish = publish("/t");
    let now = Instant::now();
    let right = answered(&publish, &mut Master::default());
    let recorded = ledger.record_here(now, 0, &[(&publish, &right)]).unwrap();
    assert!(!recorded.doubtful);
    let strange: Value = vec![
        Value::from(1),
        "Registered".into(),
        vec!["http://s:1/"].into(),
    ]
    .into();
    let recorded = ledger
        .record_here(now, 0, &[(&publish, &Reply::Value(strange))])
        .unwrap();
    assert!(recorded.doubtful);
    assert_eq!(ledger.stats.divergences.value(), 1);
}

#[test]
fn a_master_with_other_words_is_read_once_per_method() {
    let ledger = ledger();
    let now = Instant::now();
    let mut master = Master::default();
    let mut doubts = |call: &Request, value: Option<Value>| {
        let Reply::Value(Value::Array(mut answer)) = answered(call, &mut master) else {
            panic!("{call:?} was answered with a fault")
        };
        answer[1] = "done by the vendor's master".into();
        if let Some(value) = value {
            answer[2] = value;
        }
        let reply = Reply::Value(Value::Array(answer));
        let recorded = ledger.record_here(now, 0, &[(call, &reply)]).unwrap();
        recorded.doubtful
    };
    assert!(doubts(&publish("/t"), None));
    assert!(!doubts(&publish("/u"), None));
    assert!(!doubts(&publish("/t"), None));
    let set = |value: i32| {
        Request::new(
            Method::SetParam,
            [Value::from("/n"), "/a".into(), value.into()],
        )
    };
    assert!(doubts(&set(1), None));
    assert!(!doubts(&set(2), None));
    // Another value is another state, whatever the words.
    assert!(doubts(&publish("/v"), Some(vec!["http://s:1/"].into())));
    assert_eq!(ledger.stats.divergences.value(), 3);
}

#[test]
fn a_mirror_in_doubt_leaves_reads_to_the_master_until_it_was_read() {
    let ledger = ledger();
    let get = Request::new(Method::GetParam, ["/n", "/unset"]);
    assert!(ledger.exact_answer(&get).is_some());
    let early = ledger.version();
    ledger.doubt();
    assert_eq!(ledger.exact_answer(&get), None);
    let state = ledger.with_mirror(Clone::clone);
    assert!(ledger.adopt_if(0, early, state.clone()).is_err());
    assert!(ledger.is_doubted());
    assert!(ledger.adopt_if(0, ledger.version(), state).is_ok());
    assert!(ledger.exact_answer(&get).is_some());
}

#[test]
fn what_is_answered_by_the_mirror_is_pending_until_delivered_or_succeeded() {
    let ledger = ledger();
    let now = Instant::now();
    let set = |value: i32| {
        Request::new(
            Method::SetParam,
            [Value::from("/n"), "/a".into(), value.into()],
        )
    };
    let answer = |call: &Request| ledger.answer_from_mirror(now, call).unwrap().0;
    assert_eq!(answer(&set(1)), answered(&set(1), &mut Master::default()));
    answer(&set(2));
    // A call that changes nothing needs no master, and a refused call has not run.
    answer(&set(2));
    answer(&call("deleteParam", &["/n", "/b"]));
    answer(&call("setParam", &["/n", "/"]));
    assert_eq!(pending(&ledger), [set(1), set(2)]);
    let kept = ledger.checkpoint()().pending.into_iter();
    assert_eq!(
        kept.map(|write| write.call).collect::<Vec<_>>(),
        [set(1), set(2)]
    );
    ledger.delivered();
    assert_eq!(pending(&ledger), []);
    let multicall = Request::multicall([set(3), call("getPid", &["/n"]), set(3), set(4)]);
    answer(&multicall);
    assert_eq!(pending(&ledger), [set(3), set(3), set(4)]);
    let before = ledger.token();
    assert_ne!(ledger.succeed().0, before);
    assert_eq!(pending(&ledger), []);
}

#[test]
fn what_an_older_mirror_cannot_delete_is_pending_until_a_master_was_read() {
    let ledger = ledger();
    let delete = || call("deleteParam", &["/n", "/newer"]);
    let answer = |call: &Request| ledger.answer_from_mirror(Instant::now(), call).unwrap().0;
    ledger.set_unconfirmed();
    let refused = answered(&delete(), &mut Master::default());
    assert_eq!(answer(&delete()), refused);
    answer(&delete());
    assert_eq!(pending(&ledger), [delete()]);
    ledger.delivered();
    ledger.open_gate();
    answer(&delete());
    assert_eq!(pending(&ledger), []);
}

#[test]
fn too_many_pending_writes_make_another_incarnation_of_their_master() {
    let ledger = ledger();
    let before = ledger.token();
    let set = |value: i32| {
        Request::new(
            Method::SetParam,
            [Value::from("/n"), "/a".into(), value.into()],
        )
    };
    let many = Request::multicall((0..20_000).map(set));
    assert!(ledger.answer_from_mirror(Instant::now(), &many).is_some());
    assert_eq!(pending(&ledger), []);
    assert_ne!(ledger.token(), before);
}

/// A process died while a master got the state as of record 5, and the next one before it had examined that master.
#[test]
fn a_start_knows_which_pending_writes_a_master_that_was_announced_lacks() {
    let pending_at = |number| {
        let write = |seq: u64| PendingWrite {
            seq,
            call: publish(&format!("/t{seq}")),
        };
        let (incarnation, at) = (4, 5);
        let session = Session {
            incarnation: 2,
            announced: Some(Announced { incarnation, at }),
            ..Session::default()
        };
        let (stats, sync) = (Box::leak(Box::default()), SyncPolicy::Interval);
        let pending = vec![write(3), write(5), write(8)];
        let ledger = Ledger::new(Master::default(), session, pending, None, sync, stats);
        ledger.note_later_master(number);
        // A second process that dies learns the same.
        let session = ledger.session();
        assert_eq!((session.incarnation, session.announced), (number, None));
        let later = ledger.lock().pending.numbered().into_iter();
        let later: Vec<_> = later.map(|write| write.seq).collect();
        assert!(later.iter().all(|seq| *seq > session.delivered));
        later
    };
    assert_eq!(pending_at(4), [8]);
    // An injection before that was announced, too, and may have reached this master.
    assert_eq!(pending_at(3), [3, 5, 8]);
    // The checkpoint is an old copy.
    assert_eq!(pending_at(5), [0; 0]);
}

#[test]
fn a_mirror_that_is_being_injected_takes_no_write() {
    let ledger = ledger();
    let now = Instant::now();
    let basis = ledger.begin_injection();
    assert_eq!((basis.version, basis.pending), (ledger.version(), vec![]));
    let bye = call("unregisterPublisher", &["/n", "/a", "http://n:1/"]);
    assert_eq!(ledger.answer_from_mirror(now, &bye), None);
    let publish = publish("/t");
    let reply = answered(&publish, &mut Master::default());
    assert!(ledger.record_here(now, 0, &[(&publish, &reply)]).is_err());
    ledger.shut_gate(State::StandingIn);
    assert!(ledger.answer_from_mirror(now, &bye).is_some());
}

/// A call in flight when the master goes away may still run when the master is back, even if the call changes nothing
/// now.
#[test]
fn a_master_continues_unchanged_only_if_no_write_is_pending_or_running() {
    let ledger = ledger();
    let now = Instant::now();
    let set = call("setParam", &["/n", "/a", "1"]);
    ledger.abandon_batch();
    assert!(!ledger.resume(&ledger.token()));
    ledger.settled();
    assert!(ledger.answer_from_mirror(now, &set).is_some());
    assert!(!ledger.resume(&ledger.token()));
    ledger.delivered();
    assert!(ledger.resume(&ledger.token()));
    assert_eq!(
        ledger.answer_from_mirror(now, &set),
        None,
        "the mirror changed before the gate opened"
    );
    ledger.shut_gate(State::StandingIn);
    assert!(ledger.answer_from_mirror(now, &set).is_some());
    ledger.abandon_batch();
    ledger.succeed();
    assert!(ledger.resume(&ledger.token()));
}

/// The registration that the call removes may still be on its way to a slow master.
#[test]
fn an_unregistration_without_effect_is_left_to_the_master() {
    let ledger = ledger();
    let now = Instant::now();
    let watch = call("subscribeParam", &["/n", "http://n:1/", "/a"]);
    ledger.answer_from_mirror(now, &watch);
    let bye = call("unregisterPublisher", &["/n", "/gone", "http://n:1/"]);
    assert!(ledger.answer_if_unchanged(now, &watch).is_some());
    for calls in [vec![bye.clone()], vec![watch.clone(), bye.clone()]] {
        let calls = Request::multicall(calls);
        assert!(ledger.answer_if_unchanged(now, &calls).is_none());
    }
    assert!(ledger.answer_if_unchanged(now, &bye).is_none());
    // A deletion that the mirror has already looks like a refusal, also within a multicall.
    let delete = call("deleteParam", &["/n", "/unset"]);
    for calls in [vec![delete.clone()], vec![watch.clone(), delete.clone()]] {
        let calls = Request::multicall(calls);
        assert!(ledger.answer_if_unchanged(now, &calls).is_none());
        let nested = Request::multicall([calls]);
        assert!(ledger.answer_if_unchanged(now, &nested).is_none());
    }
    assert!(ledger.answer_if_unchanged(now, &delete).is_none());
    let watches = Request::multicall([watch.clone(), watch]);
    assert!(ledger.answer_if_unchanged(now, &watches).is_some());
}

/// A write that the master has just answered changes nothing when the mirror answers it once more, because its answer
/// waited for the disk. The master may still have to send an older value.
#[test]
fn a_write_that_changes_nothing_tells_nodes_nothing_before_the_master_has() {
    let ledger = ledger();
    let now = Instant::now();
    let set = |value: i32| {
        Request::new(
            Method::SetParam,
            [Value::from("/w"), "/a".into(), value.into()],
        )
    };
    let watch = call("subscribeParam", &["/n", "http://n:1/", "/a"]);
    for write in [&watch, &set(1), &set(2)] {
        let reply = ledger.with_mirror(|mirror| answered(write, &mut mirror.clone()));
        ledger.record_here(now, 0, &[(write, &reply)]).unwrap();
    }
    assert!(ledger.answer_if_unchanged(now, &set(2)).is_some());
    let next = |at| {
        ledger.with_order(|order, mirror| {
            order.queue_due_repeats(at);
            order.next_notification(at, "http://n:1", mirror)
        })
    };
    assert_eq!(next(now), NextNotification::Idle);
    assert!(matches!(
        next(now + Duration::from_secs(1)),
        NextNotification::Send { .. }
    ));
}

/// Loggers repeat parameter subscriptions all the time, so these use no memory and do not outdate a prepared injection.
/// Otherwise nobody tells the subscribers if that master dies before it does.
#[test]
fn what_is_left_to_a_late_master_is_owed_until_the_next_one_serves() {
    let ledger = ledger();
    let now = Instant::now();
    let subscriber = ["/s", "/t", "std_msgs/String", "http://s:1/"];
    ledger.answer_from_mirror(now, &call("registerSubscriber", &subscriber));
    ledger.delivered();
    let publish = publish("/t");
    let concern = Concern::of_call(Some(&publish));
    ledger.with_order(|order, _| order.calls_sent(concern.notified_subjects(), Vec::new()));
    // The master is late with the call, so the mirror answers it. Then the master answers, and dies.
    ledger.answer_from_mirror(now, &publish);
    ledger.fall_behind(now, concern.notified_subjects().to_vec(), true);
    ledger.late_answered(now);
    ledger.abandon_batch();
    let queued = ledger.queue_owed(now, now, Telling::Now);
    assert_eq!(queued.topics, ["/t"]);
}

#[test]
fn what_changes_nothing_leaves_no_trace() {
    let ledger = ledger();
    let now = Instant::now();
    let watch = call("subscribeParam", &["/n", "http://n:1/", "/a"]);
    assert!(ledger.answer_if_unchanged(now, &watch).is_none());
    ledger.answer_from_mirror(now, &watch);
    let (version, pending_before) = (ledger.version(), pending(&ledger));
    // Without a journal there is no mark.
    let expected = Some((answered(&watch, &mut Master::default()), Mark::default()));
    let (reply, mark, _) = ledger.answer_if_unchanged(now, &watch).unwrap();
    assert_eq!(Some((reply, mark)), expected);
    assert_eq!(ledger.answer_from_mirror(now, &watch), expected);
    assert_eq!(
        (ledger.version(), pending(&ledger)),
        (version, pending_before)
    );
}

#[test]
fn what_the_master_refuses_and_the_mirror_would_do_casts_doubt() {
    let ledger = ledger();
    let now = Instant::now();
    let set = Request::new(Method::SetParam, [Value::from("/n"), "/a".into(), 1.into()]);
    let reply = answered(&set, &mut Master::default());
    ledger.record_here(now, 0, &[(&set, &reply)]).unwrap();
    let delete = call("deleteParam", &["/n", "/a"]);
    let refusal = answered(&delete, &mut Master::default());
    let recorded = ledger.record_here(now, 0, &[(&delete, &refusal)]).unwrap();
    assert!(recorded.doubtful && ledger.checkpoint_due());
    assert_eq!(ledger.stats.divergences.value(), 1);
    let recorded = ledger.record_here(now, 0, &[(&delete, &refusal)]).unwrap();
    assert!(!recorded.doubtful, "it is gone from both");
}

#[test]
fn a_write_behind_a_subscription_is_no_divergence() {
    let ledger = ledger();
    let set = |key: &str| Request::new(Method::SetParam, [Value::from("/n"), key.into(), 1.into()]);
    let subscribe = call("subscribeParam", &["/n", "http://n:1/", "/a"]);
    let call = Request::multicall([set("/a/x"), subscribe, set("/a/y")]);
    let reply = answered(&call, &mut Master::default());
    let recorded = ledger
        .record_here(Instant::now(), 0, &[(&call, &reply)])
        .unwrap();
    assert!(!recorded.doubtful);
}

/// An unregistration that removes nothing from the mirror is pending, because a master that comes back may have the
/// registration.
#[test]
fn what_takes_nothing_away_is_pending_within_limits() {
    let ledger = ledger();
    let now = Instant::now();
    let bye = |number: usize| {
        call(
            "unregisterPublisher",
            &["/n", &format!("/t{number}"), "http://n:1/"],
        )
    };
    for _ in 0..3 {
        ledger.answer_from_mirror(now, &bye(0));
    }
    assert_eq!(pending(&ledger), [bye(0)]);
    for number in 0..2 * UNCHANGED_PENDING_MAX {
        ledger.answer_from_mirror(now, &bye(number));
    }
    assert_eq!(pending(&ledger).len(), UNCHANGED_PENDING_MAX);
    let publish = publish("/late");
    let reply = ledger.with_mirror(|mirror| answered(&publish, &mut mirror.clone()));
    ledger.record_here(now, 0, &[(&publish, &reply)]).unwrap();
    let last = call("unregisterPublisher", &["/n", "/late", "http://n:1/"]);
    ledger.answer_from_mirror(now, &last);
    assert_eq!(pending(&ledger).last(), Some(&last));
}

#[test]
fn who_the_master_is_outlasts_a_resync() {
    let ledger = ledger();
    ledger.set_identity(42, "http://us:1/".to_owned());
    let get_pid = call("getPid", &["/n"]);
    let before = ledger.answer(&get_pid);
    let mut other = Master::default();
    other.apply(&publish("/t"));
    assert_ne!(ledger.adopt(other), Vec::<String>::new());
    assert_eq!(ledger.answer(&get_pid), before);
}

/// A short call could ask for answers that need all of a computer's memory.
#[test]
fn reads_are_answered_together_within_limits() {
    let ledger = ledger();
    let now = Instant::now();
    let text = Value::String("x".repeat(1 << 20));
    let set = Request::new(Method::SetParam, [Value::from("/n"), "/a".into(), text]);
    for call in [&set, &publish("/t")] {
        let reply = ledger.with_mirror(|mirror| answered(call, &mut mirror.clone()));
        ledger.record_here(now, 0, &[(call, &reply)]).unwrap();
    }
    let read = || call("getParam", &["/n", "/"]);
    let reads = |count| (0..count).map(|_| read());
    let bye = || call("unregisterPublisher", &["/n", "/t", "http://n:1/"]);
    let many = Request::multicall(reads(100_000));
    let nested = Request::multicall([read(), many.clone()]);
    let unregistering = Request::multicall([bye()].into_iter().chain(reads(100_000)));
    assert_eq!(ledger.answer(&many), None);
    assert_eq!(ledger.answer(&nested), None);
    assert_eq!(ledger.answer_from_mirror(now, &unregistering), None);
    assert_eq!(ledger.with_mirror(|mirror| mirror.counts().publishers), 1);
    assert!(ledger.answer(&read()).is_some());
    assert!(ledger.answer(&Request::multicall(reads(60))).is_some());
    let unregistering = Request::multicall([bye()].into_iter().chain(reads(60)));
    assert!(ledger.answer_from_mirror(now, &unregistering).is_some());
}

#[test]
fn a_look_counts_if_nothing_came_between() {
    let ledger = ledger();
    ledger.succeed();
    let held = || {
        let mut held = Master::default();
        held.apply(&publish("/t"));
        held
    };
    let (incarnation, version) = (ledger.incarnation(), ledger.version());
    ledger.answer_from_mirror(
        Instant::now(),
        &call("unregisterPublisher", &["/n", "/t", "http://n:1/"]),
    );
    assert!(ledger.adopt_if(incarnation, version, held()).is_err());
    let version = ledger.version();
    ledger.succeed();
    assert!(ledger.adopt_if(incarnation, version, held()).is_err());
    assert!(ledger.with_mirror(Master::is_empty));
    assert!(ledger.adopt_if(incarnation + 1, version, held()).is_ok());
    assert!(!ledger.with_mirror(Master::is_empty));
}

/// A write without a record waits only while there is a file to write to.
#[tokio::test]
async fn a_write_that_changes_nothing_is_safe_as_soon_as_this_computer_leads() {
    let ledger = ledger();
    let publish = publish("/t");
    ledger.leave();
    let mut held = Master::default();
    held.apply(&publish);
    ledger.follow_state(7, held.clone()).unwrap();
    ledger.lead(7, &held);
    // A node repeats a write after the previous leader had recorded it and died before the answer.
    let (_, mark) = ledger.answer_from_mirror(Instant::now(), &publish).unwrap();
    let safe = ledger.durable(ledger.to_await(mark).unwrap());
    let safe = tokio::time::timeout(Duration::from_secs(5), safe).await;
    assert_eq!(safe, Ok(true), "it waits for a record that nobody makes");
}

#[tokio::test]
async fn what_was_adopted_is_waited_for_until_a_checkpoint_was_attempted() {
    let folder = tempfile::tempdir().unwrap();
    let open = |name: &str| Store::open(&folder.path().join(name)).unwrap().0;
    let mut master = Master::default();
    let mut adopted = |ledger: &Ledger| {
        master.apply(&publish(&format!("/t{}", ledger.version())));
        ledger.adopt(master.clone());
        ledger.unwritten()
    };
    let ledger = ledger();
    assert_eq!(adopted(&ledger), None, "there is no file");
    ledger.set_store(open("c"));
    assert_eq!(adopted(&ledger), None, "it is not begun yet");
    let checkpoint = async |ledger: &Ledger| {
        let begun = ledger.on_store_whole(|store, checkpoint| store.begin(&checkpoint));
        begun.await.unwrap().unwrap();
    };
    checkpoint(&ledger).await;
    ledger.set_attempted(Ok(()));
    assert_eq!(ledger.unwritten(), None);

    let first = adopted(&ledger).expect("it is in no file");
    checkpoint(&ledger).await;
    let second = adopted(&ledger).expect("it came after the checkpoint was taken");
    ledger.set_attempted(Ok(()));
    ledger.attempted(first).await;
    assert_eq!(ledger.unwritten(), Some(second));
    // The next checkpoint fails.
    checkpoint(&ledger).await;
    let error = StoreError::Stale {
        snapshot: 0,
        journal: 1,
    };
    ledger.set_attempted(Err(&error));
    ledger.attempted(second).await;
    assert!(ledger.checkpoint_due() && ledger.unprotected().is_some());
    assert_eq!(ledger.unwritten(), None);
    checkpoint(&ledger).await;
    ledger.set_attempted(Ok(()));
    assert!(!ledger.checkpoint_due() && ledger.unprotected().is_none());
}

#[test]
fn topics_are_remembered_while_a_dead_master_may_owe_notifications() {
    let ledger = ledger();
    let start = Instant::now();
    let subscribe = call(
        "registerSubscriber",
        &["/s", "/t", "std_msgs/String", "http://s:1/"],
    );
    for call in [&subscribe, &publish("/t"), &publish("/unheard")] {
        let reply = ledger.with_mirror(|mirror| answered(call, &mut mirror.clone()));
        ledger.record_here(start, 0, &[(call, &reply)]).unwrap();
    }
    let owed = |now| ledger.with_activity(|_, activity| activity.take_owed(now).topics);
    assert_eq!(owed(start + NOTICE_MEMORY), Vec::<String>::new());
    assert_eq!(owed(start + NOTICE_MEMORY / 2), ["/t"]);
}

/// A compaction may run between the record and the deaths of master and rosrescue.
#[test]
fn who_was_displaced_lately_is_in_the_snapshot() {
    let ledger = ledger();
    let now = Instant::now();
    for api in ["http://n:1/", "http://n:2/"] {
        let publish = call("registerPublisher", &["/n", "/t", "x/Y", api]);
        let reply = answered(&publish, &mut Master::default());
        ledger.record_here(now, 0, &[(&publish, &reply)]).unwrap();
    }
    let checkpoint = format::Checkpoint {
        follows: false,
        ..ledger.checkpoint()()
    };
    let encoded = format::encode_checkpoint(&checkpoint, 1).unwrap();
    let read = format::decode(&encoded.bytes).unwrap().checkpoint.unwrap();
    assert_eq!(read, checkpoint);
    let rebuilt = rescue_core::checkpoint::session::rebuild(Some(read), Vec::new());
    let apis: Vec<_> = rebuilt.displaced.iter().map(|it| &*it.api).collect();
    assert_eq!(apis, ["http://n:1/"]);
    // The displaced nodes are also in the next start's snapshot, until the master is examined.
    let next = self::ledger();
    next.with_activity(|_, activity| activity.restore_displaced(rebuilt.displaced));
    assert_eq!(next.checkpoint()().displaced, checkpoint.displaced);
}

/// A ledger with a file, and the state and number of records that the next start would find in it.
struct Recorded {
    folder: tempfile::TempDir,
    ledger: Arc<Ledger>,
}

impl Recorded {
    async fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let ledger = ledger();
        ledger.set_store(Store::open(&folder.path().join("c")).unwrap().0);
        let this = Self { folder, ledger };
        this.checkpoint().await;
        this
    }

    async fn checkpoint(&self) {
        let begun = self
            .ledger
            .on_store_whole(|store, checkpoint| store.begin(&checkpoint));
        begun.await.unwrap().unwrap();
        self.ledger.set_attempted(Ok(()));
    }

    async fn found(&self) -> (Master, usize) {
        // Runs after all records.
        self.ledger.on_store(|_| ()).await.unwrap();
        let loaded = checkpoint_store::read(&self.folder.path().join("c"));
        let loaded = loaded.unwrap().unwrap();
        let count = loaded.records.len();
        let rebuilt = rescue_core::checkpoint::session::rebuild(loaded.checkpoint, loaded.records);
        (rebuilt.mirror, count)
    }

    /// Passes the master's answer to `call` to the ledger.
    fn answer(&self, call: &Request, reply: &Reply) {
        let now = Instant::now();
        self.ledger.record_here(now, 0, &[(call, reply)]).unwrap();
    }
}

#[tokio::test]
async fn a_write_on_its_way_to_the_master_is_in_the_file_once() {
    let it = Recorded::new().await;
    let call = Arc::new(publish("/t"));
    assert!(it.ledger.record_ahead(&call, Origin::Rosrescue));
    it.ledger.write();
    // Nothing shows the write before the master has answered.
    assert!(it.ledger.with_mirror(Master::is_empty));
    let (found, before) = it.found().await;
    assert_eq!(found.counts().publishers, 1);
    it.answer(&call, &answered(&call, &mut Master::default()));
    assert!(!it.ledger.checkpoint_due());
    let (found, after) = it.found().await;
    assert_eq!((found.counts().publishers, after), (1, before));
}

#[tokio::test]
async fn a_write_whose_record_a_checkpoint_has_replaced_is_recorded_again() {
    let it = Recorded::new().await;
    let call = Arc::new(publish("/t"));
    assert!(it.ledger.record_ahead(&call, Origin::Rosrescue));
    it.ledger.write();
    it.checkpoint().await;
    assert!(it.found().await.0.is_empty());
    it.answer(&call, &answered(&call, &mut Master::default()));
    assert_eq!(it.found().await.0.counts().publishers, 1);
}

#[tokio::test]
async fn a_recorded_write_that_is_refused_or_never_answered_leaves_the_file() {
    let refused = Reply::Value(vec![Value::from(-1), "no".into(), 0.into()].into());
    for reply in [Some(refused), None] {
        let it = Recorded::new().await;
        let call = Arc::new(publish("/t"));
        assert!(it.ledger.record_ahead(&call, Origin::Rosrescue));
        it.ledger.write();
        match reply {
            Some(reply) => it.answer(&call, &reply),
            None => it.ledger.withdraw(),
        }
        assert!(it.ledger.checkpoint_due());
        // A reply that no rosmaster gives puts the mirror in doubt, and the master's state is read.
        it.ledger.adopt(Master::default());
        it.checkpoint().await;
        assert!(it.found().await.0.is_empty());
    }
}

#[tokio::test]
async fn a_write_that_the_mirror_answers_instead_stays_in_the_file() {
    let it = Recorded::new().await;
    let call = Arc::new(publish("/t"));
    assert!(it.ledger.record_ahead(&call, Origin::Rosrescue));
    it.ledger.write();
    it.ledger.answer_from_mirror(Instant::now(), &call).unwrap();
    it.ledger.withdraw();
    assert!(!it.ledger.checkpoint_due());
    assert_eq!(it.found().await.0.counts().publishers, 1);
    assert_eq!(pending(&it.ledger), [Request::clone(&call)]);
}

#[tokio::test]
async fn only_a_write_that_the_master_surely_accepts_is_recorded_before_its_answer() {
    let it = Recorded::new().await;
    for call in [
        call("deleteParam", &["/n", "/unset"]),
        call("setParam", &["/n", "/", "no namespace"]),
        call("registerPublisher", &["/n", "/t", "no type", "http://n:1/"]),
        call("getParam", &["/n", "/a"]),
        Request::multicall([publish("/t")]),
    ] {
        let call = Arc::new(call);
        assert!(!it.ledger.record_ahead(&call, Origin::Rosrescue));
    }
    let (_, before) = it.found().await;
    let call = Arc::new(publish("/t"));
    assert!(it.ledger.record_ahead(&call, Origin::Rosrescue));
    it.ledger.write();
    assert_eq!(it.found().await.1, before + 1);
}
