//! The real queue, with a master that runs a call and dies.

use bytes::Bytes;
use rescue_core::{
    checkpoint::format::Session,
    health::port_of,
    lifecycle::Patience,
    order::{NextNotification as Notification, REPEAT_AFTER, Subject},
};
use ros1_master::{
    master::{Master, Method, Request},
    xmlrpc::{Reply, Value, encode_reply},
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;

use super::*;
use crate::{
    cli::{SyncPolicy, Writes},
    gate::State,
    ledger::Ledger,
    upstream::{Head, sentinel::Sentinel, test_master, verify::Verification},
    write_queue::{
        WriteQueue,
        batch::{AnswerAndDelivery, CallAnswer},
        dispatcher::PATIENCE,
        write_queue,
    },
};

const SUBSCRIBER: &str = "http://a:1/";
const PUBLISHER: &str = "http://b:1/";

/// The publishers in the notification that is sent now, if one is.
fn notified_value(ledger: &Ledger) -> Option<Value> {
    match ledger.with_order(|order, mirror| {
        order.next_notification(Instant::now(), port_of(SUBSCRIBER), mirror)
    }) {
        Notification::Send { call, number } => {
            ledger.release(|order| order.notification_taken(number));
            call.params.get(2).cloned()
        }
        _ => None,
    }
}

/// The queue of a master to which calls pass. This test is the master.
struct Served {
    ledger: Arc<Ledger>,
    queue: WriteQueue,
    listener: TcpListener,
    _sentinel: (TcpStream, Arc<Sentinel>),
}

impl Served {
    async fn new(mirror: Master) -> Self {
        let stats = Box::leak(Box::default());
        let (session, sync) = (Session::default(), SyncPolicy::Interval);
        let ledger = Ledger::new(mirror, session, Vec::new(), None, sync, stats);
        let ledger = Arc::new(ledger);
        ledger.succeed();
        ledger.open_gate();

        let (listener, accepted, upstream, sentinel) = test_master().await;
        upstream.set_verification(Some(Verification::Sentinel(sentinel.clone())));
        let patience = Patience::new(Duration::from_secs(60));
        let judge = Arc::new(());
        let (queue, drain) = write_queue(
            Link {
                ledger: ledger.clone(),
                upstream,
            },
            stats,
            None,
            judge,
            Writes::Master,
            patience,
        );
        tokio::spawn(drain.run());
        Self {
            ledger,
            queue,
            listener,
            _sentinel: (accepted, sentinel),
        }
    }

    async fn submit(&self, call: Request) -> oneshot::Receiver<AnswerAndDelivery> {
        let request = (Head::default(), Bytes::from_static(b"<methodCall/>"));
        let patience = Some(Instant::now() + PATIENCE);
        let (item, answered) = Item::of_client(request, Some(Arc::new(call)), patience);
        self.queue.submit(item).await;
        answered
    }
}

/// The master may have notified nodes of what a lost call changed. If rosrescue sent the state before that call, the
/// nodes would get an older list after a newer one.
#[tokio::test]
async fn nodes_are_not_told_the_state_before_a_lost_call() {
    let mut mirror = Master::default();
    for (method, node, api) in [
        (Method::RegisterSubscriber, "/a", SUBSCRIBER),
        (Method::RegisterPublisher, "/b", PUBLISHER),
    ] {
        mirror.apply(&Request::new(method, [node, "/t", "x/Y", api]));
    }
    let served = Served::new(mirror).await;
    let call = Request::new(Method::UnregisterPublisher, ["/b", "/t", PUBLISHER]);
    let answered = served.submit(call).await;
    // The master runs the call and dies before it has answered.
    let (mut connection, _) = served.listener.accept().await.unwrap();
    connection.read_u8().await.unwrap();
    drop(connection);
    served.queue.batch_lost().await;

    let ledger = &served.ledger;
    let topic = Subject::Topic("/t".to_owned());
    ledger.with_order(|order, _| order.notify_of_state(port_of(SUBSCRIBER), topic));
    assert_eq!(notified_value(ledger), None);
    served.ledger.shut_gate(State::StandingIn);
    answered.await.unwrap();
    ledger.with_order(|order, _| order.queue_due_repeats(Instant::now() + REPEAT_AFTER));
    assert_eq!(notified_value(ledger), Some(Value::Array(Vec::new())));
}

/// A multicall that reads what the master cannot return, and changes something else, runs and is answered with a fault.
/// After that answer nobody, on this or another computer, may read the state before.
#[tokio::test]
async fn a_fault_is_answered_when_what_ran_is_known_or_the_master_is_gone() {
    let served = Served::new(Master::default()).await;
    let set = Request::new(Method::SetParam, [Value::from("/n"), "/a".into(), 1.into()]);
    let mut answered = served.submit(Request::multicall([set])).await;
    let (mut connection, _) = served.listener.accept().await.unwrap();
    let mut request = Vec::new();
    while !request.ends_with(b"<methodCall/>") {
        request.push(connection.read_u8().await.unwrap());
    }
    let fault = encode_reply(&Reply::Fault {
        code: 1,
        text: "cannot marshal".to_owned(),
    });
    let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n", fault.len());
    connection.write_all(head.as_bytes()).await.unwrap();
    connection.write_all(&fault).await.unwrap();
    // The state is being read.
    connection.read_u8().await.unwrap();
    answered.try_recv().unwrap_err();

    drop(connection);
    served.ledger.shut_gate(State::StandingIn);
    let (answer, _) = answered.await.unwrap();
    let CallAnswer::Made(Reply::Value(Value::Array(results))) = answer else {
        panic!("{answer:?}");
    };
    assert_eq!(results.len(), 1);
}

/// While this process stood still, another computer may have led and acknowledged that the node has unregistered. Then
/// the registration changes something.
#[tokio::test]
async fn a_computer_without_a_lease_answers_no_write_that_seems_to_change_nothing() {
    let publish = Request::new(Method::RegisterPublisher, ["/b", "/t", "x/Y", PUBLISHER]);
    let mut mirror = Master::default();
    mirror.apply(&publish);
    let served = Served::new(mirror).await;
    served.ledger.lease.set(Some(Instant::now()));
    let mut while_open = served.submit(publish.clone()).await;
    let patience = tokio::time::sleep(2 * PATIENCE);
    tokio::select! {
        _ = &mut while_open => panic!("answered without a lease"),
        () = patience => {}
    }
    served.ledger.begin_injection();
    let mut while_frozen = served.submit(publish).await;
    tokio::select! {
        _ = &mut while_frozen => panic!("answered without a lease"),
        () = tokio::time::sleep(PATIENCE) => {}
    }
    served.ledger.shut_gate(State::StandingIn);
    served.ledger.lease.set(None);
    let answers = [while_open.await, while_frozen.await];
    assert!(answers.iter().all(Result::is_ok));
}
