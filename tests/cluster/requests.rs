//! Requests to etcd while members die, hang, are full, or have no majority.

use std::time::{Duration, Instant};

use rescue_core::cluster::{
    journal::{Keys, Put},
    machine::{EtcdAnswer, Op, RevisionGuard},
    member::{Evidence, MemberEntry},
};
use rosrescue::cluster::etcd::{Credentials, Etcd, EtcdError, Options};
use serde_json::json;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpListener,
};

use crate::servers::{LIMIT, Servers, keys, settings};

fn entry(seq: u64) -> Put {
    Put {
        key: keys().journal(seq),
        value: format!("record {seq}").into_bytes(),
    }
}

fn beat(guard: RevisionGuard, beat: u64, seq: u64) -> Op {
    Op::Beat {
        guard,
        claim: 1,
        claimed_at: 0,
        beat,
        seq,
        released: None,
        settled: true,
    }
}

#[tokio::test]
async fn only_one_claim_succeeds_and_a_repeated_request_has_one_effect() {
    let servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    let claim = |claim| Op::Claim {
        guard: RevisionGuard::default(),
        claim,
        begins: Some(1),
        seq: 0,
        settled: false,
    };
    let a = settings("a");
    let first = client
        .run(&keys, &a, &claim(1), None, None, LIMIT)
        .await
        .unwrap();
    let EtcdAnswer::Applied {
        revision: term,
        seq: 0,
    } = first
    else {
        panic!("{first:?}");
    };
    // The answer to the second claim names the present leader.
    let second = client
        .run(&keys, &settings("b"), &claim(1), None, None, LIMIT)
        .await
        .unwrap();
    let EtcdAnswer::Is(view) = second else {
        panic!("{second:?}");
    };
    assert_eq!((view.origin, view.journal_number), (term, 1));
    let leader = view.leader.clone().unwrap();
    assert_eq!(
        (leader.term, leader.name.as_str(), leader.id.as_str()),
        (term, "a", "a-1")
    );
    assert_eq!(
        (leader.uri.as_str(), leader.version.as_str()),
        ("http://a:11311", "0.1.0")
    );
    // The same heartbeat is sent twice.
    let op = beat(view.guard(), 1, 7);
    let made = client
        .run(&keys, &a, &op, Some(&entry(7)), None, LIMIT)
        .await
        .unwrap();
    assert!(
        matches!(made, EtcdAnswer::Applied { seq: 7, .. }),
        "{made:?}"
    );
    let again = client
        .run(&keys, &a, &op, Some(&entry(7)), None, LIMIT)
        .await
        .unwrap();
    let EtcdAnswer::Is(view) = again else {
        panic!("{again:?}");
    };
    assert_eq!(
        view.alive.as_ref().map(|alive| (alive.beat, alive.seq)),
        Some((1, 7))
    );
    assert_eq!(
        client
            .run(&keys, &a, &Op::Read, None, None, LIMIT)
            .await
            .unwrap(),
        EtcdAnswer::Is(view.clone())
    );
    // Only the leader may write parts and delete.
    assert!(client.put(&keys, term, &[entry(3)], LIMIT).await.unwrap());
    assert!(
        !client
            .put(&keys, term + 1, &[entry(4)], LIMIT)
            .await
            .unwrap()
    );
    let journal = client.range(&keys.journal_after(0), LIMIT).await.unwrap();
    let found: Vec<_> = journal
        .kvs
        .iter()
        .map(|kv| keys.seq_of(&kv.key).unwrap())
        .collect();
    assert_eq!(found, [3, 7]);
    assert!(
        !client
            .delete(&keys, term + 1, &keys.behind(7), LIMIT)
            .await
            .unwrap()
    );
    assert!(
        client
            .delete(&keys, term, &keys.behind(4), LIMIT)
            .await
            .unwrap()
    );
    assert_eq!(
        client
            .range(&keys.journal_after(0), LIMIT)
            .await
            .unwrap()
            .kvs
            .len(),
        1
    );
}

#[tokio::test]
async fn a_range_is_read_in_pages_of_the_same_revision() {
    let servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    // There is no leader, so the term is 0.
    let puts: Vec<_> = (1..=100).map(entry).collect();
    assert!(client.put(&keys, 0, &puts, LIMIT).await.unwrap());
    let found = client.range(&keys.journal_after(0), LIMIT).await.unwrap();
    let written: Vec<_> = found
        .kvs
        .into_iter()
        .map(|kv| Put {
            key: kv.key,
            value: kv.value,
        })
        .collect();
    assert_eq!(written, puts);
}

#[tokio::test]
async fn a_member_that_dies_or_hangs_is_skipped() {
    let mut servers = Servers::new(3).await;
    let (client, keys) = (servers.client(), keys());
    let mut seq = 0;
    let mut longest = Duration::ZERO;
    for member in 0..servers.count() {
        for hangs in [false, true] {
            if hangs {
                servers.stop(member)
            } else {
                servers.kill(member)
            }
            for _ in 0..5 {
                seq += 1;
                let start = Instant::now();
                let put = client.put(&keys, 0, &[entry(seq)], LIMIT).await;
                longest = longest.max(start.elapsed());
                assert!(put.unwrap(), "{seq}");
            }
            if hangs {
                servers.go_on(member)
            } else {
                servers.start(member)
            }
        }
    }
    let found = client.range(&keys.journal_after(0), LIMIT).await.unwrap();
    assert_eq!(found.kvs.len() as u64, seq);
    println!("the longest of {seq} writes took {longest:?}");
}

#[tokio::test]
async fn without_a_majority_requests_fail_with_a_clear_error() {
    let mut servers = Servers::new(3).await;
    let (client, keys) = (servers.client(), keys());
    servers.kill(1);
    servers.kill(2);
    let start = Instant::now();
    loop {
        let (asked, limit) = (Instant::now(), Duration::from_secs(2));
        let error = client.put(&keys, 0, &[entry(1)], limit).await.unwrap_err();
        assert!(asked.elapsed() >= limit, "{error}");
        let said = error.to_string();
        if said.contains("cannot connect to etcd at http://127.0.0.1:") {
            break;
        }
        // A busy computer may not have got to the second server.
        assert!(start.elapsed() < LIMIT, "{said}");
    }
    // The remaining member notices that it has no majority when its own election timeout is over.
    let mut statuses = client.status(LIMIT).await;
    while start.elapsed() < LIMIT && statuses[0].as_ref().unwrap().errors.is_empty() {
        statuses = client.status(LIMIT).await;
    }
    let errors = &statuses[0].as_ref().unwrap().errors;
    assert!(
        errors.iter().any(|error| error.contains("no leader")),
        "{statuses:?}"
    );
    assert!(statuses[1].is_err(), "{statuses:?}");
    servers.start(2);
    assert!(client.put(&keys, 0, &[entry(1)], LIMIT).await.unwrap());
}

#[tokio::test]
async fn a_key_expires_with_its_lease() {
    let servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    let lease = client.grant(Duration::from_secs(5), LIMIT).await.unwrap();
    let put = Put {
        key: keys.member("a"),
        value: b"here".to_vec(),
    };
    client.put_with_lease(&put, lease, LIMIT).await.unwrap();
    let mut watch = client.watch(keys.small(), 0, LIMIT);
    let there = watch.next().await.unwrap();
    assert_eq!(there[0].kv.as_ref().unwrap().value, b"here");
    let gone = watch.next().await.unwrap();
    assert_eq!(
        (gone[0].key.as_str(), gone[0].kv.is_none()),
        (put.key.as_str(), true)
    );
}

#[tokio::test]
async fn a_full_etcd_is_reported_can_be_read_and_later_accepts_writes() {
    let quota = ["--quota-backend-bytes", "8388608"];
    let servers = Servers::with(crate::support::Scratch::new(), 1, "http", &quota).await;
    let (client, keys) = (servers.client(), keys());
    let large = |seq| Put {
        key: keys.journal(seq),
        value: vec![b'x'; 1 << 20],
    };
    let mut seq = 0;
    let error = loop {
        seq += 1;
        assert!(seq < 20, "etcd never becomes full");
        if let Err(error) = client.put(&keys, 0, &[large(seq)], LIMIT).await {
            break error;
        }
    };
    assert!(matches!(error, EtcdError::Full), "{error}");
    assert!(
        error.to_string().contains("etcdctl alarm disarm"),
        "{error}"
    );
    let found = client.range(&keys.journal_after(0), LIMIT).await.unwrap();
    assert!(!found.kvs.is_empty());
    // rosrescue can only delete entries. The operator must compact, defragment and disarm the alarm.
    assert!(
        client
            .delete(&keys, 0, &keys.behind(seq), LIMIT)
            .await
            .unwrap()
    );
    client.compact(found.revision + 1, LIMIT).await.unwrap();
    // Compacting twice is not an error.
    client.compact(found.revision + 1, LIMIT).await.unwrap();
    servers.post("maintenance/defragment", &json!({}));
    let alarms = servers.post("maintenance/alarm", &json!({ "action": "GET" }));
    let member = alarms["alarms"][0]["memberID"].clone();
    let disarm = json!({ "action": "DEACTIVATE", "memberID": member, "alarm": "NOSPACE" });
    servers.post("maintenance/alarm", &disarm);
    assert!(client.put(&keys, 0, &[large(seq)], LIMIT).await.unwrap());
}

#[tokio::test]
async fn a_request_that_is_too_large_has_its_own_error() {
    let servers = Servers::new(1).await;
    let large = Put {
        key: keys().journal(1),
        value: vec![b'x'; 1600 << 10],
    };
    let error = servers
        .client()
        .put(&keys(), 0, &[large], LIMIT)
        .await
        .unwrap_err();
    assert!(matches!(error, EtcdError::TooLarge), "{error}");
}

#[tokio::test]
async fn each_endpoint_is_tried_separately_and_a_wrong_one_is_named() {
    let servers = Servers::new(1).await;
    let endpoints = |port| vec![servers.endpoints(0)[0].clone(), port];
    let unknown = "http://nobody.invalid:2379".to_owned();
    let client = |second| {
        let access = Credentials::default();
        let endpoints = endpoints(second);
        Etcd::new(&Options { endpoints, access }).unwrap()
    };
    let keys = keys();
    for (wrong, is_expected) in [
        (
            servers.peer(0),
            (|error| matches!(error, EtcdError::PeerPort { .. })) as fn(&EtcdError) -> bool,
        ),
        (unknown, |error| matches!(error, EtcdError::Connect { .. })),
    ] {
        let client = client(wrong.clone());
        let [good, bad] = <[_; 2]>::try_from(client.try_each(&keys, LIMIT).await).unwrap();
        assert_ne!(good.cluster.unwrap(), 0);
        assert_eq!(bad.endpoint, wrong);
        let error = bad.cluster.unwrap_err();
        assert!(
            is_expected(&error) && error.to_string().contains(&wrong),
            "{error}"
        );
        client.view(&keys, LIMIT).await.unwrap();
    }
}

/// An endpoint at ROS's port: rosrescue answers with status 200 and a fault.
#[tokio::test]
async fn an_endpoint_that_is_no_etcd_but_answers_is_passed_over() {
    let servers = Servers::new(1).await;
    let other = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let wrong = format!("http://{}", other.local_addr().unwrap());
    let answers = tokio::spawn(async move {
        loop {
            let (mut stream, _) = other.accept().await.unwrap();
            let answer = b"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: 6\r\n\r\n<xml/>";
            // The client may have gone.
            let _ = stream.read(&mut [0; 4096]).await;
            let _ = stream.write_all(answer).await;
        }
    });
    let client = |endpoints| {
        let access = Credentials::default();
        Etcd::new(&Options { endpoints, access }).unwrap()
    };
    let both = client(vec![wrong.clone(), servers.endpoints(0)[0].clone()]);
    for _ in 0..3 {
        both.view(&keys(), LIMIT).await.unwrap();
    }
    let alone = client(vec![wrong.clone()]);
    let start = Instant::now();
    loop {
        let error = alone.view(&keys(), Duration::from_secs(2)).await;
        let error = error.unwrap_err().to_string();
        if error.starts_with(&format!("{wrong} does not answer as etcd")) {
            break;
        }
        // On a busy computer the answer may come too late.
        assert!(start.elapsed() < LIMIT, "{error}");
    }
    answers.abort();
}

/// etcd has lost data again since the entry was written, perhaps a journal that this computer has not seen.
#[tokio::test]
async fn a_claim_does_not_succeed_without_the_member_entries_that_it_requires() {
    let servers = Servers::new(1).await;
    let (client, keys) = (servers.client(), keys());
    let claim = Op::Claim {
        guard: RevisionGuard::default(),
        claim: 1,
        begins: Some(3),
        seq: 0,
        settled: true,
    };
    let [earlier, own] = ["following", "alone"].map(|role| MemberEntry {
        uri: String::new(),
        version: String::new(),
        role: role.to_owned(),
        seq: 0,
        boot: String::new(),
        holds: None,
        unreadable: 0,
        notifies: String::new(),
    });
    let put = async |name: &str, entry: &MemberEntry| {
        let (key, value) = (keys.member(name), serde_json::to_vec(entry).unwrap());
        let lease = client.grant(Duration::from_secs(60), LIMIT).await.unwrap();
        let put = Put { key, value };
        client.put_with_lease(&put, lease, LIMIT).await.unwrap();
        client.view(&keys, LIMIT).await.unwrap().revision
    };
    let succeeds = async |read_up_to| {
        let own = own.clone();
        let requires = Some(&Evidence { own, read_up_to });
        let a = settings("a");
        let answer = client.run(&keys, &a, &claim, None, requires, LIMIT).await;
        matches!(answer.unwrap(), EtcdAnswer::Applied { seq: 0, .. })
    };
    assert!(!succeeds(u64::from(u32::MAX)).await);
    let revision = put("a", &earlier).await;
    assert!(!succeeds(revision).await);
    let revision = put("a", &own).await;
    let after = put("b", &earlier).await;
    assert!(!succeeds(revision).await);
    assert!(succeeds(after).await);
    let view = client.view(&keys, LIMIT).await.unwrap();
    assert_eq!(view.journal_number, 3);
}

#[tokio::test]
async fn the_robots_in_etcd_are_listed_without_keys_of_other_programs() {
    let servers = Servers::new(1).await;
    let client = servers.client();
    assert_eq!(client.robots(LIMIT).await.unwrap(), [""; 0]);
    let claim = Op::Claim {
        guard: RevisionGuard::default(),
        claim: 1,
        begins: Some(1),
        seq: 0,
        settled: true,
    };
    for robot in ["arm", "arm-2", "leg"] {
        let keys = Keys::new(robot);
        client
            .run(&keys, &settings("a"), &claim, None, None, LIMIT)
            .await
            .unwrap();
    }
    for key in ["/armor", "/registry/pods", "plain", "/zoo/leader"] {
        let put = Put {
            key: key.to_owned(),
            value: b"of another program".to_vec(),
        };
        let lease = client.grant(Duration::from_secs(60), LIMIT).await.unwrap();
        client.put_with_lease(&put, lease, LIMIT).await.unwrap();
    }
    assert_eq!(client.robots(LIMIT).await.unwrap(), ["arm", "arm-2", "leg"]);
}
