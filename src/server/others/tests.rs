//! Calls to a computer that leads, follows, or knows no leader.

use http_body_util::BodyExt;
use hyper::StatusCode;
use rescue_core::checkpoint::format::{Record, RecordContent, Session};
use ros1_master::{
    master::{Master, Method},
    xmlrpc::{Value, decode_reply, encode_reply},
};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpListener,
};

use super::{
    control::{HANDOVER, PASSED_ON},
    *,
};
use crate::{
    cli::{Reads, SyncPolicy, Writes},
    gate,
    ledger::Ledger,
    ros_env::MasterUri,
    upstream::{Upstream, pool::Pool},
    write_queue::{Link, write_queue},
};

const OWN: &str = "http://127.0.0.1:11311/";
const TERM: u64 = 7;

/// A following computer, and what the test controls.
struct Computer {
    calls: Calls,
    standing: watch::Sender<Standing>,
    /// How much of the journal this computer's mirror holds.
    followed: watch::Sender<JournalPosition>,
    handovers: mpsc::Receiver<Handover>,
}

fn position(term: u64, seq: u64) -> JournalPosition {
    JournalPosition {
        term,
        seq,
        ..JournalPosition::default()
    }
}

fn set(value: i32) -> Request {
    let params = [Value::from("/n"), "/a".into(), value.into()];
    Request::new(Method::SetParam, params)
}

fn get() -> Request {
    Request::new(Method::GetParam, ["/n", "/a"])
}

fn handover() -> Request {
    Request::new(Method::named(HANDOVER), ["/n", "pc-2"])
}

impl Computer {
    /// Creates a computer whose mirror holds one parameter.
    fn new(standing: Standing) -> Self {
        let stats = Box::leak(Box::default());
        let mut mirror = Master::default();
        mirror.apply(&set(1));
        let (session, sync) = (Session::default(), SyncPolicy::Interval);
        let ledger = Ledger::new(mirror, session, Vec::new(), None, sync, stats);
        let ledger = Arc::new(ledger);
        ledger.set_identity(42, OWN.to_owned());
        ledger.leave();
        ledger.shut_gate(gate::State::Elsewhere);
        let second = Duration::from_secs(1);
        let nobody = MasterUri::parse("http://127.0.0.1:1/").unwrap();
        let upstream = Arc::new(Upstream::new(nobody, second, 3));
        let (write_queue, _) = write_queue(
            Link {
                ledger: ledger.clone(),
                upstream: upstream.clone(),
            },
            stats,
            None,
            Arc::new(()),
            Writes::Master,
            rescue_core::lifecycle::Patience::new(second),
        );
        let (standing, standing_rx) = watch::channel(standing);
        let (handovers_tx, handovers) = mpsc::channel(1);
        let (tell_followed, followed) = watch::channel(JournalPosition::at_start());
        let calls = Calls {
            pool: Arc::new(Pool::new(1, upstream, ledger.clone())),
            gate: ledger.gate(),
            ledger,
            reads: Reads::Mirror,
            last_large: Default::default(),
            compared: Default::default(),
            write_queue,
            stats,
            uri: OWN.to_owned(),
            hold: second,
            others: Some(Others {
                standing: standing_rx,
                peers: Arc::new(Peers::new(second)),
                handovers: handovers_tx,
                passing: Arc::default(),
                forwarded: Arc::default(),
                served: Default::default(),
                members: Default::default(),
                followed,
                shown: Arc::new(Shown::new()),
                hold: second,
            }),
        };
        Self {
            calls,
            standing,
            followed: tell_followed,
            handovers,
        }
    }

    async fn ask(&self, path: &str, call: &Request) -> Result<HttpReply, Closed> {
        let head = Head {
            path: path.to_owned(),
            ..Head::default()
        };
        let body = call.encode().into();
        let from = "127.0.0.1:4000".parse().unwrap();
        self.calls
            .answer(from, head, body, Some(call.clone()))
            .await
    }
}

async fn reply(answer: HttpReply) -> Reply {
    let body = answer.into_body().collect().await.unwrap().to_bytes();
    decode_reply(&body).unwrap()
}

fn made_by(call: &Request) -> Reply {
    let mut model = Master::default();
    model.apply(&set(1));
    model.apply(call).reply
}

/// The answer that a leader gives to a call, if it gives one.
type LeaderAnswer = Option<(StatusCode, Vec<u8>)>;

/// A leader that says 421 to each call, or nothing at all.
async fn leader(says: Option<StatusCode>) -> Standing {
    leader_with(vec![says.map(|code| (code, Vec::new()))])
        .await
        .0
}

/// A leader that gives one of these answers after the other, and the last one to all later calls. Also returns how many
/// calls it has got.
async fn leader_with(answers: Vec<LeaderAnswer>) -> (Standing, watch::Receiver<usize>) {
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let (count, calls) = watch::channel(0);
    tokio::spawn(async move {
        let mut open = Vec::new();
        while let Ok((mut stream, _)) = listener.accept().await {
            request_body(&mut stream).await.unwrap();
            let nth = *count.borrow();
            count.send_replace(nth + 1);
            if let Some((code, body)) = &answers[nth.min(answers.len() - 1)] {
                let length = body.len();
                let head = format!("HTTP/1.1 {code}\r\nContent-Length: {length}\r\n\r\n");
                stream.write_all(head.as_bytes()).await.unwrap();
                stream.write_all(body).await.unwrap();
            }
            open.push(stream);
        }
    });
    let uri = format!("http://127.0.0.1:{port}/");
    (Standing::Follows { uri, term: TERM }, calls)
}

#[tokio::test]
async fn a_call_for_a_term_in_which_this_computer_does_not_lead_gets_421() {
    for standing in [
        Standing::Alone,
        Standing::Leads {
            term: 8,
            answers: AnsweredCalls::All,
        },
        Standing::NoLeader { known: true },
        leader(None).await,
    ] {
        let computer = Computer::new(standing);
        for call in [get(), set(2), handover()] {
            let answer = computer.ask("/cluster/7", &call).await.unwrap();
            assert_eq!(answer.status(), StatusCode::MISDIRECTED_REQUEST);
        }
    }
}

#[tokio::test]
async fn while_nobody_leads_reads_are_the_mirrors_and_a_write_waits_for_the_next_leader() {
    let computer = Computer::new(Standing::NoLeader { known: true });
    let answer = computer.ask("/RPC2", &get()).await.unwrap();
    assert_eq!(reply(answer).await, made_by(&get()));
    assert!(computer.ask("/RPC2", &set(2)).await.is_err());
    // Before the state is known there is nothing to answer with.
    computer
        .standing
        .send_replace(Standing::NoLeader { known: false });
    assert!(computer.ask("/RPC2", &get()).await.is_err());
}

#[tokio::test]
async fn a_read_falls_back_to_the_mirror_if_the_leader_is_silent_or_does_not_lead() {
    for says in [None, Some(StatusCode::MISDIRECTED_REQUEST)] {
        let computer = Computer::new(leader(says).await);
        let answer = computer.ask("/RPC2", &get()).await.unwrap();
        assert_eq!(reply(answer).await, made_by(&get()), "{says:?}");
        // A write waits until it is known which computer leads.
        let write = set(2);
        let waits = computer.ask("/RPC2", &write);
        assert!(
            tokio::time::timeout(Duration::from_millis(100), waits)
                .await
                .is_err()
        );
    }
    let gone = MasterUri::parse("http://127.0.0.1:1/").unwrap();
    let computer = Computer::new(Standing::Follows {
        uri: gone.to_string(),
        term: TERM,
    });
    let answer = computer.ask("/RPC2", &get()).await.unwrap();
    assert_eq!(reply(answer).await, made_by(&get()));
}

/// The leader may answer while the connections of this computer end.
#[tokio::test]
async fn a_call_at_the_leader_is_not_sent_again_when_this_computer_stops() {
    for call in [get(), set(2)] {
        let (silent, mut sent) = leader_with(vec![None]).await;
        let Computer {
            calls, standing, ..
        } = Computer::new(silent);
        let from = "127.0.0.1:4000".parse().unwrap();
        let head = Head {
            path: "/RPC2".to_owned(),
            ..Head::default()
        };
        let asked = calls.answer(from, head, call.encode().into(), Some(call.clone()));
        let stop = async {
            sent.wait_for(|count| *count > 0).await.unwrap();
            drop(standing);
        };
        let both = async { tokio::join!(asked, stop) };
        let _ = tokio::time::timeout(Duration::from_millis(200), both).await;
        // On a busy computer the call may not be there yet.
        let times = *sent.borrow();
        assert!(times <= 1, "{call:?} was sent {times} times");
    }
}

/// The next leader finds nothing to remove. The caller must not be told so if its own call has removed it, and must be
/// told so if another call has.
#[tokio::test]
async fn a_removal_counts_as_done_only_if_a_leader_may_have_run_it() {
    let api = "http://127.0.0.1:2/";
    let register = Request::new(Method::RegisterSubscriber, ["/n", "/t", "*", api]);
    let unregister = Request::new(Method::UnregisterSubscriber, ["/n", "/t", api]);
    let delete = Request::new(Method::DeleteParam, ["/n", "/a"]);
    let both = Request::multicall([get(), delete.clone()]);
    let mut mirror = Master::default();
    mirror.apply(&set(1));
    mirror.apply(&register);
    for remove in [&delete, &unregister, &both] {
        let mut after = mirror.clone();
        let done = after.apply(remove).reply;
        let nothing = after.apply(remove).reply;
        assert_ne!(done, nothing);
        let found_nothing = || Some((StatusCode::OK, encode_reply(&nothing)));
        let (silent, mut calls) = leader_with(vec![None]).await;
        let (next, _) = leader_with(vec![found_nothing()]).await;
        let refuses = Some((StatusCode::MISDIRECTED_REQUEST, Vec::new()));
        let (refusing, _) = leader_with(vec![refuses, found_nothing()]).await;

        let computer = Computer::new(silent);
        computer
            .calls
            .ledger
            .follow_state(1, mirror.clone())
            .unwrap();
        let takeover = async {
            calls.wait_for(|count| *count > 0).await.unwrap();
            computer.standing.send_replace(next);
        };
        let (answer, ()) = tokio::join!(computer.ask("/RPC2", remove), takeover);
        assert_eq!(reply(answer.unwrap()).await, done);

        computer.standing.send_replace(refusing);
        let answer = computer.ask("/RPC2", remove).await.unwrap();
        assert_eq!(reply(answer).await, nothing);
    }
}

#[tokio::test]
async fn who_and_where_the_master_is_each_computer_says_of_itself() {
    let computer = Computer::new(Standing::NoLeader { known: false });
    let uri = Request::new(Method::GetUri, ["/n"]);
    let answer = reply(computer.ask("/RPC2", &uri).await.unwrap()).await;
    let Reply::Value(answer) = answer else {
        panic!("{answer:?}");
    };
    assert_eq!(answer.as_array().unwrap()[2], OWN.into());
}

#[tokio::test]
async fn a_write_that_no_record_holds_is_refused_before_it_is_run() {
    let computer = Computer::new(Standing::Leads {
        term: TERM,
        answers: AnsweredCalls::All,
    });
    let body = Bytes::from(vec![b' '; RECORD_BYTES_MAX + 1]);
    let from = "127.0.0.1:4000".parse().unwrap();
    let ask = |call| {
        computer
            .calls
            .answer(from, Head::default(), body.clone(), call)
    };
    for call in [Some(set(2)), None] {
        let answer = reply(ask(call).await.unwrap()).await;
        let Reply::Fault { text, .. } = answer else {
            panic!("{answer:?}");
        };
        assert!(text.contains("67108865 bytes"), "{text}");
    }
}

#[tokio::test]
async fn a_handover_is_asked_for_where_this_computer_leads_and_is_done_or_refused() {
    let mut computer = Computer::new(Standing::Leads {
        term: TERM,
        answers: AnsweredCalls::All,
    });
    for told in [Ok("pc-1".to_owned()), Err("no other computer".to_owned())] {
        let call = handover();
        let mut handovers = std::mem::replace(&mut computer.handovers, mpsc::channel(1).1);
        let (answer, ()) = tokio::join!(computer.ask("/RPC2", &call), async {
            let (to, tell) = handovers.recv().await.unwrap();
            assert_eq!(to, "pc-2");
            tell.send(told.clone()).unwrap();
        });
        computer.handovers = handovers;
        let expected: Value = match &told {
            Ok(who) => vec![
                1.into(),
                "another computer may lead now".into(),
                who.as_str().into(),
            ],
            Err(why) => vec![Value::from(0), why.as_str().into(), "".into()],
        }
        .into();
        assert_eq!(reply(answer.unwrap()).await, Reply::Value(expected));
    }
}

#[tokio::test]
async fn a_handover_is_sent_once_to_a_leader_that_does_not_answer() {
    let computer = Computer::new(leader(Some(StatusCode::MISDIRECTED_REQUEST)).await);
    let answer = reply(computer.ask("/RPC2", &handover()).await.unwrap()).await;
    let Reply::Value(answer) = answer else {
        panic!("{answer:?}");
    };
    let answer = answer.as_array().unwrap();
    assert_eq!(answer[0], 0.into());
    assert_eq!(answer[1], "the leader does not answer".into());
}

/// A follower passes on to its caller what a leader answers, and tells the leader when the caller
/// has it.
#[tokio::test]
async fn a_follower_tells_its_leader_when_the_caller_has_the_answer() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let (tell, mut bodies) = mpsc::channel(8);
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let tell = tell.clone();
            tokio::spawn(async move {
                while let Some(body) = request_body(&mut stream).await {
                    let _ = tell.send(body).await;
                    let reply = encode_reply(&made_by(&get()));
                    let head = format!(
                        "HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\n{}: 42\r\nContent-Length: {}\r\n\r\n",
                        peer::ANSWER_HEADER,
                        reply.len()
                    );
                    let _ = stream.write_all(&[head.into_bytes(), reply].concat()).await;
                }
            });
        }
    });
    let uri = format!("http://127.0.0.1:{port}/");
    let computer = Computer::new(Standing::Follows { uri, term: TERM });
    let mut answer = computer.ask("/", &get()).await.unwrap();
    assert!(bodies.recv().await.unwrap().contains("getParam"));
    let held: UntilWritten = answer.extensions_mut().remove().unwrap();
    tokio::task::yield_now().await;
    assert!(bodies.try_recv().is_err());
    drop(held);
    let told = bodies.recv().await.unwrap();
    assert!(told.contains(PASSED_ON) && told.contains("42"), "{told}");
}

/// The body of the next request on `stream`.
async fn request_body(stream: &mut tokio::net::TcpStream) -> Option<String> {
    let mut text = Vec::new();
    loop {
        let mut byte = [0];
        stream.read_exact(&mut byte).await.ok()?;
        text.extend(byte);
        if text.ends_with(b"\r\n\r\n") {
            break;
        }
    }
    let head = String::from_utf8(text).ok()?.to_lowercase();
    let (_, length) = head.split_once("content-length: ")?;
    let length = length.lines().next()?.trim().parse().ok()?;
    let mut body = vec![0; length];
    stream.read_exact(&mut body).await.ok()?;
    String::from_utf8(body).ok()
}

/// A caller on one computer never sees an older state than before. A mirror that is behind does not answer, however
/// long it takes.
#[tokio::test(start_paused = true)]
async fn a_read_by_the_mirror_waits_for_what_the_leaders_answers_have_told_of() {
    let computer = Computer::new(Standing::NoLeader { known: true });
    let others = computer.calls.others.clone().unwrap();
    let shown = |term, seq| others.shown.raise(position(term, seq));
    let follows = |term, seq| computer.followed.send_replace(position(term, seq));
    let later = others.hold / 2;
    let get = get();
    shown(TERM, 7);
    // The last position comes from a second leader. The first leader announced records that it did not commit, so those
    // records are gone.
    for (term, seq) in [(TERM, 7), (TERM + 1, 8)] {
        let start = Instant::now();
        let behind = async {
            follows(TERM, seq - 1);
            tokio::time::sleep(later).await;
            follows(term, 7);
        };
        let (answer, _) = tokio::join!(computer.ask("/", &get), behind);
        assert_eq!(reply(answer.unwrap()).await, made_by(&get));
        assert_eq!(start.elapsed(), later);
        shown(TERM, 8);
    }
    shown(TERM + 1, 9);
    assert!(computer.ask("/", &get).await.is_err(), "it is never fresh");
}

/// The cable to the leader is cut, and its last record does not arrive. When this computer is alone, it answers.
#[tokio::test]
async fn a_read_waits_for_a_silent_leader_only_until_this_computer_is_alone() {
    let (silent, mut calls) = leader_with(vec![None]).await;
    let computer = Computer::new(silent);
    let others = computer.calls.others.as_ref().unwrap();
    others.shown.raise(position(TERM, 7));
    let get = get();
    let alone = async {
        calls.wait_for(|count| *count > 0).await.unwrap();
        computer.calls.ledger.shut_gate(gate::State::StandingIn);
        computer.standing.send_replace(Standing::Alone);
    };
    let answer = async { tokio::join!(computer.ask("/RPC2", &get), alone).0 };
    let answer = tokio::time::timeout(10 * others.hold, answer).await;
    let answer = answer.expect("the read ends").unwrap();
    assert_eq!(reply(answer).await, made_by(&get));
}

/// `rospy.loginfo` and `get_param_cached` call `subscribeParam` each time.
#[tokio::test]
async fn a_subscription_that_is_there_already_waits_for_no_leader() {
    let subscribe = |key| Request::new(Method::SubscribeParam, ["/n", "http://n:1/", key]);
    let record = Record {
        seq: 1,
        entry: RecordContent::call(subscribe("/a")),
    };
    let prompt = 5 * PATIENCE;
    for standing in [leader(None).await, Standing::NoLeader { known: true }] {
        let computer = Computer::new(standing);
        computer
            .calls
            .ledger
            .follow(std::slice::from_ref(&record))
            .unwrap();
        let (there, new) = (subscribe("/a"), subscribe("/b"));
        let answer = tokio::time::timeout(prompt, computer.ask("/RPC2", &there)).await;
        let expected = made_by(&there);
        assert_eq!(reply(answer.unwrap().unwrap()).await, expected);
        // Only the leader may answer a new subscription.
        let answer = tokio::time::timeout(prompt, computer.ask("/RPC2", &new)).await;
        assert!(answer.is_err());
    }
}
