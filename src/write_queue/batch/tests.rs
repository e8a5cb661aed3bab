use super::*;
use crate::xmlrpc::Struct;

fn item(call: Request) -> Item {
    let body = Bytes::from(xmlrpc::encode_call(&call.clone().into()));
    Item {
        raw: Some((Head::default(), body)),
        call: Some(Arc::new(call)),
        answer: oneshot::channel().0,
        condition: None,
        way_made: false,
    }
}

#[test]
fn a_node_knows_better_only_by_the_contrary() {
    let last_calls = |registered, unregistered| LastCalls {
        registered,
        unregistered,
    };
    let condition = Condition {
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
    while !queue.is_empty() {
        sizes.push(pack(&mut queue).len());
    }
    sizes
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
    let mut odd = item(set("/a", 1));
    odd.raw = Some((Head::default(), body.clone()));
    assert_eq!(outbound(&[odd]).1, body);
    let (_, both) = outbound(&[item(set("/a", 1)), item(set("/b", 2))]);
    let expected = Request::multicall([set("/a", 1), set("/b", 2)]);
    assert_eq!(Request::decode(&both).unwrap(), expected);
}

#[test]
fn replies_come_apart_only_when_each_is_there() {
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
