//! The real queue, with a master that runs a call and dies before it answers.

use bytes::Bytes;
use tokio::io::AsyncReadExt;

use super::*;
use crate::{
    checkpoint::format::Session,
    cli::SyncPolicy,
    gate::gate,
    health::port_of,
    lifecycle::Patience,
    order::{NextNotification as Notification, REPEAT_AFTER, Subject},
    upstream::{Head, test_master, verify::Verification},
    write_queue::write_queue,
    xmlrpc::Value,
};

const SUBSCRIBER: &str = "http://a:1/";
const PUBLISHER: &str = "http://b:1/";

/// The publishers in the notification that is sent now, if one is.
fn told(ledger: &Ledger) -> Option<Value> {
    match ledger.with_order(|order, mirror| order.next(Instant::now(), port_of(SUBSCRIBER), mirror))
    {
        Notification::Send { call, number } => {
            ledger.release(|order| order.taken(number));
            call.params.get(2).cloned()
        }
        _ => None,
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
    let stats = Box::leak(Box::default());
    let (session, sync) = (Session::default(), SyncPolicy::Interval);
    let ledger = Ledger::new(mirror, session, Vec::new(), None, sync, stats);
    let ledger = Arc::new(ledger);
    ledger.succeed();
    let incarnation = ledger.serve();

    let (listener, _sentinel, upstream, sentinel) = test_master().await;
    upstream.set_verification(Some(Verification::Sentinel(sentinel)));
    let (gate_tx, gate) = gate();
    gate_tx.set(State::Open { incarnation });
    let patience = Patience::new(Duration::from_secs(60));
    let (queue, drain) = write_queue(
        ledger.clone(),
        upstream,
        gate,
        stats,
        None,
        Arc::new(()),
        patience,
    );
    tokio::spawn(drain.run());

    let call = Request::new(Method::UnregisterPublisher, ["/b", "/t", PUBLISHER]);
    let raw = Some((Head::default(), Bytes::from_static(b"<methodCall/>")));
    let (item, answered) = Item::new(raw, Some(Arc::new(call)));
    queue.submit(item).await;
    // The master runs the call and dies before it has answered.
    let (mut connection, _) = listener.accept().await.unwrap();
    connection.read_u8().await.unwrap();
    drop(connection);
    queue.lost().await;

    let topic = Subject::Topic("/t".to_owned());
    ledger.with_order(|order, _| order.tell_state(port_of(SUBSCRIBER), topic));
    assert_eq!(told(&ledger), None);
    gate_tx.set(State::StandingIn);
    answered.await.unwrap();
    ledger.with_order(|order, _| order.repeat(Instant::now() + REPEAT_AFTER));
    assert_eq!(told(&ledger), Some(Value::Array(Vec::new())));
}
