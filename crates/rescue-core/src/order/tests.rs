//! Tests of single situations. `write_queue/tests` runs random schedules with nodes, masters and deaths.

use super::*;
use crate::health::port_of;
use ros1_master::{
    master::{Method, Request},
    xmlrpc::Value,
};

const A: &str = "http://a:1";

fn call(method: &str, params: &[&str]) -> Request {
    Request::new(Method::named(method), params.iter().copied())
}

fn subscribe(node: &str, topic: &str) -> Request {
    let api = format!("http:/{node}:1/");
    call("registerSubscriber", &[node, topic, "*", &api])
}

fn publish(node: &str, topic: &str) -> Request {
    let api = format!("http:/{node}:1/");
    call("registerPublisher", &[node, topic, "x/Y", &api])
}

fn topic(name: &str) -> Subject {
    Subject::Topic(name.to_owned())
}

fn param(key: &str) -> Subject {
    Subject::Param(key.to_owned())
}

fn begin(order: &mut Order, now: Instant, call: &Request) -> u64 {
    let recipients = Concern::of_call(Some(call)).recipients();
    order.begin_answer(now, recipients).unwrap()
}

fn holds(order: &mut Order, now: Instant, call: &Request) -> bool {
    order
        .must_wait(now, &Concern::of_call(Some(call)))
        .is_some()
}

/// The list of publishers in the `publisherUpdate` to send, and the number of the notification.
fn sent(next: NextNotification) -> (Value, u64) {
    match next {
        NextNotification::Send { call, number } => (call.params[2].clone(), number),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_node_whose_answer_was_overdue_is_told_the_state_after_it() {
    let (mut order, start, mut mirror) = (Order::default(), Instant::now(), Master::default());
    for call in [subscribe("/a", "/t"), publish("/b", "/t")] {
        mirror.apply(&call);
    }
    for (late, repeats) in [(ANSWER_LIMIT / 2, false), (ANSWER_LIMIT, true)] {
        let number = begin(&mut order, start, &subscribe("/a", "/t"));
        order.answer_ready(start, number);
        order.answer_written(start + late, number);
        let expected = repeats.then_some(start + late + REPEAT_AFTER);
        assert_eq!(order.next_repeat(), expected);
    }
    let due = start + ANSWER_LIMIT + REPEAT_AFTER;
    order.queue_due_repeats(due);
    sent(order.next_notification(due, A, &mirror));
}

#[test]
fn a_write_that_notifies_a_node_waits_for_an_answer_to_that_node_about_the_same_subject() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    let subscribed = begin(&mut order, now, &subscribe("/a", "/t"));
    let gone = call("unregisterPublisher", &["/b", "/t", "http://b:1/"]);
    for (write, waits) in [
        (publish("/b", "/t"), true),
        (publish("/b", "t"), true),
        (gone, true),
        (publish("/b", "/u"), false),
        (subscribe("/b", "/t"), false),
        (call("setParam", &["/b", "/t", "1"]), false),
        (
            Request::multicall([publish("/b", "/u"), publish("/b", "/t")]),
            true,
        ),
        // This call takes the name of the node at another address.
        (call("subscribeParam", &["/a", "http://a:2/", "/k"]), true),
        (call("subscribeParam", &["/a", "http://a:1/", "/k"]), false),
    ] {
        assert_eq!(holds(&mut order, now, &write), waits, "{write:?}");
    }
    assert!(order.must_wait(now, &Concern::of_call(None)).is_some());
    assert!(order.answer_written(now, subscribed));
    assert!(!holds(&mut order, now, &publish("/b", "/t")));
    assert!(order.must_wait(now, &Concern::of_call(None)).is_none());

    let watch = call("subscribeParam", &["/a", "http://a:1/", "/k/x"]);
    begin(&mut order, now, &watch);
    mirror.apply(&watch);
    for (key, waits) in [("/k", true), ("/k/x/y", true), ("/", true), ("/k/y", false)] {
        let write = call("setParam", &["/b", key, "1"]);
        assert_eq!(holds(&mut order, now, &write), waits, "{key}");
    }
}

#[test]
fn the_answer_to_a_read_of_a_subscribed_parameter_counts_as_well() {
    let (mut order, mut mirror) = (Order::default(), Master::default());
    let now = Instant::now();
    let read = call("getParam", &["/a", "/k/x"]);
    assert_eq!(recipients_of_read(&read, &mirror), []);
    mirror.apply(&call("subscribeParam", &["/a", "http://a:1/", "/k"]));
    assert_eq!(
        recipients_of_read(&call("getParam", &["/a", "/l"]), &mirror),
        []
    );
    assert_eq!(
        recipients_of_read(&call("hasParam", &["/a", "/k"]), &mirror),
        []
    );
    let recipients = recipients_of_read(&Request::multicall([read]), &mirror);
    let expected = Recipient {
        port: A.to_owned(),
        subject: param("/k/x/"),
    };
    assert_eq!(recipients, [expected]);
    assert!(!holds(
        &mut order,
        now,
        &call("setParam", &["/b", "/k/x", "1"])
    ));
    order.calls_sent(&[param("/k/")], Vec::new());
    assert!(order.read_must_wait(&recipients));
    assert!(order.calls_settled());
    assert!(!order.read_must_wait(&recipients));
}

#[test]
fn a_notification_waits_until_shortly_after_the_answer_and_is_repeated_once() {
    let (mut order, start, mut mirror) = (Order::default(), Instant::now(), Master::default());
    let number = begin(&mut order, start, &subscribe("/a", "/t"));
    mirror.apply(&subscribe("/a", "/t"));
    mirror.apply(&publish("/b", "/t"));
    let update = Arc::new(mirror.publisher_update("/t"));
    order.notify(start, A, topic("/t"), update.clone());
    assert_eq!(order.take_idle_ports(), [A]);
    assert_eq!(
        order.next_notification(start, A, &mirror),
        NextNotification::Wait { until: None }
    );
    assert!(order.answer_written(start, number));
    let until = Some(start + LEAD);
    assert_eq!(
        order.next_notification(start, A, &mirror),
        NextNotification::Wait { until }
    );
    let now = start + LEAD;
    let (list, number) = sent(order.next_notification(now, A, &mirror));
    assert_eq!(list, update.params[2]);
    // While the answer is on its way, writes that would notify the node of something newer wait, but not forever.
    assert!(holds(&mut order, now, &publish("/c", "/t")));
    assert!(!holds(
        &mut order,
        now + NOTIFICATION_LIMIT,
        &publish("/c", "/t")
    ));
    order.notification_taken(number);
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Idle
    );

    let again = order.next_repeat().unwrap();
    assert_eq!(again, now + REPEAT_AFTER);
    order.queue_due_repeats(again);
    assert_eq!(order.take_idle_ports(), [A]);
    let (_, number) = sent(order.next_notification(again, A, &mirror));
    order.notification_taken(number);
    assert_eq!(
        (
            order.next_notification(again, A, &mirror),
            order.next_repeat()
        ),
        (NextNotification::Idle, None)
    );
}

#[test]
fn what_was_withdrawn_is_told_as_the_state_unless_another_computer_notifies_nodes() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    mirror.apply(&publish("/b", "/t"));
    order.notify(now, A, topic("/t"), Arc::new(mirror.publisher_update("/t")));
    let (_, number) = sent(order.next_notification(now, A, &mirror));
    mirror.apply(&publish("/c", "/t"));
    order.notification_withdrawn(number);
    let (list, number) = sent(order.next_notification(now, A, &mirror));
    assert_eq!(list, mirror.publisher_update("/t").params[2]);
    order.notification_withdrawn(number);
    order.forget_notifications();
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Idle
    );
}

#[test]
fn outdated_notifications_are_left_out_and_never_sent_after_newer_ones() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    let mut lists = Vec::new();
    for node in ["/b", "/c", "/d"] {
        mirror.apply(&publish(node, "/t"));
        let update = Arc::new(mirror.publisher_update("/t"));
        lists.push(update.params[2].clone());
        order.notify(now, A, topic("/t"), update);
    }
    // The notifications are sent one by one, as a master would send them.
    let (first, number) = sent(order.next_notification(now, A, &mirror));
    assert_eq!(first, lists[0]);
    order.notification_taken(number);
    // Another part of rosrescue asks for the present state, so older notifications are left out.
    order.notify_of_state(A, topic("/t"));
    order.begin_answer(
        now,
        vec![Recipient {
            port: A.to_owned(),
            subject: topic("/t"),
        }],
    );
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Wait { until: None }
    );
    order.answer_written(now, 2);
    let (last, number) = sent(order.next_notification(now + LEAD, A, &mirror));
    assert_eq!(last, lists[2]);
    order.notification_taken(number);
    assert_eq!(
        order.next_notification(now + LEAD, A, &mirror),
        NextNotification::Idle
    );
}

#[test]
fn notifications_that_pile_up_are_reduced_to_one_per_subject() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&call("subscribeParam", &["/a", "http://a:1/", "/k"]));
    for value in 0..1000 {
        let set = Request::new(
            Method::SetParam,
            [Value::from("/b"), "/k".into(), value.into()],
        );
        mirror.apply(&set);
        let update = Arc::new(mirror.param_update("/k/").unwrap());
        order.notify(now, A, param("/k/"), update);
    }
    let mut values = Vec::new();
    while let NextNotification::Send { call, number } = order.next_notification(now, A, &mirror) {
        values.push(call.params[2].as_int().unwrap());
        order.notification_taken(number);
    }
    assert!(values.is_sorted() && values.len() < 300, "{values:?}");
    assert_eq!(values.last(), Some(&999));
}

#[test]
fn our_notification_is_put_off_while_the_master_may_be_sending_one() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    let old = Arc::new(mirror.publisher_update("/t"));
    order.notify(now, A, topic("/t"), old);
    order.calls_sent(&[topic("/t")], Vec::new());
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Idle
    );
    mirror.apply(&publish("/b", "/t"));
    order.master_notifies(now, &topic("/t"), 1);
    assert!(!order.calls_settled());
    order.notify_of_state(A, topic("/t"));
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Idle
    );
    let later = order.next_repeat().unwrap();
    assert_eq!(later, now + MASTER_TAKES + REPEAT_AFTER);
    order.queue_due_repeats(later);
    let (list, number) = sent(order.next_notification(later, A, &mirror));
    assert_eq!(list, mirror.publisher_update("/t").params[2]);
    order.notification_taken(number);
    assert_eq!(
        order.next_notification(later, A, &mirror),
        NextNotification::Idle
    );
    // After the master's death, rosrescue's notification is sent at once. It is repeated, because the node may read the
    // master's notification later.
    order.master_notifies(later, &topic("/t"), 1);
    let update = Arc::new(mirror.publisher_update("/t"));
    order.notify(later, A, topic("/t"), update);
    let (_, number) = sent(order.next_notification(later, A, &mirror));
    order.notification_taken(number);
    assert_eq!(order.next_repeat(), Some(later + REPEAT_AFTER));
}

#[test]
fn what_a_late_master_still_has_to_send_comes_first() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    order.master_notifies(now, &topic("/t"), 1);
    let takes = MASTER_TAKES + REPEAT_AFTER;
    order.master_is_late(now);
    mirror.apply(&publish("/b", "/t"));
    let update = Arc::new(mirror.publisher_update("/t"));
    order.notify(now, A, topic("/t"), update.clone());
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Idle
    );
    // The master's notifications make no progress before it answers.
    let answered = now + 4 * takes;
    order.queue_due_repeats(answered);
    assert_eq!(
        order.next_notification(answered, A, &mirror),
        NextNotification::Idle
    );
    order.late_answered(answered);
    // It is examined. It is not gone before it must have sent them.
    let until = answered + takes;
    assert_eq!(order.master_is_away(answered), Some(until));
    order.notify(answered, A, topic("/t"), update.clone());
    assert_eq!(order.next_repeat(), Some(until));
    order.queue_due_repeats(until);
    let (list, number) = sent(order.next_notification(until, A, &mirror));
    assert_eq!(list, update.params[2]);
    order.notification_taken(number);
    // A master that has sent everything holds up nothing.
    assert!(order.is_late());
    order.notify(until, A, topic("/t"), update.clone());
    assert_eq!(
        sent(order.next_notification(until, A, &mirror)).0,
        update.params[2]
    );
    assert_eq!(order.master_is_away(until), None);
    assert!(!order.is_late());
}

#[test]
fn a_master_that_stays_late_is_not_waited_for_for_ever() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    order.master_notifies(now, &topic("/t"), 1);
    order.master_is_late(now);
    let update = Arc::new(mirror.publisher_update("/t"));
    order.notify(now, A, topic("/t"), update.clone());
    let mut at = now;
    while let Some(next) = order.next_repeat() {
        assert!(next > at && next < now + 2 * BACKLOG_MAX);
        at = next;
        order.queue_due_repeats(at);
        if let NextNotification::Send { call, number } = order.next_notification(at, A, &mirror) {
            assert_eq!(call, update);
            order.notification_taken(number);
        }
    }
    assert!(at >= now + BACKLOG_MAX);
    // A master that dies holds up nothing either.
    order.master_notifies(at, &topic("/t"), 1);
    order.master_is_gone();
    order.notify(at, A, topic("/t"), update.clone());
    assert_eq!(
        sent(order.next_notification(at, A, &mirror)).0,
        update.params[2]
    );
}

#[test]
fn the_state_is_told_again_if_the_master_notifies_shortly_after_an_answer() {
    let (mut order, now) = (Order::default(), Instant::now());
    let number = begin(&mut order, now, &subscribe("/a", "/t"));
    order.calls_sent([], vec![number]);
    // In a batch the master only notifies because of calls before the answered one, so the answer is newer.
    order.master_notifies(now, &topic("/t"), 1);
    order.calls_settled();
    assert_eq!(order.next_repeat(), None);
    order.answer_written(now, number);
    order.master_notifies(now, &topic("/t"), 1);
    assert!(order.has_new_repeat());
    let late = now + RECENT;
    order.master_notifies(late, &topic("/t"), 1);
    // The master's own notification takes the place of the repeat.
    assert_eq!(order.next_repeat(), None);
    assert_eq!(port_of("http://a:1/"), A);
}

/// With 60 busy processes on two cores, a repeat came before four older values of the master.
#[test]
fn a_master_that_answers_slowly_is_given_time_for_its_notifications() {
    let (mut order, now) = (Order::default(), Instant::now());
    let slow = Duration::from_millis(80);
    order.master_answered(2 * slow, 2);
    order.master_notifies(now, &topic("/t"), 3);
    let until = order.master_notifications.sent_by(now, &topic("/t"));
    assert_eq!(until, Some(now + 3 * slow + REPEAT_AFTER));
    // One quick answer does not prove that the backlog is gone; twenty do.
    order.master_answered(Duration::from_millis(1), 1);
    assert!(order.master_notifications.pace > slow / 2);
    for _ in 0..20 {
        order.master_answered(Duration::from_millis(1), 1);
    }
    let mut quick = Order::default();
    quick.master_notifications.pace = order.master_notifications.pace;
    quick.master_notifies(now, &topic("/t"), 1);
    let until = quick
        .master_notifications
        .sent_by(now, &topic("/t"))
        .unwrap();
    assert!(until < now + 2 * MASTER_TAKES + REPEAT_AFTER);
}

#[test]
fn a_parameter_that_is_set_again_and_again_takes_no_more_memory() {
    let (mut order, now) = (Order::default(), Instant::now());
    for step in 0..10_000 {
        let now = now + Duration::from_micros(100) * step;
        order.master_notifies(now, &param("/k/"), 4);
    }
    assert_eq!(
        order
            .master_notifications
            .sent_by
            .about(&param("/k/"))
            .count(),
        1
    );
    assert_eq!(order.master_notifications.schedule.queue.len(), 1);
    let until = order
        .master_notifications
        .sent_by(now, &param("/"))
        .unwrap();
    assert!(until < now + Duration::from_secs(1) + BACKLOG_MAX + 2 * REPEAT_AFTER);
    assert_eq!(order.master_notifications.sent_by(until, &param("/")), None);
}

/// Loggers subscribe to the same parameter again and again, even while the master runs a call of the same node.
#[test]
fn a_node_does_not_wait_for_its_own_registrations() {
    let mut order = Order::default();
    let watch = Concern::of_call(Some(&call("subscribeParam", &["/a", "http://a:1/", "/k"])));
    order.calls_sent(watch.notified_subjects(), Vec::new());
    assert!(!order.read_must_wait(&watch.recipients()));
}

/// Another sender, such as the last process of rosrescue, may have an older notification on its way.
#[test]
fn a_state_that_must_come_last_is_told_after_newer_notifications_of_the_master() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    let at = now + Duration::from_secs(1);
    order.notify_of_state_at(at, A, topic("/t"));
    order.master_notifies(now, &topic("/t"), 1);
    assert_eq!(order.next_repeat(), Some(at));
    order.master_notifies(at, &topic("/t"), 1);
    assert!(order.next_repeat() > Some(at));
    order.queue_due_repeats(at + Duration::from_secs(1));
    assert_eq!(order.next_repeat(), None);
    sent(order.next_notification(at + Duration::from_secs(1), A, &mirror));
}

/// A call in flight may make the master notify nodes, so ours is put off. But that call may change nothing.
#[test]
fn a_state_that_must_come_last_is_told_although_another_reason_had_put_it_off() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    mirror.apply(&subscribe("/a", "/t"));
    let end = now + Duration::from_secs(1);
    let idle = call("unregisterPublisher", &["/b", "/t", "http://b:1/"]);
    let concern = Concern::of_call(Some(&idle));
    order.calls_sent(concern.notified_subjects(), Vec::new());
    order.notify_of_state(A, topic("/t"));
    order.notify_of_state_at(end, A, topic("/t"));
    assert_eq!(
        order.next_notification(now, A, &mirror),
        NextNotification::Idle
    );
    // Put off once more while the call is still in flight.
    let soon = now + REPEAT_AFTER;
    order.queue_due_repeats(soon);
    assert_eq!(
        order.next_notification(soon, A, &mirror),
        NextNotification::Idle
    );
    order.calls_settled();
    order.master_notifies(soon, &topic("/t"), 1);
    let mut told = 0;
    while let Some(at) = order.next_repeat() {
        order.queue_due_repeats(at);
        if let NextNotification::Send { number, .. } = order.next_notification(at, A, &mirror) {
            order.notification_taken(number);
            told += usize::from(at >= end);
        }
    }
    assert_eq!(told, 1);
}

#[test]
fn what_is_told_while_notifications_of_an_earlier_process_may_arrive_is_told_again_after_them() {
    let (mut order, now, mut mirror) = (Order::default(), Instant::now(), Master::default());
    let end = now + Duration::from_secs(1);
    order.expect_earlier(end);
    mirror.apply(&subscribe("/a", "/t"));
    order.notify_of_state(A, topic("/t"));
    let (_, number) = sent(order.next_notification(now, A, &mirror));
    order.notification_taken(number);
    mirror.apply(&publish("/b", "/t"));
    assert_eq!(order.next_repeat(), Some(end));
    order.queue_due_repeats(end);
    let (publishers, number) = sent(order.next_notification(end, A, &mirror));
    assert_eq!(publishers, Value::Array(vec!["http://b:1/".into()]));
    order.notification_taken(number);
    assert_eq!(order.next_repeat(), None);
}
