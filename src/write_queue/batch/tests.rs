use rescue_core::checkpoint::format::Session;
use ros1_master::{master::Master, xmlrpc::Struct};

use super::*;
use crate::{cli::SyncPolicy, ledger::Ledger};

fn item(call: Request) -> Item {
    let body = Bytes::from(call.encode());
    Item::of_client((Head::default(), body), Some(Arc::new(call)), None).0
}

#[test]
fn a_node_knows_better_only_by_the_contrary() {
    let last_calls = |registered, unregistered| LastCalls {
        registered,
        unregistered,
    };
    let condition = Precondition {
        node: "/n".to_owned(),
        last_calls: last_calls(3, 2),
    };
    for (kind, now, holds) in [
        (Kind::Unregister, last_calls(3, 4), true),
        (Kind::Unregister, last_calls(4, 2), false),
        (Kind::Mutate, last_calls(4, 2), true),
        (Kind::Mutate, last_calls(3, 4), false),
    ] {
        assert_eq!(condition.holds(kind, now), holds, "{kind:?} {now:?}");
    }
}

fn set(key: &str, value: impl Into<Value>) -> Request {
    Request::new(
        Method::SetParam,
        [Value::from("/n"), key.into(), value.into()],
    )
}

fn packed(calls: Vec<Request>) -> Vec<usize> {
    let mut queue: VecDeque<_> = calls.into_iter().map(item).collect();
    let mut sizes = Vec::new();
    let ledger = ledger();
    while !queue.is_empty() {
        let batch = next(&ledger, &mut queue);
        sizes.push(batch.items.len());
    }
    sizes
}

fn ledger() -> Arc<Ledger> {
    let (session, sync) = (Session::default(), SyncPolicy::Interval);
    let stats = Box::leak(Box::default());
    let ledger = Ledger::new(Master::default(), session, Vec::new(), None, sync, stats);
    Arc::new(ledger)
}

fn next(ledger: &Arc<Ledger>, queue: &mut VecDeque<Item>) -> Batch {
    let delivery = |number| Delivery::new(ledger, number);
    ledger.with_order(|order, _| pack(queue, order, Instant::now(), delivery))
}

fn publish(node: &str, topic: &str) -> Request {
    let params = [node, topic, "std_msgs/String", &format!("http://{node}:1/")];
    Request::new(Method::RegisterPublisher, params)
}

fn subscribe(node: &str, topic: &str) -> Request {
    let params = [node, topic, "*", &format!("http://{node}:1/")];
    Request::new(Method::RegisterSubscriber, params)
}

/// The callers and methods of a batch.
fn described(batch: &Batch) -> Vec<String> {
    batch.items.iter().map(Item::describe).collect()
}

#[test]
fn a_publisher_waits_for_the_answers_to_subscribers_and_nothing_else_does() {
    let ledger = ledger();
    let calls = [
        subscribe("/a", "/t"),
        publish("/b", "/t"),
        subscribe("/c", "/t"),
        publish("/d", "/u"),
    ];
    let mut queue: VecDeque<_> = calls.into_iter().map(item).collect();
    let first = next(&ledger, &mut queue);
    // Later calls about the same topic wait behind the publisher.
    let both = ["registerSubscriber of /a", "registerPublisher of /d"];
    assert_eq!(described(&first), both);
    assert!(next(&ledger, &mut queue).items.is_empty());
    let mut changed = ledger.order_changed();
    assert!(!changed.has_changed().unwrap());
    drop(first);
    assert!(changed.has_changed().unwrap());
    changed.mark_unchanged();
    let second = next(&ledger, &mut queue);
    let both = ["registerPublisher of /b", "registerSubscriber of /c"];
    assert_eq!(described(&second), both);
}

#[test]
fn an_answer_that_its_client_does_not_read_delays_others_only_briefly() {
    let ledger = ledger();
    let mut queue = VecDeque::from([item(subscribe("/a", "/t")), item(publish("/b", "/t"))]);
    let first = next(&ledger, &mut queue);
    let waits = next(&ledger, &mut queue);
    assert!(waits.items.is_empty() && waits.until.is_none());
    let looks_again = ledger.order_changed();
    first.items[0].delivery.as_ref().unwrap().ready();
    assert!(looks_again.has_changed().unwrap());
    let waits = next(&ledger, &mut queue);
    assert!(waits.items.is_empty());
    let until = waits.until.unwrap();
    let later = ledger.with_order(|order, _| {
        let delivery = |number| Delivery::new(&ledger, number);
        pack(&mut queue, order, until, delivery)
    });
    assert_eq!(described(&later), ["registerPublisher of /b"]);
}

#[test]
fn calls_by_rosrescue_and_undecodable_calls_overtake_nothing() {
    let ledger = ledger();
    let unreadable = || Item::of_client((Head::default(), Bytes::new()), None, None).0;
    let own = || Item::new(MadeBy::Rosrescue(None), Some(Arc::new(set("/x", 1)))).0;
    for last in [own, unreadable] {
        let calls = [subscribe("/a", "/t"), publish("/b", "/t")];
        let mut queue: VecDeque<_> = calls.into_iter().map(item).collect();
        queue.extend([last(), item(set("/y", 1))]);
        let first = next(&ledger, &mut queue);
        assert_eq!(first.items.len(), 1);
        assert!(next(&ledger, &mut queue).items.is_empty());
        drop(first);
        let second = next(&ledger, &mut queue);
        assert_eq!(described(&second)[0], "registerPublisher of /b");
    }
}

#[test]
fn calls_that_may_share_are_one_batch_and_keep_their_order() {
    let subscribe = Request::new(
        Method::SubscribeParam,
        [Value::from("/n"), "http://n:1/".into(), "/k".into()],
    );
    let calls = vec![set("/a", 1), set("/b", 2), subscribe, set("/c", 3)];
    assert_eq!(packed(calls), [2, 1, 1]);
    assert_eq!(
        packed((0..250).map(|i| set("/a", i)).collect()),
        [100, 100, 50]
    );
    let big = "x".repeat(BYTES_MAX / 2 + 1);
    assert_eq!(
        packed(vec![set("/a", &*big), set("/b", &*big), set("/c", 1)]),
        [1, 2]
    );
}

#[test]
fn a_single_call_goes_out_as_its_own_bytes() {
    let body = Bytes::from_static(b"<methodCall> odd </methodCall>");
    let call = Some(Arc::new(set("/a", 1)));
    let (odd, _) = Item::of_client((Head::default(), body.clone()), call, None);
    assert_eq!(outbound(&[odd]).1, body);
    let (_, both) = outbound(&[item(set("/a", 1)), item(set("/b", 2))]);
    let expected = Request::multicall([set("/a", 1), set("/b", 2)]);
    assert_eq!(Request::decode(&both).unwrap(), expected);
}

#[test]
fn a_batch_reply_is_split_only_if_it_has_every_result() {
    let fault = Struct::from([
        ("faultCode".to_owned(), Value::Int(1)),
        ("faultString".to_owned(), Value::from("no")),
    ]);
    let reply = Reply::Value(Value::Array(vec![
        Value::from(vec![Value::from(7)]),
        Value::Struct(fault),
    ]));
    let replies = vec![
        Reply::Value(Value::Int(7)),
        Reply::Fault {
            code: 1,
            text: "no".to_owned(),
        },
    ];
    assert_eq!(unpack(&reply, 2), Some(replies));
    assert_eq!(unpack(&reply, 3), None);
    assert_eq!(
        unpack(
            &Reply::Fault {
                code: 1,
                text: String::new()
            },
            0
        ),
        None
    );
}

#[test]
fn the_masters_own_address_becomes_ours() {
    let answer = |uri: &str| Value::Array(vec![1.into(), "".into(), uri.into()]);
    let call = Request::new(Method::GetUri, [Value::from("/n")]);
    let reply = with_uri(&call, Reply::Value(answer("http://m:1/")), "http://us:2/");
    assert_eq!(reply, Reply::Value(answer("http://us:2/")));
    let both = Request::multicall([Request::new(Method::GetPid, [Value::from("/n")]), call]);
    let results = |uri: &str| {
        let pid = Value::Array(vec![1.into(), "".into(), 42.into()]);
        Reply::Value(Value::Array(vec![
            vec![pid].into(),
            vec![answer(uri)].into(),
        ]))
    };
    let reply = with_uri(&both, results("http://m:1/"), "http://us:2/");
    assert_eq!(reply, results("http://us:2/"));
    let nested = Request::multicall([both.clone()]);
    let within = |reply: Reply| match reply {
        Reply::Value(value) => Reply::Value(vec![Value::Array(vec![value])].into()),
        fault => fault,
    };
    let reply = with_uri(&nested, within(results("http://m:1/")), "http://us:2/");
    assert_eq!(reply, within(results("http://us:2/")));
    assert!(asks_uri(&both) && asks_uri(&nested));
    assert!(!asks_uri(&Request::multicall([Request::new(
        Method::GetPid,
        ["/n"]
    )])));
}
